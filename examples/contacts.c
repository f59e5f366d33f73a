/* contacts.c: prints the contacts of every new frame. */
#define SKINWARE_IMPLEMENTATION
#include <skinware.h>

#include <stdio.h>

struct contacts {
    const skinware_column *count, *id, *load, *cop_m;
};

static void look_up(const skinware_reader *reader, struct contacts *contacts) {
    contacts->count = skinware_find_column(reader, "count");
    contacts->id = skinware_find_column(reader, "id");
    contacts->load = skinware_find_column(reader, "load");
    contacts->cop_m = skinware_find_column(reader, "cop_m");
}

static void show(const skinware_frame *frame, const struct contacts *contacts) {
    const uint32_t count = *(const uint32_t *)skinware_data(frame, contacts->count);
    const uint32_t *id = (const uint32_t *)skinware_data(frame, contacts->id);
    const float *load = (const float *)skinware_data(frame, contacts->load);
    const float *at = (const float *)skinware_data(frame, contacts->cop_m); /* 3 of each contact */
    uint32_t i;
    printf("%u contacts\n", count);
    for (i = 0; i < count; i++, at += 3)
        printf("  %u: load %g at %.3f %.3f %.3f m\n", id[i], (double)load[i], (double)at[0], (double)at[1], (double)at[2]);
    fflush(stdout);
}

int main(int argc, char **argv) {
    skinware_reader *reader = NULL;
    skinware_frame frame = SKINWARE_FRAME_INIT;
    struct contacts contacts;
    skinware_result result = skinware_attach(&reader, argc > 1 ? argv[1] : "calm", "contacts");
    if (result != SKINWARE_OK) {
        fprintf(stderr, "%s: %s\n", skinware_text(result), skinware_reason());
        return 1;
    }
    look_up(reader, &contacts);
    for (;;) {
        result = skinware_wait(reader, &frame, skinware_now_ns() + 1000000000);
        if (result == SKINWARE_OK && skinware_read(reader, &frame) == SKINWARE_OK)
            show(&frame, &contacts);
        else if (result == SKINWARE_RESTARTED && skinware_reattach(reader) == SKINWARE_STRUCTURE_CHANGED)
            look_up(reader, &contacts); /* the driver has other sensors now */
    }
}

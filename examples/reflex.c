/* reflex.c: acts on a touch within two samples; reflex [NAMESPACE] prints onsets, the age and time of their samples. */
#define SKINWARE_IMPLEMENTATION
#include <skinware.h>

#include <stdio.h>
#include <string.h>

struct contacts {
    const skinware_column *count, *id, *provisional;
};

static void look_up(const skinware_reader *reader, struct contacts *contacts) {
    contacts->count = skinware_find_column(reader, "count");
    contacts->id = skinware_find_column(reader, "id");
    contacts->provisional = skinware_find_column(reader, "provisional");
}

static void act(uint32_t identity) {
    (void)identity; /* stop the hand, or let go: whatever must not wait */
}

/* Contacts that were not there in the last sample. */
static void look(const skinware_frame *frame, const struct contacts *contacts) {
    static uint32_t known[64], n_known;
    const uint32_t count = *(const uint32_t *)skinware_data(frame, contacts->count);
    const uint32_t *id = (const uint32_t *)skinware_data(frame, contacts->id);
    const uint8_t *provisional = (const uint8_t *)skinware_data(frame, contacts->provisional);
    uint32_t i, k;
    for (i = 0; i < count && i < 64; i++) {
        for (k = 0; k < n_known && known[k] != id[i]; k++) {
        }
        if (k < n_known)
            continue;
        act(id[i]);
        printf("%s %u %.0f us %lld ns\n", provisional[i] ? "onset" : "confirmed", id[i],
               (double)(skinware_now_ns() - frame->acquired_ns) / 1000.0, (long long)frame->acquired_ns);
    }
    n_known = count < 64 ? count : 64;
    memcpy(known, id, n_known * sizeof known[0]);
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
    for (;;) { /* run it with chrt -f 42 */
        result = skinware_wait(reader, &frame, skinware_now_ns() + 1000000000);
        if (result == SKINWARE_OK && skinware_read(reader, &frame) == SKINWARE_OK)
            look(&frame, &contacts);
        else if (result == SKINWARE_RESTARTED && skinware_reattach(reader) == SKINWARE_STRUCTURE_CHANGED)
            look_up(reader, &contacts);
    }
}

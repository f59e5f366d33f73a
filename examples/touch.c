/* touch.c: prints the mean pressure of every new frame, indefinitely, whatever happens to the driver. */
#define SKINWARE_IMPLEMENTATION /* in one file of the program, before any other #include */
#include <skinware.h>

#include <stdio.h>
#include <stdlib.h>

struct skin {
    skinware_reader *reader;
    const skinware_type *type;
    const skinware_column *values;
    size_t count;         /* of pressure sensors */
    uint32_t *positions;  /* of each in values and status */
    float *pressure;      /* of each */
    unsigned char *fresh; /* 1: it can be trusted */
};

/* What a program looks up once, and again after the structure has changed. */
static void look_up(struct skin *skin) {
    skin->type = skinware_find_type(skin->reader, "pressure");
    skin->values = skinware_find_column(skin->reader, "values");
    skin->count = skinware_sensors(skin->reader, skin->type, NULL, 0);
    free(skin->positions);
    free(skin->pressure);
    free(skin->fresh);
    skin->positions = (uint32_t *)calloc(skin->count + 1, sizeof *skin->positions);
    skin->pressure = (float *)calloc(skin->count + 1, sizeof *skin->pressure);
    skin->fresh = (unsigned char *)calloc(skin->count + 1, 1);
    if (skin->positions == NULL || skin->pressure == NULL || skin->fresh == NULL)
        abort();
    skinware_sensors(skin->reader, skin->type, skin->positions, skin->count);
}

static void show(const struct skin *skin, const skinware_frame *frame) {
    const size_t fresh = skinware_fresh(skin->reader, frame, 0, skin->positions, skin->count, skin->fresh);
    double total = 0;
    size_t i;
    skinware_physical(frame, skin->values, skin->type, skin->positions, skin->count, skin->pressure);
    for (i = 0; i < skin->count; i++) {
        if (skin->fresh[i]) /* good, recent, and from a running driver */
            total += (double)skin->pressure[i];
    }
    printf("frame %llu: ", (unsigned long long)frame->sequence);
    if (fresh > 0)
        printf("%.1f %s over %zu of %zu taxels\n", total / (double)fresh, skin->type->unit, fresh, skin->count);
    else
        printf("no fresh taxel\n");
    fflush(stdout);
}

int main(int argc, char **argv) {
    struct skin skin = {NULL, NULL, NULL, 0, NULL, NULL, NULL};
    skinware_frame frame = SKINWARE_FRAME_INIT;
    skinware_result result = skinware_attach(&skin.reader, NULL, argc > 1 ? argv[1] : "roboskin");
    if (result != SKINWARE_OK || !skinware_is_driver(skin.reader)) {
        fprintf(stderr, "%s: %s\n", skinware_text(result), skinware_reason());
        return 1;
    }
    look_up(&skin);
    for (;;) {
        result = skinware_wait(skin.reader, &frame, skinware_now_ns() + 1000000000);
        if (result == SKINWARE_OK && skinware_read(skin.reader, &frame) == SKINWARE_OK) {
            show(&skin, &frame);
        } else if (result == SKINWARE_RESTARTED) {
            if (skinware_reattach(skin.reader) == SKINWARE_STRUCTURE_CHANGED)
                look_up(&skin);
        } else if (result != SKINWARE_OK) {
            fprintf(stderr, "%s\n", skinware_text(result)); /* silent, paused or gone: report it and keep waiting */
        }
    }
}

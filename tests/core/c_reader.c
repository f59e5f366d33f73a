/* What tests/core/test_c_reader.py drives: attach in many ways, and print what is seen, one JSON object per line.
 *
 *   c_reader describe SERVICE         everything that a reader can ask for, and the newest frame
 *   c_reader flood SERVICE N copy     N frames of a writer whose every element carries the sequence; every one compared;
 *                                     N = 0: as many as come until standard input ends
 *   c_reader flood SERVICE N view     the same without a copy
 *   c_reader follow SERVICE MS        what waits say, each of at most MS milliseconds, until standard input ends
 *   c_reader walk                     attach to each service named on standard input, and read whatever it offers
 */

/* The map of a file becomes a heap copy here, so that AddressSanitizer sees each byte that is read outside it. */
#ifdef COPY_MAPS
#define _GNU_SOURCE 1
#include <stdlib.h>
#include <sys/mman.h>
#include <unistd.h>

static void *map_copy(void *at, size_t size, int protection, int flags, int fd, off_t offset) {
    void *copy = aligned_alloc(64, size);
    (void)at, (void)protection, (void)flags;
    if (copy == NULL || pread(fd, copy, size, offset) != (ssize_t)size)
        abort();
    return copy;
}

static int unmap_copy(void *at, size_t size) {
    (void)size;
    free(at);
    return 0;
}

#define mmap map_copy
#define munmap unmap_copy
#endif

#define SKINWARE_IMPLEMENTATION
#include <skinware.h>

#include <inttypes.h>
#include <math.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>

static const int64_t ms_ns = 1000000;

static int failed(skinware_result result) {
    printf("{\"event\": \"refused\", \"result\": %d, \"text\": \"%s\", \"reason\": \"%s\"}\n", (int)result,
           skinware_text(result), skinware_reason());
    fflush(stdout);
    return 0;
}

static void tell(const char *event) {
    printf("{\"event\": \"%s\"}\n", event);
    fflush(stdout);
}

static int input_has_ended(void) {
    struct pollfd input = {0, POLLIN, 0};
    return poll(&input, 1, 0) > 0;
}

static void print_number(double value) {
    if (isfinite(value))
        printf("%.17g", value);
    else
        printf("\"%s\"", isnan(value) ? "nan" : value < 0 ? "-inf" : "inf");
}

static void print_elements(const skinware_column *column, const void *data) {
    uint64_t i;
    printf("[");
    for (i = 0; i < column->count; i++) {
        if (i > 0)
            printf(", ");
        if (column->kind == 'S')
            printf("\"%.*s\"", (int)column->itemsize, (const char *)data + i * column->itemsize);
        else
            print_number(skinware_number(column, data, (size_t)i));
    }
    printf("]");
}

static void print_column(const skinware_column *column, const void *data) {
    printf("\"%s\": {\"kind\": \"%c\", \"itemsize\": %" PRIu32 ", \"data\": ", column->name, column->kind,
           column->itemsize);
    print_elements(column, data);
    printf("}");
}

static void print_types(const skinware_reader *reader, const skinware_frame *frame) {
    const skinware_column *values = skinware_find_column(reader, "values");
    size_t i, k;
    printf("\"types\": {");
    for (i = 0; i < skinware_type_count(reader); i++) {
        const skinware_type *type = skinware_type_at(reader, i);
        const size_t count = skinware_sensors(reader, type, NULL, 0);
        uint32_t *positions = (uint32_t *)malloc(count * sizeof *positions + 1);
        float *physical = (float *)malloc(count * sizeof *physical + 1);
        if (positions == NULL || physical == NULL || skinware_find_type(reader, type->name) != type ||
            skinware_sensors(reader, type, positions, count) != count ||
            skinware_physical(frame, values, type, positions, count, physical) != count)
            abort();
        positions[0] += (uint32_t)values->count; /* a position outside the frame is refused */
        if (skinware_physical(frame, values, type, positions, 1, physical + count - 1) != 0)
            abort();
        positions[0] -= (uint32_t)values->count;
        printf("%s\"%s\": {\"id\": %" PRIu32 ", \"unit\": \"%s\", \"positions\": [", i ? ", " : "", type->name, type->id,
               type->unit);
        for (k = 0; k < count; k++)
            printf("%s%" PRIu32, k ? ", " : "", positions[k]);
        printf("], \"physical\": [");
        for (k = 0; k < count; k++) {
            printf("%s", k ? ", " : "");
            print_number((double)physical[k]);
        }
        unsigned char *fresh = (unsigned char *)malloc(count + 1);
        if (fresh == NULL || skinware_fresh(reader, frame, 3600 * INT64_C(1000000000), positions, count, fresh) > count)
            abort();
        printf("], \"fresh\": [");
        for (k = 0; k < count; k++)
            printf("%s%d", k ? ", " : "", fresh[k]);
        free(fresh);
        printf("], \"range\": [");
        print_number(type->minimum);
        printf(", ");
        print_number(type->maximum);
        printf("]}");
        free(positions);
        free(physical);
    }
    printf("}");
}

static int describe(const char *service) {
    skinware_reader *reader;
    skinware_frame frame = SKINWARE_FRAME_INIT;
    size_t i;
    int in_slot;
    skinware_result result = skinware_attach(&reader, NULL, service);
    if (result == SKINWARE_OK)
        result = skinware_read(reader, &frame);
    if (result != SKINWARE_OK)
        return failed(result);
    printf("{\"event\": \"described\", \"kind\": \"%s\", \"generation\": %" PRIu64 ", \"sequence\": %" PRIu64
           ", \"acquired_ns\": %" PRId64 ", \"published_ns\": %" PRId64 ", \"flags\": %" PRIu64
           ", \"stale\": %d, \"alive\": %d, \"pid\": %" PRIu64 ", \"period_ns\": %" PRId64 ", \"slots\": %" PRIu32
           ", \"published_before\": %" PRIu64 ", \"digest\": \"",
           skinware_kind(reader), skinware_generation(reader), frame.sequence, frame.acquired_ns, frame.published_ns,
           frame.flags, frame.stale, skinware_is_alive(reader), skinware_writer_pid(reader), skinware_period_ns(reader),
           skinware_slot_count(reader), skinware_published_before(reader));
    for (i = 0; i < 32; i++)
        printf("%02x", skinware_digest(reader)[i]);
    printf("\"");
    for (in_slot = 0; in_slot <= 1; in_slot++) {
        int first = 1;
        printf(in_slot ? ", \"columns\": {" : ", \"tables\": {");
        for (i = 0; i < skinware_column_count(reader); i++) {
            const skinware_column *column = skinware_column_at(reader, i);
            if (column->in_slot != in_slot)
                continue;
            if (!first)
                printf(", ");
            first = 0;
            print_column(column, in_slot ? skinware_data(&frame, column) : skinware_table_data(reader, column));
        }
        printf("}");
    }
    if (skinware_is_driver(reader)) {
        printf(", ");
        print_types(reader, &frame);
    }
    printf("}\n");
    skinware_frame_free(&frame);
    skinware_detach(reader);
    return 0;
}

/* -- coherency ---------------------------------------------------------------------------------------------------- */

/* Every element of every column, and the time stamp, must be the sequence, cut to the element's size. */
static int is_whole(const skinware_reader *reader, const skinware_frame *frame) {
    size_t i;
    uint64_t k;
    if ((uint64_t)frame->acquired_ns != frame->sequence)
        return 0;
    for (i = 0; i < skinware_column_count(reader); i++) {
        const skinware_column *column = skinware_column_at(reader, i);
        const unsigned char *data = (const unsigned char *)skinware_data(frame, column);
        if (!column->in_slot)
            continue;
        for (k = 0; k < column->count; k++) /* both are little-endian */
            if (memcmp(data + k * column->itemsize, &frame->sequence, column->itemsize) != 0)
                return 0;
    }
    return 1;
}

static int flood(const char *service, long wanted, int in_place) {
    skinware_reader *reader;
    skinware_frame frame = SKINWARE_FRAME_INIT;
    long checked = 0, torn = 0, overruns = 0, overwritten = 0;
    skinware_result result = skinware_attach(&reader, NULL, service);
    if (result != SKINWARE_OK)
        return failed(result);
    while (wanted > 0 ? checked < wanted : !input_has_ended()) {
        result = skinware_wait(reader, &frame, skinware_now_ns() + 1000 * ms_ns);
        if (result == SKINWARE_RESTARTED) {
            result = skinware_reattach(reader);
            if (result != SKINWARE_OK)
                return failed(result);
            tell("restarted");
            continue;
        }
        if (result == SKINWARE_GONE)
            tell("gone");
        if (result != SKINWARE_OK)
            continue;
        result = in_place ? skinware_view(reader, &frame) : skinware_read(reader, &frame);
        if (result == SKINWARE_OVERRUN) {
            overruns++;
        } else if (result == SKINWARE_OK) {
            const int whole = is_whole(reader, &frame);
            if (in_place && !skinware_valid(&frame)) {
                overwritten++;
                continue;
            }
            checked++;
            torn += !whole;
        }
    }
    printf("{\"event\": \"flooded\", \"checked\": %ld, \"torn\": %ld, \"overruns\": %ld, \"overwritten\": %ld}\n",
           checked, torn, overruns, overwritten);
    skinware_frame_free(&frame);
    skinware_detach(reader);
    return 0;
}

/* -- life and death ----------------------------------------------------------------------------------------------- */

static const char *name_of(skinware_result result) {
    switch (result) {
    case SKINWARE_OK: return "frame";
    case SKINWARE_TIMEOUT: return "timeout";
    case SKINWARE_PAUSED: return "paused";
    case SKINWARE_GONE: return "gone";
    case SKINWARE_RESTARTED: return "restarted";
    case SKINWARE_STRUCTURE_CHANGED: return "structure changed";
    case SKINWARE_INTERRUPTED: return "interrupted";
    default: return skinware_text(result);
    }
}

static int follow(const char *service, int64_t wait_ns) {
    skinware_reader *reader;
    skinware_frame frame = SKINWARE_FRAME_INIT;
    const skinware_column *values;
    skinware_result result = skinware_attach(&reader, NULL, service);
    if (result != SKINWARE_OK)
        return failed(result);
    values = skinware_find_column(reader, "values");
    while (!input_has_ended()) {
        skinware_frame last = SKINWARE_FRAME_INIT;
        const int64_t begin_ns = skinware_now_ns();
        int64_t waited_ns;
        skinware_result readable;
        result = skinware_wait(reader, &frame, begin_ns + wait_ns);
        waited_ns = skinware_now_ns() - begin_ns;
        if (result == SKINWARE_RESTARTED) {
            result = skinware_reattach(reader);
            if (result == SKINWARE_OK)
                result = SKINWARE_RESTARTED;
            if (result == SKINWARE_STRUCTURE_CHANGED)
                values = skinware_find_column(reader, "values");
        }
        if (result == SKINWARE_OK)
            result = skinware_read(reader, &frame);
        readable = skinware_read(reader, &last); /* whatever happened, the newest frame can be read */
        printf("{\"event\": \"%s\", \"waited_ns\": %" PRId64 ", \"alive\": %d, \"state\": %" PRIu32
               ", \"count\": %" PRIu64 ", \"sequence\": %" PRIu64 ", \"stale\": %d, \"value\": %d}\n",
               name_of(result), waited_ns, skinware_is_alive(reader), skinware_state(reader), values->count,
               last.sequence, last.stale,
               readable == SKINWARE_OK ? (int)skinware_number(values, skinware_data(&last, values), 0) : -1);
        fflush(stdout);
        skinware_frame_free(&last);
    }
    skinware_frame_free(&frame);
    skinware_detach(reader);
    return 0;
}

/* -- files that are wrong ----------------------------------------------------------------------------------------- */

static unsigned sum(const void *data, uint64_t size) {
    const unsigned char *at = (const unsigned char *)data;
    unsigned total = 0;
    uint64_t i;
    for (i = 0; data != NULL && i < size; i++)
        total += at[i];
    return total;
}

static void walk_frame(const skinware_reader *reader, const skinware_frame *frame) {
    const skinware_column *values = skinware_find_column(reader, "values");
    uint32_t positions[64] = {0};
    float physical[64];
    unsigned total = (unsigned)skinware_valid(frame);
    size_t i;
    for (i = 0; i < skinware_column_count(reader); i++) {
        const skinware_column *column = skinware_column_at(reader, i);
        const void *data = column->in_slot ? skinware_data(frame, column) : skinware_table_data(reader, column);
        if (data == NULL)
            abort();
        total += sum(data, column->count * column->itemsize);
        if (column->count > 0)
            total += skinware_number(column, data, (size_t)column->count - 1) > 0;
    }
    for (i = 0; i < skinware_type_count(reader); i++) {
        const skinware_type *type = skinware_type_at(reader, i);
        const size_t count = skinware_sensors(reader, type, positions, 64);
        skinware_physical(frame, values, type, positions, count < 64 ? count : 64, physical);
        total += (unsigned)strlen(type->name) + (unsigned)strlen(type->unit);
    }
    if (total == 0x12345678)
        puts("the sum must not be optimised away");
}

static int walk(void) {
    char service[64];
    while (scanf("%63s", service) == 1) {
        skinware_reader *reader;
        skinware_frame frame = SKINWARE_FRAME_INIT;
        const skinware_result attached = skinware_attach(&reader, NULL, service);
        if (attached != SKINWARE_OK) {
            failed(attached);
            continue;
        }
        if (skinware_view(reader, &frame) == SKINWARE_OK)
            walk_frame(reader, &frame);
        if (skinware_read(reader, &frame) == SKINWARE_OK)
            walk_frame(reader, &frame);
        (void)skinware_wait(reader, &frame, 0);
        if (skinware_reattach(reader) <= SKINWARE_STRUCTURE_CHANGED && skinware_read(reader, &frame) == SKINWARE_OK)
            walk_frame(reader, &frame);
        tell("attached");
        skinware_frame_free(&frame);
        skinware_detach(reader);
    }
    return 0;
}

static void do_nothing(int number) {
    (void)number;
}

int main(int count, char **words) {
    signal(SIGUSR1, do_nothing);
    if (count == 3 && strcmp(words[1], "describe") == 0)
        return describe(words[2]);
    if (count == 5 && strcmp(words[1], "flood") == 0)
        return flood(words[2], atol(words[3]), strcmp(words[4], "view") == 0);
    if (count == 4 && strcmp(words[1], "follow") == 0)
        return follow(words[2], atol(words[3]) * ms_ns);
    if (count == 2 && strcmp(words[1], "walk") == 0)
        return walk();
    fprintf(stderr, "see the first lines of c_reader.c\n");
    return 2;
}

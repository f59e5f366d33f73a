/*
 * One writer and several readers of a ring, as threads, flat out: ring_stress FILE SLOTS FRAMES.
 *
 * Every reader compares every word of every frame with the frame's sequence. Compiled with the checkers of addresses, of
 * undefined behaviour and of races. Prints what was compared as one line of JSON.
 */

#define SKINWARE_HEADERS 0 /* not loaded from Python */
#include "../../skinware/native/library.c"
#include "../../skinware/native/take.c"

#include <inttypes.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>

enum { WORDS = 509, STRIDE = 64 + 8 * 512, SLOT_OFFSET = 4096, READERS = 4 };

static unsigned char *map;
static uint64_t slots, frames;
static int over, descriptor;

typedef struct tally {
    int way;
    uint64_t compared, torn, overtaken;
} tally;

static skinware__ring ring_of(void) {
    skinware__ring ring;
    ring.map = map;
    ring.slot_offset = SLOT_OFFSET;
    ring.slot_stride = STRIDE;
    ring.slot_count = slots;
    return ring;
}

static void *write_frames(void *nothing) {
    skinware_ring_writer writer;
    uint64_t i, k;
    memset(&writer, 0, sizeof writer);
    writer.map = map;
    writer.slot_offset = SLOT_OFFSET;
    writer.slot_stride = STRIDE;
    writer.slot_count = slots;
    for (i = 1; i <= frames; i++) {
        skinware__word *words = (skinware__word *)(void *)(skinware_ring_begin(&writer) + 64);
        for (k = 0; k < WORDS; k++)
            __atomic_store_n(words + k, i, __ATOMIC_RELAXED);
        if (skinware_ring_commit(&writer, (int64_t)i, i) != i)
            abort();
        if (i % 8 == 0)
            sched_yield(); /* readers get a chance to keep up */
    }
    if (skinware_ring_commit(&writer, 1, 1) != 0) /* without a begin */
        abort();
    __atomic_store_n(&over, 1, __ATOMIC_RELEASE);
    skinware_native_wake(&writer);
    return nothing;
}

static void compare(tally *mine, const unsigned char *frame) {
    const skinware__slot *slot = (const skinware__slot *)(const void *)frame;
    const uint64_t *words = (const uint64_t *)(const void *)(frame + 64);
    int whole = slot->acquired_ns == (int64_t)slot->sequence && slot->flags == slot->sequence;
    uint64_t k;
    for (k = 0; k < WORDS; k++)
        whole &= words[k] == slot->sequence;
    mine->compared++;
    mine->torn += !whole;
}

/* Takes samples of the ring: in a loop, in order, or (way 3) as if it were two rings. */
static void *take_frames(void *argument) {
    tally *mine = (tally *)argument;
    const int count = mine->way == 3 ? 2 : 1;
    unsigned char *to = (unsigned char *)malloc((size_t)count * STRIDE); /* exactly: the checker sees one byte more */
    skinware_native_take *take = (skinware_native_take *)calloc(1, sizeof *take);
    int i, result;
    if (to == NULL || take == NULL)
        abort();
    take->count = (uint64_t)count;
    take->is_loop = count == 1;
    take->wanted = mine->way == 1 ? NEXT : NEWER;
    take->timeout_ns = 1000000;
    take->until_ns = INT64_MAX;
    take->process = getpid();
    for (i = 0; i < count; i++) {
        take->places[i].start = (uint64_t)i * STRIDE;
        take->places[i].reader = (skinware_native_reader *)calloc(1, sizeof(skinware_native_reader));
        if (take->places[i].reader == NULL)
            abort();
        take->places[i].reader->ring = ring_of();
        take->places[i].reader->descriptor = descriptor;
        take->places[i].reader->writer = SKINWARE__UNKNOWN;
    }
    while (!__atomic_load_n(&over, __ATOMIC_ACQUIRE)) {
        result = skinware_native_take_next(take, to);
        for (i = 0; i < count; i++) {
            skinware_native_reader *reader = take->places[i].reader;
            if (result == NEWS)
                compare(mine, to + i * STRIDE);
            if (result == PYTHONS_TURN) { /* as Python: begin with the newest again */
                reader->last = skinware__latest(&reader->ring);
                reader->noted = 0;
            }
        }
        mine->overtaken += result == PYTHONS_TURN;
    }
    for (i = 0; i < count; i++)
        free(take->places[i].reader);
    free(take);
    free(to);
    return NULL;
}

static void *copy_frames(void *argument) {
    tally *mine = (tally *)argument;
    unsigned char *to = (unsigned char *)malloc(STRIDE);
    const skinware__ring ring = ring_of();
    int result;
    if (to == NULL)
        abort();
    while (!__atomic_load_n(&over, __ATOMIC_ACQUIRE)) {
        result = skinware_native_copy(&ring, 0, to);
        if (result == COPIED)
            compare(mine, to);
        mine->overtaken += result == OVERTAKEN;
    }
    free(to);
    return NULL;
}

int main(int count, char **arguments) {
    static tally tallies[READERS];
    pthread_t writer, readers[READERS];
    struct flock lock;
    const int owner = count == 4 ? open(arguments[1], O_RDWR | O_CREAT | O_TRUNC, 0600) : -1;
    uint64_t size, torn = 0;
    int i;
    if (owner < 0)
        return 2;
    slots = strtoull(arguments[2], NULL, 10);
    frames = strtoull(arguments[3], NULL, 10);
    size = SLOT_OFFSET + slots * STRIDE;
    memset(&lock, 0, sizeof lock);
    lock.l_type = F_WRLCK;
    if (ftruncate(owner, (off_t)size) != 0 || fcntl(owner, 37 /* F_OFD_SETLK */, &lock) != 0)
        return 3;
    descriptor = open(arguments[1], O_RDONLY);
    map = (unsigned char *)mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, owner, 0);
    if (descriptor < 0 || map == MAP_FAILED || skinware_native_headers() != SKINWARE_HEADERS)
        return 4;
    skinware_native_fence();
    for (i = 0; i < READERS; i++) {
        tallies[i].way = i;
        if (pthread_create(&readers[i], NULL, i == 2 ? copy_frames : take_frames, &tallies[i]) != 0)
            return 5;
    }
    if (pthread_create(&writer, NULL, write_frames, NULL) != 0)
        return 5;
    pthread_join(writer, NULL);
    for (i = 0; i < READERS; i++) {
        pthread_join(readers[i], NULL);
        torn += tallies[i].torn;
    }
    printf("{\"torn\": %" PRIu64 ", \"turns\": %" PRIu64 ", \"in_order\": %" PRIu64 ", \"copies\": %" PRIu64
           ", \"looks\": %" PRIu64 ", \"timed\": %" PRIu64 ", \"ages\": %" PRIu64 ", \"sizes\": [%zu, %zu, %zu]}\n",
           torn, tallies[0].compared, tallies[1].compared, tallies[2].compared, tallies[3].compared,
           skinware__load_64(map + 576), skinware__load_64(map + 640 + 8 * (SKINWARE__BUCKETS - 1)),
           sizeof(skinware_native_reader), sizeof(skinware_ring_writer), sizeof(skinware_native_take));
    munmap(map, size);
    close(descriptor);
    close(owner);
    return 0;
}

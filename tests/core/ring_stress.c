/*
 * One writer and several readers of a ring, as threads, flat out: ring_stress FILE SLOTS FRAMES.
 *
 * Every reader compares every word of every frame with the frame's sequence. Compiled with the checkers of addresses, of
 * undefined behaviour and of races. Prints what was compared as one line of JSON.
 */

#include "../../skinware/native/library.c"
#include "../../skinware/native/look.c"
#include "../../skinware/native/turns.c"

#include <inttypes.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>

enum { WORDS = 509, STRIDE = 64 + 8 * 512, SLOT_OFFSET = 4096, READERS = 5 };

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

/* Looks at the ring as if it were two. */
static void *look_at_frames(void *argument) {
    tally *mine = (tally *)argument;
    unsigned char *to = (unsigned char *)malloc(2 * STRIDE);
    skinware_native_look *look = (skinware_native_look *)calloc(1, sizeof *look);
    int i, result;
    if (to == NULL || look == NULL)
        abort();
    look->count = 2;
    look->news_only = 1;
    for (i = 0; i < 2; i++) {
        look->rings[i].start = (uint64_t)i * STRIDE;
        look->rings[i].turns = (skinware_native_turns *)calloc(1, sizeof(skinware_native_turns));
        if (look->rings[i].turns == NULL)
            abort();
        look->rings[i].turns->ring = ring_of();
        look->rings[i].turns->descriptor = descriptor;
        look->rings[i].turns->writer = SKINWARE__UNKNOWN;
        look->rings[i].turns->process = getpid();
    }
    while (!__atomic_load_n(&over, __ATOMIC_ACQUIRE)) {
        look->until_ns = skinware__clock_ns(CLOCK_MONOTONIC) + 1000000;
        result = skinware_native_newest(look, to);
        for (i = 0; i < 2; i++) {
            skinware_native_turns *turns = look->rings[i].turns;
            if (result == NEWS)
                compare(mine, to + i * STRIDE);
            if (result == PYTHONS_TURN) { /* as Python: begin with the newest again */
                turns->last = skinware__latest(&turns->ring);
                turns->noted = 0;
            }
        }
        mine->overtaken += result == PYTHONS_TURN;
    }
    for (i = 0; i < 2; i++)
        free(look->rings[i].turns);
    free(look);
    free(to);
    return NULL;
}

static void *read_frames(void *argument) {
    tally *mine = (tally *)argument;
    unsigned char *to = (unsigned char *)malloc(STRIDE); /* exactly a frame: the checker of addresses sees one byte more */
    skinware_native_turns *turns = (skinware_native_turns *)calloc(1, sizeof *turns);
    skinware_native_request request;
    int result;
    if (to == NULL || turns == NULL)
        abort();
    turns->ring = request.ring = ring_of();
    turns->in_order = mine->way == 1;
    turns->until_ns = turns->timeout_ns = INT64_MAX;
    turns->descriptor = descriptor;
    turns->writer = SKINWARE__UNKNOWN;
    turns->process = getpid();
    while (!__atomic_load_n(&over, __ATOMIC_ACQUIRE)) {
        if (mine->way < 2) {
            result = skinware_native_turn(turns, to);
            if (result == 0) { /* as Python: begin with the newest again */
                turns->last = skinware__latest(&turns->ring);
                turns->noted = 0;
            }
        } else if (mine->way == 2) {
            result = skinware_native_copy(&request.ring, 0, to);
        } else {
            request.wake_count = skinware__load_32(map + SKINWARE__WAKE_WORD_OFFSET);
            request.known = skinware__latest(&request.ring);
            request.wanted = 0;
            request.timeout_ns = 1000000;
            result = skinware_native_wait(&request, to);
        }
        if (result == COPIED)
            compare(mine, to);
        mine->overtaken += result == OVERTAKEN;
    }
    free(turns);
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
    if (descriptor < 0 || map == MAP_FAILED || skinware_native_abi() != ABI)
        return 4;
    skinware_native_fence();
    for (i = 0; i < READERS; i++) {
        tallies[i].way = i;
        if (pthread_create(&readers[i], NULL, i == 4 ? look_at_frames : read_frames, &tallies[i]) != 0)
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
           ", \"waits\": %" PRIu64 ", \"looks\": %" PRIu64 ", \"timed\": %" PRIu64 ", \"ages\": %" PRIu64
           ", \"sizes\": [%zu, %zu, %zu, %zu]}\n",
           torn, tallies[0].compared, tallies[1].compared, tallies[2].compared, tallies[3].compared, tallies[4].compared,
           skinware__load_64(map + 576), skinware__load_64(map + 640 + 8 * (SKINWARE__BUCKETS - 1)),
           sizeof(skinware_native_request), sizeof(skinware_native_turns), sizeof(skinware_ring_writer),
           sizeof(skinware_native_look));
    munmap(map, size);
    close(descriptor);
    close(owner);
    return 0;
}

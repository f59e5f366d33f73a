/*
 * The slot protocol: reading is in skinware.h, publishing here; docs/reference/shared-memory.md explains it. Include
 * this before any system header.
 *
 * Memory order: the fence of begin keeps what is filled in behind the sequence 0; the store of the sequence in commit is
 * a release, and so are those of latest and the wake word, in this order. A reader acquires each, and looks at the
 * sequence again behind a fence (skinware__still).
 */

#ifndef SKINWARE_NATIVE_RING_H
#define SKINWARE_NATIVE_RING_H

#ifndef SKINWARE_RING
#define SKINWARE_RING
#endif
#include "../include/skinware.h"

#include <limits.h>

/* Marks the functions that a library exports: all others are hidden. */
#define SKINWARE_EXPORT __attribute__((visibility("default")))

/* How often a reader tries again while the writer overwrites what it copies. */
enum { SKINWARE__COPY_ATTEMPTS = 64 };

/* Words of 8 bytes from the beginning of the file. */
enum {
    SKINWARE__WORD_AHEAD = 536 / 8,
    SKINWARE__WORD_TIMED = 576 / 8,
    SKINWARE__WORD_WALL = 584 / 8, /* best, worst, total; so for the next */
    SKINWARE__WORD_CPU = 608 / 8,
    SKINWARE__WORD_BEFORE_BOOT = 632 / 8,
    SKINWARE__WORD_AGE = 640 / 8,
    SKINWARE__BUCKETS = 32
};

/*
 * The writer's end of one generation, for one thread at a time. Python's RingWriter owns one, at native_address; every
 * publication goes through it.
 */
typedef struct skinware_ring_writer {
    unsigned char *map; /* may be written */
    uint64_t slot_offset;
    uint64_t slot_stride;
    uint64_t slot_count;
    int64_t begun_ns; /* 0: no sample is begun */
    int64_t cpu_ns;   /* of the publishing thread, at the last publication */
    uint64_t skipped; /* sequences that are left out before the next one; 0 after a commit */
} skinware_ring_writer;

static inline int64_t skinware__clock_ns(clockid_t clock) {
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static inline skinware__word *skinware__word_at(const skinware_ring_writer *writer, uint64_t index) {
    return (skinware__word *)(void *)writer->map + index;
}

/* Statistics: one thread writes them, others look at them at any time. */
static inline uint64_t skinware__statistic(const skinware_ring_writer *writer, uint64_t index) {
    return __atomic_load_n(skinware__word_at(writer, index), __ATOMIC_RELAXED);
}

static inline void skinware__set_statistic(const skinware_ring_writer *writer, uint64_t index, uint64_t value) {
    __atomic_store_n(skinware__word_at(writer, index), value, __ATOMIC_RELAXED);
}

static inline void skinware__add_statistic(const skinware_ring_writer *writer, uint64_t index, uint64_t value) {
    skinware__set_statistic(writer, index, skinware__statistic(writer, index) + value);
}

/* The bucket of a histogram that a time falls into: k for 2**(k-1) to 2**k - 1 ns, the last one for all above. */
static inline unsigned skinware__bucket(int64_t value_ns) {
    unsigned bucket = 0;
    for (; value_ns > 0 && bucket < SKINWARE__BUCKETS - 1; value_ns >>= 1)
        bucket++;
    return bucket;
}

static inline void skinware__note_spread(const skinware_ring_writer *writer, uint64_t index, int64_t value_ns,
                                         int is_first) {
    const uint64_t value = (uint64_t)value_ns;
    if (is_first || value < skinware__statistic(writer, index))
        skinware__set_statistic(writer, index, value);
    if (value > skinware__statistic(writer, index + 1))
        skinware__set_statistic(writer, index + 1, value);
    skinware__add_statistic(writer, index + 2, value);
}

/* Statistics of one publication, after the readers have been woken. */
static inline void skinware__note(skinware_ring_writer *writer, int64_t begun_ns, int64_t published_ns,
                                  int64_t acquired_ns) {
    const int64_t cpu_ns = skinware__clock_ns(CLOCK_THREAD_CPUTIME_ID);
    const int64_t passed_ns = cpu_ns > writer->cpu_ns ? cpu_ns - writer->cpu_ns : 0; /* below 0: of another thread */
    const uint64_t timed = skinware__statistic(writer, SKINWARE__WORD_TIMED) + 1;
    writer->cpu_ns = cpu_ns;
    if (acquired_ns - published_ns > SKINWARE__AHEAD_NS)
        skinware__add_statistic(writer, SKINWARE__WORD_AHEAD, 1);
    skinware__add_statistic(writer, SKINWARE__WORD_AGE + skinware__bucket(published_ns - acquired_ns), 1);
    skinware__set_statistic(writer, SKINWARE__WORD_TIMED, timed);
    skinware__note_spread(writer, SKINWARE__WORD_WALL, published_ns - begun_ns, timed == 1);
    skinware__note_spread(writer, SKINWARE__WORD_CPU, passed_ns, timed == 1);
}

/* The sequence of the newest frame, 0 before the first. */
static inline uint64_t skinware_ring_sequence(const skinware_ring_writer *writer) {
    return __atomic_load_n(skinware__word_at(writer, SKINWARE__LATEST_OFFSET / 8), __ATOMIC_RELAXED);
}

/* The sequence of the sample that begin and commit are about. */
static inline uint64_t skinware_ring_next(const skinware_ring_writer *writer) {
    return skinware_ring_sequence(writer) + 1 + writer->skipped;
}

/* The slot of a sequence: SLOT_HEADER_BYTES of header, then the columns at their offsets. */
static inline unsigned char *skinware_ring_slot(const skinware_ring_writer *writer, uint64_t sequence) {
    return writer->map + writer->slot_offset + (sequence % writer->slot_count) * writer->slot_stride;
}

/*
 * The slot of the next frame, to be filled from its 64th byte on; it holds an old one. Until the commit, readers of that
 * old frame find that it is gone. May be called again instead of a commit.
 */
static inline unsigned char *skinware_ring_begin(skinware_ring_writer *writer) {
    unsigned char *slot = skinware_ring_slot(writer, skinware_ring_next(writer));
    writer->begun_ns = skinware__clock_ns(CLOCK_MONOTONIC);
    __atomic_store_n(&((skinware__slot *)(void *)slot)->sequence, 0, __ATOMIC_RELAXED);
    __atomic_thread_fence(__ATOMIC_RELEASE);
    return slot;
}

/* Wake all waiters of this generation: one system call. From any thread. */
static inline void skinware_ring_wake(const skinware_ring_writer *writer) {
    uint32_t *wake_word = (uint32_t *)(void *)(writer->map + SKINWARE__WAKE_WORD_OFFSET);
    __atomic_fetch_add(wake_word, 1, __ATOMIC_RELEASE);
#ifdef SYS_futex
    syscall(SYS_futex, wake_word, 1 /* FUTEX_WAKE, between processes */, INT_MAX, NULL, NULL, 0);
#else
    syscall(SYS_futex_time64, wake_word, 1, INT_MAX, NULL, NULL, 0);
#endif
}

/*
 * Publish what was filled in since the begin, and wake all readers.
 *
 * acquired_ns: newest time stamp of the data; one from before this machine booted (below 0) counts as 0, and is counted;
 * one of more than 0.2 s in the future is counted.
 * Returns the frame's sequence; 0 if there was no begin: nothing has changed then.
 */
static inline uint64_t skinware_ring_commit(skinware_ring_writer *writer, int64_t acquired_ns, uint64_t flags) {
    const uint64_t sequence = skinware_ring_next(writer);
    const int64_t begun_ns = writer->begun_ns;
    skinware__slot *slot = (skinware__slot *)(void *)skinware_ring_slot(writer, sequence);
    int64_t published_ns;
    if (begun_ns == 0)
        return 0;
    if (acquired_ns < 0) {
        acquired_ns = 0;
        skinware__add_statistic(writer, SKINWARE__WORD_BEFORE_BOOT, 1);
    }
    published_ns = skinware__clock_ns(CLOCK_MONOTONIC);
    __atomic_store_n(&slot->acquired_ns, acquired_ns, __ATOMIC_RELAXED);
    __atomic_store_n(&slot->published_ns, published_ns, __ATOMIC_RELAXED);
    __atomic_store_n(&slot->flags, flags, __ATOMIC_RELAXED);
    __atomic_store_n(&slot->sequence, sequence, __ATOMIC_RELEASE);
    writer->begun_ns = 0;
    writer->skipped = 0;
    __atomic_store_n(skinware__word_at(writer, SKINWARE__LATEST_OFFSET / 8), sequence, __ATOMIC_RELEASE);
    skinware_ring_wake(writer);
    skinware__note(writer, begun_ns, published_ns, acquired_ns);
    return sequence;
}

#endif /* SKINWARE_NATIVE_RING_H */

/*
 * A look at the newest frames of several rings at once: one sleep on all of them, one copy of each, for as long as
 * nothing happens but frames. Whatever else there is to do is Python's, as in turns.c.
 */

#include "turns.h"

/* What FUTEX_WAITV takes. skinware/memory/futex.py has the same number. */
enum { MOST_RINGS = 128 };

/* What a look can come to. */
enum { PYTHONS_TURN = -1, NO_NEWS = 0, NEWS = 1 };

/* struct futex_waitv of Linux 5.16, which older headers do not have. */
typedef struct wait_entry {
    uint64_t value;
    uint64_t address;
    uint32_t flags;
    uint32_t reserved;
} wait_entry;

typedef struct seen_ring {
    skinware_native_turns *turns;
    uint64_t start; /* of its frame, in the memory of all */
} seen_ring;

/* skinware/memory/look.py has the same words. */
typedef struct skinware_native_look {
    uint64_t count;
    uint64_t news_only; /* 1: only if one of them has another frame than the one that was handed out last */
    int64_t until_ns;   /* how long to wait for that; 0: not at all */
    int64_t asked_ns;   /* when the writers were last asked whether they live */
    seen_ring rings[MOST_RINGS];
    wait_entry words[MOST_RINGS];
} skinware_native_look;

SKINWARE_EXPORT int skinware_native_newest(skinware_native_look *look, unsigned char *to);

/* Whether there is news; PYTHONS_TURN: something else is to be done. */
static int look_for_news(const skinware_native_look *look) {
    int found = look->news_only ? NO_NEWS : NEWS;
    uint64_t i;
    for (i = 0; i < look->count; i++) {
        const skinware_native_turns *turns = look->rings[i].turns;
        if (turns->last == 0 || turns->taken_ns != 0 || turns->noted == TURNS || skinware__has_ended(&turns->ring))
            return PYTHONS_TURN;
        if (skinware__latest(&turns->ring) != turns->last)
            found = NEWS;
    }
    return found;
}

static int writers_live(skinware_native_look *look, int64_t now_ns) {
    uint64_t i;
    if (now_ns - look->asked_ns < SLICE_NS)
        return 1;
    for (i = 0; i < look->count; i++)
        if (!skinware__writer_lives(look->rings[i].turns))
            return 0;
    look->asked_ns = now_ns;
    return 1;
}

/* The present value of every wake word, to be read before looking for news. */
static void read_words(skinware_native_look *look) {
    uint64_t i;
    for (i = 0; i < look->count; i++) {
        const unsigned char *word = look->rings[i].turns->ring.map + SKINWARE__WAKE_WORD_OFFSET;
        look->words[i].address = (uint64_t)(uintptr_t)word;
        look->words[i].value = skinware__load_32(word);
        look->words[i].flags = 2; /* FUTEX_32, between processes */
    }
}

/* Sleeps until a wake word is another, or the time comes. 0: this kernel cannot. */
static int sleep_on_words(const skinware_native_look *look, int64_t until_ns) {
    struct {
        int64_t seconds, nanoseconds;
    } until;
    until.seconds = until_ns / 1000000000;
    until.nanoseconds = until_ns % 1000000000;
    return syscall(449 /* SYS_futex_waitv */, look->words, (unsigned)look->count, 0, &until, CLOCK_MONOTONIC) >= 0 ||
           errno == EAGAIN || errno == EINTR || errno == ETIMEDOUT;
}

static int take_all(const skinware_native_look *look, unsigned char *to) {
    int64_t taken_ns;
    uint64_t i;
    for (i = 0; i < look->count; i++) {
        const uint64_t sequence =
            skinware__copy_newest(&look->rings[i].turns->ring, to + look->rings[i].start, SKINWARE__COPY_ATTEMPTS);
        if (sequence == 0 || sequence == UINT64_MAX)
            return PYTHONS_TURN;
    }
    taken_ns = skinware__clock_ns(CLOCK_MONOTONIC);
    for (i = 0; i < look->count; i++) {
        const skinware__slot *slot = (const skinware__slot *)(const void *)(to + look->rings[i].start);
        skinware__hand_out(look->rings[i].turns, slot->sequence);
        skinware__note_turn(look->rings[i].turns, slot->acquired_ns, taken_ns, taken_ns, 0);
    }
    return NEWS;
}

/* Copies the newest frame of every ring, and counts them once all are there. */
int skinware_native_newest(skinware_native_look *look, unsigned char *to) {
    const int64_t now_ns = skinware__clock_ns(CLOCK_MONOTONIC);
    int found;
    read_words(look);
    found = look->rings[0].turns->process == getpid() && writers_live(look, now_ns) ? look_for_news(look) : PYTHONS_TURN;
    if (found == NO_NEWS && now_ns < look->until_ns) {
        if (!sleep_on_words(look, least(look->until_ns, look->asked_ns + SLICE_NS)))
            return PYTHONS_TURN;
        found = look_for_news(look);
    }
    return found == NEWS ? take_all(look, to) : found;
}

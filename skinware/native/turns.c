/*
 * The turns of a loop that takes frames as they come, for as long as nothing happens but frames. A turn is noted, slept
 * for and copied in one call; whatever else there is to do (a new generation, a dead writer, an announcement that is
 * due, a signal) is Python's, which is told so.
 */

#include "ring.h"

enum { TURNS = 256 };
static const int64_t SLICE_NS = 50000000;

/* What a turn was, as skinware/service/_accounts.py has it. */
typedef struct turn {
    int64_t acquired_ns;
    int64_t taken_ns;
    int64_t ended_ns;
    int64_t cpu_ns; /* of this thread */
} turn;

/* Where a reader is. skinware/memory/native_ring.py has the same words. */
typedef struct skinware_native_turns {
    skinware__ring ring;
    uint64_t last;       /* sequence of the frame that was handed out last */
    uint64_t in_order;   /* 1: take the one after it; 0: the newest */
    int64_t until_ns;    /* when Python has something to do at the latest */
    int64_t deadline_ns; /* of this wait */
    int64_t descriptor;  /* of the file: asks whether the writer lives */
    int64_t process;     /* whose reader this is: the child of a fork has none */
    uint64_t frames;     /* handed out */
    uint64_t lost;       /* not handed out */
    int64_t acquired_ns; /* of the frame handed out whose turn is not over */
    int64_t taken_ns;    /* likewise; 0: there is none */
    uint64_t noted;      /* turns that are over */
    turn turns[TURNS];
} skinware_native_turns;

static void end_turn(skinware_native_turns *turns, int64_t now_ns) {
    turn *over = &turns->turns[turns->noted];
    if (turns->taken_ns == 0)
        return;
    over->acquired_ns = turns->acquired_ns;
    over->taken_ns = turns->taken_ns;
    over->ended_ns = now_ns;
    over->cpu_ns = skinware__clock_ns(CLOCK_THREAD_CPUTIME_ID);
    turns->noted++;
    turns->taken_ns = 0;
}

static int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

/* Copies what is wanted and not older than latest; 0: Python finds out why not. */
static int take(skinware_native_turns *turns, uint64_t latest, unsigned char *to) {
    const uint64_t wanted = turns->in_order ? turns->last + 1 : latest;
    const skinware__slot *slot = (const skinware__slot *)(const void *)to;
    if (wanted <= turns->last || !skinware__copy(&turns->ring, wanted, to))
        return 0;
    turns->lost += wanted - turns->last - 1;
    turns->frames++;
    turns->last = wanted;
    turns->acquired_ns = slot->acquired_ns;
    turns->taken_ns = skinware__clock_ns(CLOCK_MONOTONIC);
    return 1;
}

SKINWARE_EXPORT int skinware_native_turn(skinware_native_turns *turns, unsigned char *to);

/* Ends the turn before, waits for a frame and copies it. 1: it is there, 0: Python has to look. */
int skinware_native_turn(skinware_native_turns *turns, unsigned char *to) {
    const unsigned char *map = turns->ring.map;
    const uint32_t wake_word = skinware__load_32(map + SKINWARE__WAKE_WORD_OFFSET);
    uint64_t latest = skinware__latest(&turns->ring);
    const int64_t now_ns = skinware__clock_ns(CLOCK_MONOTONIC);
    int64_t until_ns;
    end_turn(turns, now_ns);
    if (turns->last == 0 || turns->noted == TURNS || (skinware__load_32(map + SKINWARE__STATE_OFFSET) & 6u) ||
        turns->process != getpid())
        return 0;
    if (latest != turns->last) /* there without a sleep: its writer may be dead */
        return skinware__is_locked((int)turns->descriptor) ? take(turns, latest, to) : 0;
    until_ns = least(now_ns + SLICE_NS, least(turns->until_ns, turns->deadline_ns));
    if (until_ns <= now_ns)
        return 0;
    (void)skinware__sleep(map + SKINWARE__WAKE_WORD_OFFSET, wake_word, until_ns - now_ns);
    latest = skinware__latest(&turns->ring);
    return latest != turns->last ? take(turns, latest, to) : 0;
}

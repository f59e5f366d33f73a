/*
 * The turns of a loop that takes frames as they come, for as long as nothing happens but frames. A turn is noted, slept
 * for and copied in one call; whatever else there is to do (a new generation, a dead writer, an announcement that is
 * due, a signal) is Python's, which is told so.
 */

#include "turns.h"

static void end_turn(skinware_native_turns *turns, int64_t now_ns) {
    if (turns->taken_ns == 0)
        return;
    skinware__note_turn(turns, turns->acquired_ns, turns->taken_ns, now_ns, skinware__clock_ns(CLOCK_THREAD_CPUTIME_ID));
    turns->taken_ns = 0;
}

/* Copies what is wanted and not older than latest; 0: Python finds out why not. */
static int take(skinware_native_turns *turns, uint64_t latest, unsigned char *to) {
    const uint64_t wanted = turns->in_order ? turns->last + 1 : latest;
    const skinware__slot *slot = (const skinware__slot *)(const void *)to;
    if (wanted <= turns->last || !skinware__copy(&turns->ring, wanted, to))
        return 0;
    skinware__hand_out(turns, wanted);
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
    turns->begun_ns = now_ns;
    end_turn(turns, now_ns);
    if (turns->last == 0 || turns->noted == TURNS || skinware__has_ended(&turns->ring) || turns->process != getpid())
        return 0;
    if (latest != turns->last) /* there without a sleep: its writer may be dead */
        return skinware__writer_lives(turns) ? take(turns, latest, to) : 0;
    until_ns = least(now_ns + least(SLICE_NS, turns->timeout_ns), turns->until_ns);
    if (until_ns <= now_ns)
        return 0;
    (void)skinware__sleep(map + SKINWARE__WAKE_WORD_OFFSET, wake_word, until_ns - now_ns);
    latest = skinware__latest(&turns->ring);
    return latest != turns->last ? take(turns, latest, to) : 0;
}

/* Where a reader in C is, between two calls of it. skinware/memory/ring_reader.py has the same words. */

#ifndef SKINWARE_NATIVE_TURNS_H
#define SKINWARE_NATIVE_TURNS_H

#include "ring.h"

enum { TURNS = 256 };

/* The longest sleep: Python then looks whether somebody wants to end the wait. */
static const int64_t SLICE_NS = 50000000;

/* What a turn was, as skinware/service/messages.py has it. */
typedef struct turn {
    int64_t acquired_ns;
    int64_t taken_ns;
    int64_t ended_ns;
    int64_t cpu_ns; /* of this thread; 0: not asked for */
} turn;

typedef struct skinware_native_turns {
    skinware__ring ring;
    uint64_t last;       /* sequence of the frame that was handed out last; 0: the next turn is Python's */
    uint64_t in_order;   /* 1: take the one after it; 0: the newest */
    int64_t until_ns;    /* when Python has something to do at the latest */
    int64_t timeout_ns;  /* of each wait */
    int64_t begun_ns;    /* when the wait for the next frame began */
    int64_t descriptor;  /* of the file: asks whether the writer lives */
    int64_t writer;      /* pidfd of the writer, SKINWARE__UNKNOWN or SKINWARE__ENDED */
    int64_t process;     /* whose reader this is: the child of a fork has none */
    uint64_t frames;     /* handed out */
    uint64_t lost;       /* not handed out */
    int64_t acquired_ns; /* of the frame handed out whose turn is not over */
    int64_t taken_ns;    /* likewise; 0: there is none */
    uint64_t noted;      /* turns that are over */
    turn turns[TURNS];
} skinware_native_turns;

static inline int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

/* Whether the writer went over to another generation, or closed this one. */
static inline int skinware__has_ended(const skinware__ring *ring) {
    return (skinware__load_32(ring->map + SKINWARE__STATE_OFFSET) & 6u) != 0;
}

static inline int skinware__writer_lives(const skinware_native_turns *turns) {
    return skinware__lives((int)turns->descriptor, (int)turns->writer);
}

/* The frame of this sequence is handed out. */
static inline void skinware__hand_out(skinware_native_turns *turns, uint64_t sequence) {
    turns->lost += sequence > turns->last + 1 ? sequence - turns->last - 1 : 0;
    turns->frames++;
    turns->last = sequence;
}

/* A turn is over; there has to be room for it. */
static inline void skinware__note_turn(skinware_native_turns *turns, int64_t acquired_ns, int64_t taken_ns,
                                       int64_t ended_ns, int64_t cpu_ns) {
    turn *over = &turns->turns[turns->noted++];
    over->acquired_ns = acquired_ns;
    over->taken_ns = taken_ns;
    over->ended_ns = ended_ns;
    over->cpu_ns = cpu_ns;
}

#endif /* SKINWARE_NATIVE_TURNS_H */

/*
 * Take samples: one sleep on some rings, one copy of each, for as long as nothing happens but samples. Everything else (a
 * new generation, a dead writer, an announcement that is due, a signal) is Python's, which the result says.
 */

#include "ring.h"

/* MOST_RINGS is what FUTEX_WAITV takes; skinware/memory/futex.py has the same number. */
enum { MOST_RINGS = 128, TURNS = 256 };

/* The longest sleep: Python then looks whether the wait is to end. */
static const int64_t SLICE_NS = 50000000;

/* What a call can come to. */
enum { PYTHONS_TURN = -1, NO_NEWS = 0, NEWS = 1 };

/* What is taken: what is newest, even if it was taken before; something newer; or the next sample in order. */
enum { NEWEST = 0, NEWER = 1, NEXT = 2 };

/* One turn of a loop, from taking a sample to asking for the next. */
typedef struct turn {
    int64_t acquired_ns;
    int64_t taken_ns;
    int64_t ended_ns;
    int64_t cpu_ns; /* of this thread at the end; 0: not asked for */
} turn;

/* Where a reader is, between two calls. skinware/memory/ring_reader.py has the same fields, also of skinware_native_take. */
typedef struct skinware_native_reader {
    skinware__ring ring;
    uint64_t last;       /* sequence of the sample that was taken last; 0: the next turn is Python's */
    int64_t descriptor;  /* of the file: asks whether the writer lives */
    int64_t writer;      /* pidfd of the writer, SKINWARE__UNKNOWN or SKINWARE__ENDED */
    uint64_t frames;     /* samples taken */
    uint64_t missed;     /* samples missed */
    int64_t acquired_ns; /* of the sample whose turn is not over */
    int64_t taken_ns;    /* when it was taken; 0: there is none */
    uint64_t noted;      /* turns that are over */
    turn turns[TURNS];
} skinware_native_reader;

typedef struct place {
    skinware_native_reader *reader;
    uint64_t start; /* of its sample, in the memory of all */
} place;

/* struct futex_waitv of Linux 5.16, which older headers do not have. */
typedef struct wait_entry {
    uint64_t value;
    uint64_t address;
    uint32_t flags;
    uint32_t reserved;
} wait_entry;

typedef struct skinware_native_take {
    uint64_t count;     /* readers */
    uint64_t is_loop;   /* 1: the loop of one reader, whose turn ends with the next call */
    uint64_t wanted;    /* NEWEST, NEWER or NEXT */
    int64_t timeout_ns; /* longest wait */
    int64_t until_ns;   /* when Python has something to do at the latest */
    int64_t begun_ns;   /* when the last call began */
    int64_t asked_ns;   /* when the writers were last asked whether they live */
    int64_t process;    /* whose readers these are: the child of a fork has none */
    place places[MOST_RINGS];
    wait_entry words[MOST_RINGS];
} skinware_native_take;

SKINWARE_EXPORT int skinware_native_take_now(skinware_native_take *take, unsigned char *to);
SKINWARE_EXPORT int skinware_native_take_next(skinware_native_take *take, unsigned char *to);

static int64_t least(int64_t a, int64_t b) {
    return a < b ? a : b;
}

/* The caller makes sure that there is room for it. */
static void note_turn(skinware_native_reader *reader, int64_t acquired_ns, int64_t taken_ns, int64_t ended_ns,
                      int64_t cpu_ns) {
    turn *over = &reader->turns[reader->noted++];
    over->acquired_ns = acquired_ns;
    over->taken_ns = taken_ns;
    over->ended_ns = ended_ns;
    over->cpu_ns = cpu_ns;
}

static void end_turn(skinware_native_reader *reader, int64_t now_ns) {
    if (reader->taken_ns == 0)
        return;
    note_turn(reader, reader->acquired_ns, reader->taken_ns, now_ns, skinware__clock_ns(CLOCK_THREAD_CPUTIME_ID));
    reader->taken_ns = 0;
}

/* The present value of every wake word, to be read before looking for news. */
static void read_words(skinware_native_take *take) {
    uint64_t i;
    for (i = 0; i < take->count; i++) {
        const unsigned char *word = take->places[i].reader->ring.map + SKINWARE__WAKE_WORD_OFFSET;
        take->words[i].address = (uint64_t)(uintptr_t)word;
        take->words[i].value = skinware__load_32(word);
        take->words[i].flags = 2; /* FUTEX_32, between processes */
    }
}

static int look_for_news(const skinware_native_take *take) {
    int found = take->wanted == NEWEST ? NEWS : NO_NEWS;
    uint64_t i;
    for (i = 0; i < take->count; i++) {
        const skinware_native_reader *reader = take->places[i].reader;
        const int has_ended = (skinware__load_32(reader->ring.map + SKINWARE__STATE_OFFSET) & 6u) != 0;
        if (reader->last == 0 || reader->taken_ns != 0 || reader->noted == TURNS || has_ended)
            return PYTHONS_TURN;
        if (skinware__latest(&reader->ring) != reader->last)
            found = NEWS;
    }
    return found;
}

static int writers_live(skinware_native_take *take, int64_t now_ns) {
    uint64_t i;
    for (i = 0; i < take->count; i++)
        if (!skinware__lives((int)take->places[i].reader->descriptor, (int)take->places[i].reader->writer))
            return 0;
    take->asked_ns = now_ns;
    return 1;
}

/* Sleeps until a wake word is another, or the time comes. 0: this kernel cannot. */
static int sleep_on_words(const skinware_native_take *take, int64_t now_ns, int64_t until_ns) {
    struct {
        int64_t seconds, nanoseconds;
    } until;
    if (take->count == 1) {
        (void)skinware__sleep(take->places[0].reader->ring.map + SKINWARE__WAKE_WORD_OFFSET,
                              (uint32_t)take->words[0].value, until_ns - now_ns);
        return 1;
    }
    until.seconds = until_ns / 1000000000;
    until.nanoseconds = until_ns % 1000000000;
    return syscall(449 /* SYS_futex_waitv */, take->words, (unsigned)take->count, 0, &until, CLOCK_MONOTONIC) >= 0 ||
           errno == EAGAIN || errno == EINTR || errno == ETIMEDOUT;
}

static int copy_all(const skinware_native_take *take, unsigned char *to) {
    int64_t taken_ns;
    uint64_t i;
    for (i = 0; i < take->count; i++) {
        const place *at = &take->places[i];
        uint64_t sequence = at->reader->last + 1;
        if (take->wanted != NEXT)
            sequence = skinware__copy_newest(&at->reader->ring, to + at->start, SKINWARE__COPY_ATTEMPTS);
        else if (!skinware__copy(&at->reader->ring, sequence, to + at->start))
            return PYTHONS_TURN;
        if (sequence < at->reader->last || sequence == UINT64_MAX)
            return PYTHONS_TURN;
    }
    taken_ns = skinware__clock_ns(CLOCK_MONOTONIC);
    for (i = 0; i < take->count; i++) {
        skinware_native_reader *reader = take->places[i].reader;
        const skinware__slot *slot = (const skinware__slot *)(const void *)(to + take->places[i].start);
        reader->missed += slot->sequence > reader->last + 1 ? slot->sequence - reader->last - 1 : 0;
        reader->frames++;
        reader->last = slot->sequence;
        if (take->is_loop) {
            reader->acquired_ns = slot->acquired_ns;
            reader->taken_ns = taken_ns;
        } else {
            note_turn(reader, slot->acquired_ns, taken_ns, taken_ns, 0);
        }
    }
    return NEWS;
}

/*
 * Copies a sample of every ring, and counts them once all are there.
 *
 * In a loop, a sample that is there without a sleep may be a dead writer's; one that is slept for is not. Other readers
 * find out within a slice.
 */
static int take_samples(skinware_native_take *take, unsigned char *to, int may_sleep) {
    const int64_t now_ns = skinware__clock_ns(CLOCK_MONOTONIC);
    int64_t until_ns;
    int found;
    take->begun_ns = now_ns;
    if (take->process != getpid())
        return PYTHONS_TURN;
    if (take->is_loop)
        end_turn(take->places[0].reader, now_ns);
    else if (now_ns - take->asked_ns >= SLICE_NS && !writers_live(take, now_ns))
        return PYTHONS_TURN;
    if (may_sleep)
        read_words(take);
    found = look_for_news(take);
    if (found == NEWS && take->is_loop && !writers_live(take, now_ns))
        return PYTHONS_TURN;
    until_ns = least(now_ns + least(SLICE_NS, take->timeout_ns), take->until_ns);
    if (found == NO_NEWS && may_sleep && now_ns < until_ns) {
        if (!sleep_on_words(take, now_ns, until_ns))
            return PYTHONS_TURN;
        found = look_for_news(take);
    }
    return found == NEWS ? copy_all(take, to) : found;
}

/* Never sleeps. */
int skinware_native_take_now(skinware_native_take *take, unsigned char *to) {
    return take_samples(take, to, 0);
}

int skinware_native_take_next(skinware_native_take *take, unsigned char *to) {
    return take_samples(take, to, 1);
}

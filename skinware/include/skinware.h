/*
 * skinware.h - read robot skin from C or C++: one header, no library, nothing but libc and Linux.
 *
 * A driver publishes frames in shared memory; any number of programs read them, at their own rate, without disturbing
 * the driver or each other. docs/reference/shared-memory.md has the format byte by byte. This header reads version 1.x.
 *
 * In exactly one source file of your program, before any other #include:
 *
 *     #define SKINWARE_IMPLEMENTATION
 *     #include <skinware.h>
 *
 * and in all others just the #include. So the system headers that the implementation needs stay in that one file, the
 * rest of your program sees <stddef.h> and <stdint.h> only, and the code exists once. Compile with
 *
 *     cc -I"$(python -c 'import skinware; print(skinware.get_include())')" program.c
 *
 * A loop that reads every new frame:
 *
 *     skinware_reader *reader;
 *     skinware_frame frame = SKINWARE_FRAME_INIT;
 *     skinware_result result = skinware_attach(&reader, NULL, "roboskin");
 *     if (result != SKINWARE_OK) {
 *         fprintf(stderr, "%s: %s\n", skinware_text(result), skinware_reason());
 *         exit(1);
 *     }
 *     const skinware_column *values = skinware_find_column(reader, "values");
 *     for (;;) {
 *         result = skinware_wait(reader, &frame, skinware_now_ns() + 1000000000);
 *         if (result == SKINWARE_RESTARTED) {
 *             if (skinware_reattach(reader) == SKINWARE_STRUCTURE_CHANGED)
 *                 values = skinware_find_column(reader, "values");
 *         } else if (result == SKINWARE_OK && skinware_read(reader, &frame) == SKINWARE_OK) {
 *             const uint16_t *raw = (const uint16_t *)skinware_data(&frame, values);
 *             ... values->count of them, all published at the same moment ...
 *         }
 *     }
 *
 * docs/how-to/c-and-cpp.md is that program in full.
 *
 * Rules
 *  - A reader is for one thread at a time; make one per thread. Nothing here is locked or shared between readers.
 *  - What a reader hands out (columns, types, tables, views) holds until skinware_reattach or skinware_detach.
 *  - Times are nanoseconds of CLOCK_MONOTONIC, also deadlines.
 *  - A file is checked before it is mapped, and what was checked is not read again from shared memory: a damaged file
 *    is refused, or read within its bounds. The one thing no reader can guard against is the file's owner making a
 *    published file shorter (SIGBUS); no Skinware writer does that, and files of anybody else are refused.
 *
 * Copyright: the Skinware authors. SPDX-License-Identifier: Apache-2.0
 */

/* Before any system header: openat, O_PATH, syscall. Only where the implementation is, or the ring alone. */
#if (defined(SKINWARE_IMPLEMENTATION) || defined(SKINWARE_RING)) && !defined(_GNU_SOURCE)
#define _GNU_SOURCE 1
#endif

#ifndef SKINWARE_H
#define SKINWARE_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The version of the format that this header reads: every minor version of this major one. */
#define SKINWARE_FORMAT_MAJOR 1
#define SKINWARE_FORMAT_MINOR 0

/* A deadline that never comes. */
#define SKINWARE_FOREVER INT64_MAX

/* Results of the functions. skinware_text describes each. */
typedef enum skinware_result {
    SKINWARE_OK = 0,

    /* Normal results of waiting and reading. */
    SKINWARE_TIMEOUT = 1,           /* the deadline passed; the writer is running but has published nothing newer */
    SKINWARE_EMPTY = 2,             /* this generation has published nothing yet */
    SKINWARE_PAUSED = 3,            /* the writer has paused */
    SKINWARE_GONE = 4,              /* the writer died or was closed; its last frame can still be read */
    SKINWARE_RESTARTED = 5,         /* there is a newer generation of the service: call skinware_reattach */
    SKINWARE_STRUCTURE_CHANGED = 6, /* reattached, but columns or sensors have changed: look everything up again */
    SKINWARE_INTERRUPTED = 7,       /* a signal handler ran during the wait */

    /* Errors; skinware_reason has the details. */
    SKINWARE_OVERRUN = 16,      /* the writer overwrote the frame during each of many attempts to copy it */
    SKINWARE_NOT_FOUND = 17,    /* no such service, or no such namespace */
    SKINWARE_BAD_NAME = 18,     /* not a valid name of a service or namespace */
    SKINWARE_BAD_NAMESPACE = 19, /* the namespace's folder cannot be trusted or read */
    SKINWARE_BAD_FILE = 20,     /* the service's file cannot be read safely */
    SKINWARE_NO_MEMORY = 21,    /* out of memory, or the file is too large for this process */
    SKINWARE_SYSTEM = 22        /* a system call failed unexpectedly; errno has the reason */
} skinware_result;

/* Bits of skinware_state. Ignore unknown bits. */
#define SKINWARE_STATE_PAUSED 1u     /* the writer publishes nothing until it resumes */
#define SKINWARE_STATE_SUPERSEDED 2u /* a newer generation exists under the same name */
#define SKINWARE_STATE_CLOSED 4u     /* the writer closed it in good order */

/* Bits of a sensor's status (column "status" of a driver); 0: good when it was published. Treat unknown bits as "not good". */
#define SKINWARE_STATUS_NEVER_SEEN 1u     /* no value since the driver started; the value is meaningless */
#define SKINWARE_STATUS_STALE 2u          /* older than the patch's last update, or the patch went silent */
#define SKINWARE_STATUS_OUT_OF_RANGE 4u   /* the true value is beyond the measuring range */
#define SKINWARE_STATUS_NO_ACK 8u         /* the transducer does not answer its patch's microcontroller */
#define SKINWARE_STATUS_NOT_CONNECTED 16u /* the hardware says that no transducer is connected */
#define SKINWARE_STATUS_MASKED 32u        /* switched off by configuration */
#define SKINWARE_STATUS_SUSPECT 64u       /* something happened that makes the value doubtful */
#define SKINWARE_STATUS_UNHEALTHY 128u    /* stuck, noisy, dead ... for minutes: the value is doubtful */

/* State of a bus (column "bus_state" of a driver). Treat an unknown state as "not live". */
#define SKINWARE_BUS_CONNECTING 0u
#define SKINWARE_BUS_LIVE 1u
#define SKINWARE_BUS_SILENT 2u
#define SKINWARE_BUS_DOWN 3u
#define SKINWARE_BUS_GONE 4u

/*
 * Why a bus is in its state (column "bus_reason", which not every driver has; since when: "bus_since_ns",
 * CLOCK_MONOTONIC ns). A live bus can have a reason too. Treat an unknown reason as "something is wrong".
 */
#define SKINWARE_BUS_REASON_NONE 0u
#define SKINWARE_BUS_REASON_NOTHING_HEARD 1u
#define SKINWARE_BUS_REASON_INTERFACE_DOWN 2u
#define SKINWARE_BUS_REASON_INTERFACE_GONE 3u
#define SKINWARE_BUS_REASON_REFUSED 4u
#define SKINWARE_BUS_REASON_FAILED 5u
#define SKINWARE_BUS_REASON_BUS_OFF 6u
#define SKINWARE_BUS_REASON_ERROR_PASSIVE 7u
#define SKINWARE_BUS_REASON_ERROR_WARNING 8u
#define SKINWARE_BUS_REASON_OVERFLOW 9u
#define SKINWARE_BUS_REASON_NO_ACKNOWLEDGEMENT 10u
#define SKINWARE_BUS_REASON_BUS_ERRORS 11u
#define SKINWARE_BUS_REASON_REMOVED 12u
#define SKINWARE_BUS_REASON_SET_ASIDE 13u

/* An attached service. */
typedef struct skinware_reader skinware_reader;

/* One named array: a column of every frame, or a table that was written once. */
typedef struct skinware_column {
    char name[25];     /* with a NUL */
    char kind;         /* 'u' unsigned, 'i' signed, 'f' floating point, 'S' text filled up with NUL, 'V' other bytes */
    uint32_t itemsize; /* bytes of one element */
    uint64_t count;    /* elements */
    uint64_t offset;   /* bytes from the start of the slot (columns) or of the file (tables) */
    int in_slot;       /* 1: a column of every frame, 0: a table */
} skinware_column;

/* A sensor type of a driver. The physical value of a raw value is offset + scale * raw, in unit. */
typedef struct skinware_type {
    uint32_t id;     /* vendor << 12 | number; vendor 0 is the shared catalogue ("pressure", "temperature", ...) */
    char name[33];   /* with a NUL, UTF-8 */
    char unit[17];   /* with a NUL, UTF-8 */
    double scale;    /* physical units per raw count */
    double offset;   /* physical value of raw 0 */
    double minimum;  /* smallest physical value that the sensor can report, or -infinity */
    double maximum;  /* largest physical value that the sensor can report, or +infinity */
} skinware_type;

/* One frame: a private copy (skinware_read), or the ring's own memory (skinware_view). */
typedef struct skinware_frame {
    uint64_t generation;  /* which generation of the service; 0: this frame was never filled */
    uint64_t sequence;    /* 1, 2, 3 ... within the generation; a gap: frames that you did not read */
    int64_t acquired_ns;  /* newest time stamp of the data in it */
    int64_t published_ns; /* when the writer published it */
    uint64_t flags;       /* bits for the service's own use */
    int stale;            /* the writer was dead or closed when the frame was read: no newer one follows */

    /* The rest belongs to this header. */
    const unsigned char *bytes;
    size_t size;
    unsigned char *buffer;
    size_t capacity;
} skinware_frame;

/* The initial value of a frame. Free it with skinware_frame_free. */
#define SKINWARE_FRAME_INIT {0, 0, 0, 0, 0, 0, NULL, 0, NULL, 0}

/* -- attaching ---------------------------------------------------------------------------------------------------- */

/*
 * Attach to a service. One whose writer is dead can be attached to as well, for its last frame.
 *
 * name_space: NULL for the one of the environment variable SKINWARE_NAMESPACE, or "default".
 * service:    a driver's or service's name, as skin-info shows it.
 *
 * The namespace's folder must belong to this user, to root or to the user (name or number) of the environment variable
 * SKINWARE_OWNER; must be no symbolic link and not writable for others; and the file must belong to the same user.
 * Returns OK, NOT_FOUND, BAD_NAME, BAD_NAMESPACE, BAD_FILE, NO_MEMORY or SYSTEM; *reader is NULL unless OK.
 */
skinware_result skinware_attach(skinware_reader **reader, const char *name_space, const char *service);

/*
 * Attach to the current generation of the service, after RESTARTED.
 *
 * OK: the structure is the same. Columns and types that were looked up are still valid; tables and views are not.
 * STRUCTURE_CHANGED: also attached, but look everything up again.
 * Anything else (as skinware_attach): the reader is unchanged.
 */
skinware_result skinware_reattach(skinware_reader *reader);

/* Detach; NULL is allowed. Copied frames remain valid, views do not. */
void skinware_detach(skinware_reader *reader);

/* -- frames ------------------------------------------------------------------------------------------------------- */

/*
 * Wait for a frame that is newer than a given one (NULL, or a frame that was never filled: for any frame).
 *
 * OK: there is one; read it. RESTARTED: the service came back; reattach.
 * GONE, PAUSED: returned at once (a killed writer within 50 ms), but only once: the next call waits until its deadline
 * for the writer to come back, so that a loop around this function never spins.
 * TIMEOUT, and GONE or PAUSED once more: the deadline came. If it has passed already, this function does not wait.
 * INTERRUPTED: a signal handler ran. A signal that comes just before the wait does not end it: keep deadlines short
 * where handlers set a flag.
 * SYSTEM: the kernel refused to wait.
 */
skinware_result skinware_wait(skinware_reader *reader, const skinware_frame *newer_than, int64_t deadline_ns);

/*
 * Copy the newest frame; all its columns were published at the same moment. Does not wait.
 *
 * The first call allocates the frame's memory; later ones reuse it.
 * Returns OK, EMPTY, OVERRUN or NO_MEMORY. After OVERRUN the frame is as if it had never been filled; after the other
 * two it is unchanged.
 */
skinware_result skinware_read(skinware_reader *reader, skinware_frame *frame);

/*
 * The newest frame in place, without a copy. The writer goes on: first use the data, then ask skinware_valid, and only
 * if that says so, trust what you computed. Values may be torn until then, so do not index or divide by them.
 *
 * Returns OK, EMPTY or OVERRUN; the frame is unchanged unless OK.
 */
skinware_result skinware_view(skinware_reader *reader, skinware_frame *frame);

/* Returns whether a frame is whole: always 1 for a copy, 1 for a view until the writer begins to overwrite it. */
int skinware_valid(const skinware_frame *frame);

/* The elements of a column in a frame, aligned to 64 bytes in views and to 16 in copies; NULL if there are none. */
const void *skinware_data(const skinware_frame *frame, const skinware_column *column);

/* Free a frame's memory. */
void skinware_frame_free(skinware_frame *frame);

/* -- what a service is made of ------------------------------------------------------------------------------------ */

/* A column of every frame by name ("values", "status", "module_time_ns" ...), NULL if there is none. */
const skinware_column *skinware_find_column(const skinware_reader *reader, const char *name);

/* A table (static column) by name ("sensor_uid", "module_patch" ...), NULL if there is none. */
const skinware_column *skinware_find_table(const skinware_reader *reader, const char *name);

/* The elements of a table, in read-only shared memory; NULL if the table is not one of this reader. */
const void *skinware_table_data(const skinware_reader *reader, const skinware_column *table);

/* All columns and tables, in the order of the file. */
size_t skinware_column_count(const skinware_reader *reader);
const skinware_column *skinware_column_at(const skinware_reader *reader, size_t index);

/* One element of a column or table as a double, whatever its integer or floating-point type; NaN for all others. */
double skinware_number(const skinware_column *column, const void *data, size_t index);

/* -- drivers: sensors by type ------------------------------------------------------------------------------------- */

/* Returns whether the service is a driver: a skin with sensors. Its tables were then checked. */
int skinware_is_driver(const skinware_reader *reader);

/* The sensor types of a driver; 0 if the service is no driver. */
size_t skinware_type_count(const skinware_reader *reader);
const skinware_type *skinware_type_at(const skinware_reader *reader, size_t index);
const skinware_type *skinware_find_type(const skinware_reader *reader, const char *name);

/*
 * Positions of the sensors of a type in "values" and "status", ascending.
 *
 * Writes at most capacity of them; returns how many there are, so skinware_sensors(reader, type, NULL, 0) counts them.
 */
size_t skinware_sensors(const skinware_reader *reader, const skinware_type *type, uint32_t *positions, size_t capacity);

/*
 * Physical values of a driver's sensors, in the type's unit: out[i] is that of the sensor at positions[i].
 *
 * A float holds seven digits; where raw values are int32 and all of them matter, compute offset + scale * raw yourself.
 *
 * Returns how many were written: count, or 0 if the frame has no such column or a position lies outside it.
 */
size_t skinware_physical(const skinware_frame *frame, const skinware_column *values, const skinware_type *type,
                         const uint32_t *positions, size_t count, float *out);

/*
 * Which of a driver's sensors can be trusted now: out[i] is 1 if the sensor at positions[i] has the status 0, data that
 * is not too old, and a driver that was running when the frame was read; else 0. The status alone is not enough: it
 * belongs to the frame, and a driver that hangs leaves it at 0.
 *
 * max_age_ns: data that is older is not fresh; 0 for the default: three periods of each sensor (of its update group, or
 * else of the driver) and at least 0.2 s, or 1 s if there is no period.
 *
 * Returns how many are fresh; 0 also if this is no driver's frame, or a position lies outside it.
 */
size_t skinware_fresh(const skinware_reader *reader, const skinware_frame *frame, int64_t max_age_ns,
                      const uint32_t *positions, size_t count, unsigned char *out);

/* -- the state of things ------------------------------------------------------------------------------------------ */

/* Returns whether the writer of this generation is running (it may still publish nothing). One system call. */
int skinware_is_alive(const skinware_reader *reader);

/* SKINWARE_STATE_* bits of this generation. */
uint32_t skinware_state(const skinware_reader *reader);

/* Sequence of the newest frame, 0 before the first. */
uint64_t skinware_latest(const skinware_reader *reader);

/* The number of the generation that is being read; no two generations of a service have the same. */
uint64_t skinware_generation(const skinware_reader *reader);

/*
 * Frames that the generations before this one published. This number plus a frame's sequence counts through restarts,
 * so that a gap in it is frames that you did not take.
 */
uint64_t skinware_published_before(const skinware_reader *reader);

/* The writer's nominal period, 0 if it has none. */
int64_t skinware_period_ns(const skinware_reader *reader);

/* Number of frames that the ring holds, 2 to 64. */
uint32_t skinware_slot_count(const skinware_reader *reader);

/* Process id of the writer, in its own pid namespace. */
uint64_t skinware_writer_pid(const skinware_reader *reader);

/* Kind of service: "driver" or "data". */
const char *skinware_kind(const skinware_reader *reader);

/* 32 bytes that are equal for services of equal structure. */
const unsigned char *skinware_digest(const skinware_reader *reader);

/* CLOCK_MONOTONIC, nanoseconds. */
int64_t skinware_now_ns(void);

/* A description of a result. */
const char *skinware_text(skinware_result result);

/* Details of the last error that a call of this thread returned; "" if there are none. */
const char *skinware_reason(void);

#ifdef __cplusplus
}
#endif

#endif /* SKINWARE_H */

/* ================================================================================================================= */

/*
 * The ring: where its words are, and how a slot is read while the writer goes on. Skinware's own native code defines
 * SKINWARE_RING to share this part; programs have no use for it.
 */
#if (defined(SKINWARE_IMPLEMENTATION) || defined(SKINWARE_RING)) && !defined(SKINWARE_RING_INCLUDED)
#define SKINWARE_RING_INCLUDED

#ifndef __GNUC__
#error "skinware.h needs the __atomic builtins of GCC or Clang"
#endif
#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "Skinware's shared memory is little-endian; this machine is not supported"
#endif
#if __GCC_ATOMIC_LLONG_LOCK_FREE != 2 || __GCC_ATOMIC_INT_LOCK_FREE != 2
#error "Skinware needs lock-free 64-bit loads, which this processor does not have"
#endif

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <string.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#ifndef O_CLOEXEC
#error "define SKINWARE_IMPLEMENTATION and include skinware.h before any other header, or define _GNU_SOURCE"
#endif
#ifndef F_OFD_GETLK
#define F_OFD_GETLK 36
#endif

/* The header of a slot. Every member lies on a multiple of its size: there are no hidden gaps on any processor. */
typedef struct skinware__slot {
    uint64_t sequence;
    int64_t acquired_ns;
    int64_t published_ns;
    uint64_t flags;
    unsigned char reserved[32];
} skinware__slot;

typedef char skinware__slot_has_64_bytes[sizeof(skinware__slot) == 64 ? 1 : -1];

#define SKINWARE__AHEAD_NS 200000000 /* how far ahead of the clock a stamp may be: clocks of two machines differ a little */

enum { SKINWARE__LATEST_OFFSET = 512, SKINWARE__WAKE_WORD_OFFSET = 520, SKINWARE__STATE_OFFSET = 524 };

/* A mapped file, and where its slots are. */
typedef struct skinware__ring {
    const unsigned char *map;
    uint64_t slot_offset;
    uint64_t slot_stride;
    uint64_t slot_count;
} skinware__ring;

/* Words of 8 bytes lie on multiples of 8, also where the compiler expects no more than 4. */
typedef uint64_t skinware__word __attribute__((aligned(8)));

static inline uint64_t skinware__load_64(const unsigned char *at) {
    return __atomic_load_n((const skinware__word *)(const void *)at, __ATOMIC_ACQUIRE);
}

static inline uint32_t skinware__load_32(const unsigned char *at) {
    return __atomic_load_n((const uint32_t *)(const void *)at, __ATOMIC_ACQUIRE);
}

static inline uint64_t skinware__latest(const skinware__ring *ring) {
    return skinware__load_64(ring->map + SKINWARE__LATEST_OFFSET);
}

static inline const unsigned char *skinware__slot_at(const skinware__ring *ring, uint64_t sequence) {
    return ring->map + ring->slot_offset + (sequence % ring->slot_count) * ring->slot_stride;
}

/* The second look at a slot's sequence: everything that was read before this call was read before this load. */
static inline int skinware__still(const unsigned char *slot, uint64_t sequence) {
    __atomic_thread_fence(__ATOMIC_ACQUIRE);
    return __atomic_load_n((const skinware__word *)(const void *)slot, __ATOMIC_RELAXED) == sequence;
}

/*
 * Copies what the writer may overwrite meanwhile: a race that the sequence decides afterwards, which no checker of
 * races can know. For it the words are copied one by one, so that it still finds all others.
 */
static inline void skinware__copy_bytes(unsigned char *to, const unsigned char *from, uint64_t size) {
#ifdef __SANITIZE_THREAD__
    uint64_t i;
    for (i = 0; i < size; i += 8) { /* strides are multiples of 64 */
        const uint64_t word = __atomic_load_n((const skinware__word *)(const void *)(from + i), __ATOMIC_RELAXED);
        memcpy(to + i, &word, 8);
    }
#else
    memcpy(to, from, (size_t)size);
#endif
}

/* Copies the slot of a frame, its header first; 1 if the copy is that frame and whole, 0 if it is not in the ring. */
static inline int skinware__copy(const skinware__ring *ring, uint64_t sequence, unsigned char *to) {
    const unsigned char *slot = skinware__slot_at(ring, sequence);
    if (skinware__load_64(slot) != sequence)
        return 0;
    skinware__copy_bytes(to, slot, ring->slot_stride);
    return skinware__still(slot, sequence);
}

/* Copies the newest frame: its sequence, 0 if nothing was published yet, UINT64_MAX if the writer was always faster. */
static inline uint64_t skinware__copy_newest(const skinware__ring *ring, unsigned char *to, int attempts) {
    while (attempts-- > 0) {
        const uint64_t sequence = skinware__latest(ring);
        if (sequence == 0 || skinware__copy(ring, sequence, to))
            return sequence;
    }
    return UINT64_MAX;
}

/* Returns whether the writer of a file still holds its lock. */
static inline int skinware__is_locked(int fd) {
    struct flock lock;
    memset(&lock, 0, sizeof lock);
    lock.l_type = F_RDLCK;
    lock.l_whence = SEEK_SET;
    return fcntl(fd, F_OFD_GETLK, &lock) == 0 && lock.l_type == F_WRLCK;
}

/* In the place of a pidfd: nothing can be known of the process, or it has ended. */
enum { SKINWARE__UNKNOWN = -1, SKINWARE__ENDED = -2 };

/*
 * Returns whether the writer of a file lives: its lock is held, and the process that made the file has not ended. A
 * child that C code forked keeps the lock of a dead parent.
 */
static inline int skinware__lives(int fd, int process) {
    struct pollfd ended;
    ended.fd = process; /* poll passes over what is below 0 */
    ended.events = POLLIN;
    ended.revents = 0;
    return process != SKINWARE__ENDED && skinware__is_locked(fd) && poll(&ended, 1, 0) <= 0;
}

/* Sleep until the word is woken or differs from expected, or the time is up. 0, or the number of an error. */
static inline int skinware__sleep(const unsigned char *word, uint32_t expected, int64_t timeout_ns) {
#ifdef SYS_futex
    struct {
        long seconds, nanoseconds; /* the kernel's old timespec, whatever the C library's is */
    } timeout;
    const long call = SYS_futex;
    timeout.seconds = (long)(timeout_ns / 1000000000);
    timeout.nanoseconds = (long)(timeout_ns % 1000000000);
#else
    struct {
        int64_t seconds, nanoseconds;
    } timeout;
    const long call = SYS_futex_time64;
    timeout.seconds = timeout_ns / 1000000000;
    timeout.nanoseconds = timeout_ns % 1000000000;
#endif
    /* FUTEX_WAIT without FUTEX_PRIVATE_FLAG: the writer is another process */
    return syscall(call, word, 0, expected, &timeout, NULL, 0) < 0 ? errno : 0;
}

#endif /* the ring */

#if defined(SKINWARE_IMPLEMENTATION) && !defined(SKINWARE_IMPLEMENTED)
#define SKINWARE_IMPLEMENTED

#include <pwd.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/stat.h>

#ifdef O_PATH
#define SKINWARE__FOLDER_FLAGS (O_PATH | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC)
#else
#define SKINWARE__FOLDER_FLAGS (O_RDONLY | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC)
#endif

/* Header and column table, as docs/reference/shared-memory.md has them. Every member lies on a multiple of
 * its size, so that these structures have no hidden gaps on any processor. */

typedef struct skinware__header {
    char magic[8];
    uint32_t version_major;
    uint32_t version_minor;
    uint64_t file_size;
    uint64_t generation;
    int64_t created_ns;
    uint32_t column_count;
    uint32_t slot_count;
    uint64_t slot_offset;
    uint64_t slot_stride;
    uint64_t writer_pid;
    uint64_t writer_start_ticks;
    uint64_t pid_namespace;
    int64_t period_ns;
    char kind[16];
    char name[48];
    unsigned char digest[32];
    uint64_t published_before;
    unsigned char reserved[312];
} skinware__header;

typedef struct skinware__row {
    char name[24];
    char dtype[8];
    uint64_t count;
    uint64_t offset;
    uint32_t in_slot;
    unsigned char reserved[12];
} skinware__row;

enum {
    SKINWARE__COLUMN_OFFSET = 1152,
    SKINWARE__MAX_COLUMNS = 256,
    SKINWARE__MIN_SLOTS = 2,
    SKINWARE__MAX_SLOTS = 64,
    SKINWARE__PAGE = 4096, /* of the format, whatever the machine's pages are */
    SKINWARE__ALIGNMENT = 64,
    SKINWARE__ATTEMPTS = 1000
};

static const int64_t skinware__slice_ns = 50000000;

typedef char skinware__header_has_512_bytes[sizeof(skinware__header) == 512 ? 1 : -1];
typedef char skinware__row_has_64_bytes[sizeof(skinware__row) == 64 ? 1 : -1];
typedef char skinware__files_have_64_bit_offsets[sizeof(off_t) == 8 ? 1 : -1]; /* else: -D_FILE_OFFSET_BITS=64 */

struct skinware_reader {
    char name_space[48];
    char service[48];
    int fd;      /* asks whether the writer's lock is held; takes none */
    int process; /* pidfd of the writer, SKINWARE__UNKNOWN or SKINWARE__ENDED */
    dev_t device;
    ino_t inode;
    skinware__ring ring;
    size_t map_size;
    skinware__header header; /* a private copy: what was checked stays so */
    skinware__row rows[SKINWARE__MAX_COLUMNS];
    skinware_column columns[SKINWARE__MAX_COLUMNS];
    char kind[17];
    skinware_type *types;
    size_t type_count;
    int told_gone;
    int told_paused;
};

static __thread const char *skinware__reason = "";

static skinware_result skinware__fail(skinware_result result, const char *reason) {
    skinware__reason = reason;
    return result;
}

/* -- checking ----------------------------------------------------------------------------------------------------- */

/* Names: a letter or digit, then up to 46 letters, digits, '_' or '-'. */
static int skinware__is_name(const char *name) {
    size_t length = 0;
    for (; name[length] != '\0'; length++) {
        const char c = name[length];
        const int alphanumeric = (c >= '0' && c <= '9') || (c >= 'A' && c <= 'Z') || (c >= 'a' && c <= 'z');
        if (length >= 47 || !(alphanumeric || (length > 0 && (c == '_' || c == '-'))))
            return 0;
    }
    return length > 0;
}

/* Copies text that fills a field or is filled up with NULs, and ends it with one; 0 if more comes after a NUL. */
static int skinware__copy_text(char *to, const char *from, size_t size) {
    size_t i, length = 0;
    while (length < size && from[length] != '\0')
        length++;
    memcpy(to, from, length);
    memset(to + length, 0, size + 1 - length);
    for (i = length; i < size; i++)
        if (from[i] != '\0')
            return 0;
    return 1;
}

static int skinware__is_number(char kind) {
    return kind == 'u' || kind == 'i' || kind == 'f';
}

/* A dtype code as numpy writes it: '<' or '|', kind, size in decimal. 0 if it is none that a column may have. */
static int skinware__parse_dtype(const char code[9], char *kind, uint32_t *itemsize) {
    uint32_t size = 0;
    size_t i;
    const int is_text = code[1] == 'S' || code[1] == 'V';
    if ((code[0] != '<' && code[0] != '|') || !(is_text || skinware__is_number(code[1])) || code[2] == '0')
        return 0;
    for (i = 2; code[i] != '\0'; i++) { /* at most six digits: no overflow */
        if (code[i] < '0' || code[i] > '9')
            return 0;
        size = size * 10 + (uint32_t)(code[i] - '0');
    }
    *kind = code[1];
    *itemsize = size;
    if (code[0] != (is_text || size == 1 ? '|' : '<')) /* as a writer writes it, and not otherwise */
        return 0;
    if (is_text)
        return size > 0;
    if (*kind == 'f')
        return size == 2 || size == 4 || size == 8 || size == 16;
    return size == 1 || size == 2 || size == 4 || size == 8;
}

static skinware_result skinware__check_column(const skinware__header *header, const skinware__row *row,
                                              skinware_column *column) {
    const uint64_t table_end = SKINWARE__COLUMN_OFFSET + sizeof(skinware__row) * (uint64_t)header->column_count;
    char code[9];
    uint64_t first, last;
    size_t i;
    if (!skinware__copy_text(column->name, row->name, sizeof row->name) || column->name[0] == '\0')
        return skinware__fail(SKINWARE_BAD_FILE, "a column has no proper name");
    for (i = 0; column->name[i] != '\0'; i++)
        if (column->name[i] < ' ' || column->name[i] > '~')
            return skinware__fail(SKINWARE_BAD_FILE, "a column's name is not printable ASCII");
    if (!skinware__copy_text(code, row->dtype, sizeof row->dtype) ||
        !skinware__parse_dtype(code, &column->kind, &column->itemsize))
        return skinware__fail(SKINWARE_BAD_FILE, "a column has a dtype that cannot be read");
    column->count = row->count;
    column->offset = row->offset;
    column->in_slot = row->in_slot != 0;
    first = column->in_slot ? sizeof(skinware__slot) : table_end;
    last = column->in_slot ? header->slot_stride : header->slot_offset;
    if (column->offset < first || column->offset > last || column->offset % SKINWARE__ALIGNMENT != 0)
        return skinware__fail(SKINWARE_BAD_FILE, "a column begins at a wrong place");
    if (column->count > (last - column->offset) / column->itemsize)
        return skinware__fail(SKINWARE_BAD_FILE, "a column lies outside its slot or table");
    return SKINWARE_OK;
}

/* Everything that is read later lies inside the file if this says OK. */
static skinware_result skinware__check_header(const skinware__header *header, uint64_t file_size) {
    uint64_t table_end;
    size_t i;
    if (memcmp(header->magic, "SKINRING", 8) != 0)
        return skinware__fail(SKINWARE_BAD_FILE, "not a Skinware service file (wrong magic)");
    if (header->version_major != SKINWARE_FORMAT_MAJOR)
        return skinware__fail(SKINWARE_BAD_FILE, "its layout version is not 1.x; use the header of that version");
    if (header->file_size != file_size || file_size > (uint64_t)1 << 32 || file_size % SKINWARE__PAGE != 0)
        return skinware__fail(SKINWARE_BAD_FILE, "truncated or absurd: the header says another size than the file has");
    for (i = 0; i < sizeof header->kind; i++)
        if ((unsigned char)header->kind[i] > 127)
            return skinware__fail(SKINWARE_BAD_FILE, "its kind is no text");
    if (header->column_count > SKINWARE__MAX_COLUMNS)
        return skinware__fail(SKINWARE_BAD_FILE, "its columns do not fit");
    table_end = SKINWARE__COLUMN_OFFSET + sizeof(skinware__row) * (uint64_t)header->column_count;
    if (header->slot_count < SKINWARE__MIN_SLOTS || header->slot_count > SKINWARE__MAX_SLOTS ||
        header->slot_stride < sizeof(skinware__slot) || header->slot_stride % SKINWARE__ALIGNMENT != 0 ||
        header->slot_offset % SKINWARE__PAGE != 0)
        return skinware__fail(SKINWARE_BAD_FILE, "its slots make no ring");
    if (header->slot_offset < table_end || header->slot_offset > file_size ||
        header->slot_stride > (file_size - header->slot_offset) / header->slot_count)
        return skinware__fail(SKINWARE_BAD_FILE, "the ring lies outside the file");
    return SKINWARE_OK;
}

static skinware_result skinware__parse(skinware_reader *reader, uint64_t file_size) {
    const size_t row_bytes = sizeof(skinware__row);
    skinware_result result;
    uint32_t i;
    if (file_size < SKINWARE__COLUMN_OFFSET ||
        pread(reader->fd, &reader->header, sizeof reader->header, 0) != (ssize_t)sizeof reader->header)
        return skinware__fail(SKINWARE_BAD_FILE, "shorter than a header");
    result = skinware__check_header(&reader->header, file_size);
    if (result != SKINWARE_OK)
        return result;
    if (pread(reader->fd, reader->rows, row_bytes * reader->header.column_count, SKINWARE__COLUMN_OFFSET) !=
        (ssize_t)(row_bytes * reader->header.column_count))
        return skinware__fail(SKINWARE_BAD_FILE, "its columns do not fit");
    for (i = 0; i < reader->header.column_count; i++) {
        result = skinware__check_column(&reader->header, &reader->rows[i], &reader->columns[i]);
        if (result != SKINWARE_OK)
            return result;
    }
    (void)skinware__copy_text(reader->kind, reader->header.kind, sizeof reader->header.kind);
    return SKINWARE_OK;
}

/* -- drivers ------------------------------------------------------------------------------------------------------ */

static int skinware__is(const skinware_column *column, char kind, uint32_t itemsize, uint64_t count) {
    return column != NULL && column->kind == kind && column->itemsize == itemsize && column->count == count;
}

/* A table of this dtype and length; NULL if there is none. */
static const unsigned char *skinware__table(const skinware_reader *reader, const char *name, char kind,
                                            uint32_t itemsize, uint64_t count) {
    const skinware_column *table = skinware_find_table(reader, name);
    return skinware__is(table, kind, itemsize, count) ? reader->ring.map + table->offset : NULL;
}

static uint64_t skinware__rows(const skinware_reader *reader, const char *name) {
    const skinware_column *table = skinware_find_table(reader, name);
    return table == NULL ? 0 : table->count;
}

/* Returns whether a table of row numbers points to rows that exist. */
static int skinware__points_within(const unsigned char *table, uint64_t count, uint64_t rows) {
    const uint32_t *row = (const uint32_t *)(const void *)table;
    uint64_t i;
    for (i = 0; i < count; i++)
        if (row[i] >= rows)
            return 0;
    return 1;
}

static skinware_result skinware__read_types(skinware_reader *reader) {
    const uint64_t count = skinware__rows(reader, "type_id");
    const unsigned char *id = skinware__table(reader, "type_id", 'u', 4, count);
    const unsigned char *name = skinware__table(reader, "type_name", 'S', 32, count);
    const unsigned char *unit = skinware__table(reader, "type_unit", 'S', 16, count);
    const unsigned char *scale = skinware__table(reader, "type_scale", 'f', 8, count);
    const unsigned char *offset = skinware__table(reader, "type_offset", 'f', 8, count);
    const unsigned char *minimum = skinware__table(reader, "type_minimum", 'f', 8, count);
    const unsigned char *maximum = skinware__table(reader, "type_maximum", 'f', 8, count);
    size_t i;
    if (!id || !name || !unit || !scale || !offset || !minimum || !maximum || count == 0)
        return skinware__fail(SKINWARE_BAD_FILE, "the driver's table of sensor types is missing or of a wrong form");
    reader->types = (skinware_type *)calloc((size_t)count, sizeof(skinware_type));
    if (reader->types == NULL)
        return skinware__fail(SKINWARE_NO_MEMORY, "no memory for the sensor types");
    reader->type_count = (size_t)count;
    for (i = 0; i < reader->type_count; i++) {
        skinware_type *type = &reader->types[i];
        memcpy(&type->id, id + 4 * i, 4);
        (void)skinware__copy_text(type->name, (const char *)name + 32 * i, 32);
        (void)skinware__copy_text(type->unit, (const char *)unit + 16 * i, 16);
        memcpy(&type->scale, scale + 8 * i, 8);
        memcpy(&type->offset, offset + 8 * i, 8);
        memcpy(&type->minimum, minimum + 8 * i, 8);
        memcpy(&type->maximum, maximum + 8 * i, 8);
    }
    return SKINWARE_OK;
}

/* Update groups: a file has their tables only where they are not simply the modules. */
static int skinware__groups_fit(const skinware_reader *reader, uint64_t modules, uint64_t sensors) {
    const uint64_t groups = skinware__rows(reader, "group_module");
    const skinware_column *times = skinware_find_column(reader, "group_time_ns");
    const unsigned char *sensor_group, *group_module;
    if (skinware_find_table(reader, "sensor_group") == NULL)
        return times == NULL || skinware__is(times, 'i', 8, modules);
    sensor_group = skinware__table(reader, "sensor_group", 'u', 4, sensors);
    group_module = skinware__table(reader, "group_module", 'u', 4, groups);
    return sensor_group && group_module && skinware__table(reader, "group_period_ns", 'i', 8, groups) &&
           (times != NULL ? skinware__is(times, 'i', 8, groups) : groups == modules) &&
           skinware__points_within(sensor_group, sensors, groups) &&
           skinware__points_within(group_module, groups, modules);
}

static skinware_result skinware__read_driver(skinware_reader *reader) {
    const uint64_t buses = skinware__rows(reader, "bus_name");
    const uint64_t patches = skinware__rows(reader, "patch_name");
    const uint64_t modules = skinware__rows(reader, "module_patch");
    const uint64_t sensors = skinware__rows(reader, "sensor_uid");
    const unsigned char *patch_bus = skinware__table(reader, "patch_bus", 'u', 4, patches);
    const unsigned char *module_patch = skinware__table(reader, "module_patch", 'u', 4, modules);
    const unsigned char *sensor_module = skinware__table(reader, "sensor_module", 'u', 4, sensors);
    const unsigned char *sensor_type = skinware__table(reader, "sensor_type", 'u', 4, sensors);
    const skinware_column *values = skinware_find_column(reader, "values");
    skinware_result result;
    uint64_t i;
    size_t k;
    if (!patch_bus || !module_patch || !sensor_module || !sensor_type ||
        !skinware__table(reader, "bus_name", 'S', 64, buses) ||
        !skinware__table(reader, "patch_name", 'S', 32, patches) ||
        !skinware__table(reader, "module_kind", 'S', 16, modules) ||
        !skinware__table(reader, "sensor_uid", 'u', 8, sensors) || sensors == 0 || sensors > UINT32_MAX)
        return skinware__fail(SKINWARE_BAD_FILE, "a table of the driver's structure is missing or of a wrong form");
    if (!(skinware__is(values, 'u', 1, sensors) || skinware__is(values, 'i', 2, sensors) ||
          skinware__is(values, 'u', 2, sensors) || skinware__is(values, 'i', 4, sensors) ||
          skinware__is(values, 'f', 4, sensors)) ||
        !skinware__is(skinware_find_column(reader, "status"), 'u', 1, sensors) ||
        !skinware__is(skinware_find_column(reader, "module_time_ns"), 'i', 8, modules) ||
        !skinware__is(skinware_find_column(reader, "patch_state"), 'u', 1, patches) ||
        !skinware__is(skinware_find_column(reader, "bus_state"), 'u', 1, buses))
        return skinware__fail(SKINWARE_BAD_FILE, "the driver's columns do not fit its structure");
    if (!skinware__groups_fit(reader, modules, sensors))
        return skinware__fail(SKINWARE_BAD_FILE, "the update groups of the driver do not fit its structure");
    if (!skinware__points_within(patch_bus, patches, buses) ||
        !skinware__points_within(module_patch, modules, patches) ||
        !skinware__points_within(sensor_module, sensors, modules))
        return skinware__fail(SKINWARE_BAD_FILE, "a row of the driver's structure belongs to one that does not exist");
    result = skinware__read_types(reader);
    for (i = 0; result == SKINWARE_OK && i < sensors; i++) {
        const uint32_t id = ((const uint32_t *)(const void *)sensor_type)[i];
        for (k = 0; k < reader->type_count && reader->types[k].id != id; k++)
            ;
        if (k == reader->type_count)
            result = skinware__fail(SKINWARE_BAD_FILE, "a sensor has a type that is not in the driver's table");
    }
    return result;
}

/* -- attaching ---------------------------------------------------------------------------------------------------- */

static const char *skinware__default_namespace(void) {
    const char *name = getenv("SKINWARE_NAMESPACE");
    return name != NULL && name[0] != '\0' ? name : "default";
}

/* The user of SKINWARE_OWNER. OK with *found 0: none is set. */
static skinware_result skinware__extra_owner(uid_t *owner, int *found) {
    const char *text = getenv("SKINWARE_OWNER");
    struct passwd entry, *answer = NULL;
    char buffer[4096];
    *found = 0;
    if (text == NULL || text[0] == '\0')
        return SKINWARE_OK;
    if (text[strspn(text, "0123456789")] == '\0')
        *owner = (uid_t)strtoul(text, NULL, 10);
    else if (getpwnam_r(text, &entry, buffer, sizeof buffer, &answer) == 0 && answer != NULL)
        *owner = answer->pw_uid;
    else
        return skinware__fail(SKINWARE_BAD_NAMESPACE, "SKINWARE_OWNER is no user of this machine");
    *found = 1;
    return SKINWARE_OK;
}

/* "/dev/shm/skinware.NAMESPACE", and "/SERVICE.ring" if there is a service. */
static void skinware__path(char path[160], const char *name_space, const char *service) {
    path[0] = '\0';
    strcat(strcat(path, "/dev/shm/skinware."), name_space); /* names have at most 47 characters */
    if (service != NULL)
        strcat(strcat(strcat(path, "/"), service), ".ring");
}

/* Opens the folder if it can be trusted. */
static skinware_result skinware__open_folder(const char *name_space, int *folder, uid_t *owner) {
    char path[160];
    struct stat info;
    uid_t extra = 0;
    int has_extra;
    skinware_result result = skinware__extra_owner(&extra, &has_extra);
    if (result != SKINWARE_OK)
        return result;
    skinware__path(path, name_space, NULL);
    *folder = open(path, SKINWARE__FOLDER_FLAGS);
    if (*folder < 0 && errno == ENOENT)
        return skinware__fail(SKINWARE_NOT_FOUND, "no driver has run in this namespace since the machine was started");
    if (*folder < 0 && (errno == ENOTDIR || errno == ELOOP))
        return skinware__fail(SKINWARE_BAD_NAMESPACE, "not a folder (a symbolic link is never followed); remove it");
    if (*folder < 0)
        return skinware__fail(SKINWARE_BAD_NAMESPACE, "the folder may not be read; ask to be added to its group");
    if (fstat(*folder, &info) != 0)
        result = skinware__fail(SKINWARE_SYSTEM, "fstat of the folder");
    else if (info.st_mode & 022)
        result = skinware__fail(SKINWARE_BAD_NAMESPACE, "the folder can be written by others; chmod 2750 it");
    else if (info.st_uid != geteuid() && info.st_uid != 0 && !(has_extra && info.st_uid == extra))
        result = skinware__fail(SKINWARE_BAD_NAMESPACE,
                                "the folder belongs to another account, not to you or root; if that is right, set"
                                " SKINWARE_OWNER to that user");
    *owner = info.st_uid;
    if (result != SKINWARE_OK)
        close(*folder);
    return result;
}

/* When a process started, in clock ticks since boot: field 22 of its stat in /proc; 0 if that cannot be read. */
static uint64_t skinware__start_ticks(uint64_t pid) {
    char path[48], text[1024];
    const char *at;
    int fd, field;
    ssize_t size;
    snprintf(path, sizeof path, "/proc/%llu/stat", (unsigned long long)pid);
    fd = open(path, O_RDONLY | O_CLOEXEC);
    if (fd < 0)
        return 0;
    size = read(fd, text, sizeof text - 1);
    close(fd);
    text[size > 0 ? size : 0] = '\0';
    at = strrchr(text, ')'); /* the name before it may contain anything */
    for (field = 2; at != NULL && field < 22; field++)
        at = strchr(at + 1, ' ');
    return at != NULL ? strtoull(at, NULL, 10) : 0;
}

/*
 * A pidfd of the process that made the file; SKINWARE__ENDED if it is gone; SKINWARE__UNKNOWN in another pid namespace,
 * with a /proc of another one, or before Linux 5.3: the lock alone decides then.
 */
static int skinware__watch(const skinware__header *header) {
    struct stat here;
    char self[24] = "";
    uint64_t ticks;
    int fd;
    if (stat("/proc/self/ns/pid", &here) != 0 || (uint64_t)here.st_ino != header->pid_namespace ||
        readlink("/proc/self", self, sizeof self - 1) <= 0 || strtoull(self, NULL, 10) != (uint64_t)getpid() ||
        header->writer_pid > INT32_MAX)
        return SKINWARE__UNKNOWN;
    fd = (int)syscall(434 /* SYS_pidfd_open */, (pid_t)header->writer_pid, 0);
    if (fd < 0)
        return errno == ESRCH ? SKINWARE__ENDED : SKINWARE__UNKNOWN;
    ticks = skinware__start_ticks(header->writer_pid);
    if (ticks == 0 || header->writer_start_ticks == 0 || ticks == header->writer_start_ticks)
        return fd;
    close(fd); /* its number is another's now */
    return SKINWARE__ENDED;
}

/* Opens and checks the present file of the service. skinware__release closes and unmaps everything. */
static skinware_result skinware__open(skinware_reader *reader) {
    char file_name[56] = "";
    struct stat info;
    uid_t owner = 0;
    int folder = -1;
    void *map;
    skinware_result result = skinware__open_folder(reader->name_space, &folder, &owner);
    if (result != SKINWARE_OK)
        return result;
    strcat(strcat(file_name, reader->service), ".ring");
    /* O_NONBLOCK: a FIFO in its place must not block us */
    reader->fd = openat(folder, file_name, O_RDONLY | O_CLOEXEC | O_NOFOLLOW | O_NONBLOCK);
    if (reader->fd < 0 && errno == ENOENT)
        result = skinware__fail(SKINWARE_NOT_FOUND, "no such service in this namespace; is its driver running?");
    else if (reader->fd < 0)
        result = skinware__fail(SKINWARE_BAD_FILE, "the file cannot be opened");
    close(folder);
    if (result != SKINWARE_OK)
        return result;
    if (fstat(reader->fd, &info) != 0)
        return skinware__fail(SKINWARE_SYSTEM, "fstat of the file");
    if (!S_ISREG(info.st_mode))
        return skinware__fail(SKINWARE_BAD_FILE, "not a regular file");
    if (info.st_uid != owner)
        return skinware__fail(SKINWARE_BAD_FILE, "the file belongs to another user than its folder");
    result = skinware__parse(reader, (uint64_t)info.st_size);
    if (result != SKINWARE_OK)
        return result;
    if (reader->header.file_size > SIZE_MAX / 2)
        return skinware__fail(SKINWARE_NO_MEMORY, "the file is too large for this process");
    map = mmap(NULL, (size_t)reader->header.file_size, PROT_READ, MAP_SHARED, reader->fd, 0);
    if (map == MAP_FAILED)
        return skinware__fail(SKINWARE_NO_MEMORY, "the file cannot be mapped");
    reader->ring.map = (const unsigned char *)map;
    reader->ring.slot_offset = reader->header.slot_offset;
    reader->ring.slot_stride = reader->header.slot_stride;
    reader->ring.slot_count = reader->header.slot_count;
    reader->map_size = (size_t)reader->header.file_size;
    reader->device = info.st_dev;
    reader->inode = info.st_ino;
    reader->process = skinware__watch(&reader->header);
    return skinware_is_driver(reader) ? skinware__read_driver(reader) : SKINWARE_OK;
}

static void skinware__release(skinware_reader *reader) {
    if (reader->ring.map != NULL)
        munmap((void *)(uintptr_t)reader->ring.map, reader->map_size);
    if (reader->fd >= 0)
        close(reader->fd);
    if (reader->process >= 0)
        close(reader->process);
    free(reader->types);
    free(reader);
}

skinware_result skinware_attach(skinware_reader **reader, const char *name_space, const char *service) {
    skinware_reader *made;
    skinware_result result;
    *reader = NULL;
    if (name_space == NULL)
        name_space = skinware__default_namespace();
    if (!skinware__is_name(name_space) || !skinware__is_name(service))
        return skinware__fail(SKINWARE_BAD_NAME,
                              "give 1 to 47 letters, digits, '_' or '-', beginning with a letter or digit");
    made = (skinware_reader *)calloc(1, sizeof *made);
    if (made == NULL)
        return skinware__fail(SKINWARE_NO_MEMORY, "no memory for a reader");
    made->fd = -1;
    made->process = SKINWARE__UNKNOWN;
    strcat(made->name_space, name_space);
    strcat(made->service, service);
    result = skinware__open(made);
    if (result != SKINWARE_OK)
        skinware__release(made);
    else
        *reader = made;
    return result;
}

/* Equal digests say that columns and tables are equal; that the rows are saves everything that was looked up. */
static int skinware__same_structure(const skinware_reader *a, const skinware_reader *b) {
    return memcmp(a->header.digest, b->header.digest, sizeof a->header.digest) == 0 &&
           a->header.column_count == b->header.column_count && a->header.slot_stride == b->header.slot_stride &&
           memcmp(a->rows, b->rows, sizeof(skinware__row) * a->header.column_count) == 0 &&
           a->type_count == b->type_count &&
           (a->type_count == 0 || memcmp(a->types, b->types, sizeof(skinware_type) * a->type_count) == 0);
}

skinware_result skinware_reattach(skinware_reader *reader) {
    skinware_reader *present, before;
    const skinware_result result = skinware_attach(&present, reader->name_space, reader->service);
    int same;
    if (result != SKINWARE_OK)
        return result;
    same = skinware__same_structure(reader, present);
    before = *reader;
    *reader = *present; /* the caller's pointers to columns stay good: they point into *reader */
    *present = before;
    if (same) { /* and so do those to types */
        skinware_type *types = reader->types;
        reader->types = present->types;
        present->types = types;
    }
    skinware__release(present);
    return same ? SKINWARE_OK : SKINWARE_STRUCTURE_CHANGED;
}

void skinware_detach(skinware_reader *reader) {
    if (reader != NULL)
        skinware__release(reader);
}

/* -- frames ------------------------------------------------------------------------------------------------------- */

/* Returns whether the name stands for another file now. No other file can have the inode of an attached one. */
static int skinware__is_replaced(const skinware_reader *reader) {
    char path[160];
    struct stat info;
    skinware__path(path, reader->name_space, reader->service);
    return lstat(path, &info) == 0 && (info.st_ino != reader->inode || info.st_dev != reader->device);
}

skinware_result skinware_wait(skinware_reader *reader, const skinware_frame *newer_than, int64_t deadline_ns) {
    int look_around = 0; /* at the rare things, which cost system calls: after a slice without news, and at the end */
    for (;;) {
        /* the wake word first: a publication after it was read ends the sleep */
        const uint32_t wake_word = skinware__load_32(reader->ring.map + SKINWARE__WAKE_WORD_OFFSET);
        const uint32_t state = skinware_state(reader);
        const uint64_t latest = skinware_latest(reader);
        int64_t remaining_ns;
        int gone, error;
        if (!(state & SKINWARE_STATE_PAUSED))
            reader->told_paused = 0;
        if ((look_around || (state & (SKINWARE_STATE_SUPERSEDED | SKINWARE_STATE_CLOSED))) &&
            skinware__is_replaced(reader))
            return SKINWARE_RESTARTED;
        if (latest != 0 && (newer_than == NULL || newer_than->generation != reader->header.generation ||
                            newer_than->sequence != latest))
            return SKINWARE_OK;
        gone = (state & SKINWARE_STATE_CLOSED) || (look_around && !skinware__lives(reader->fd, reader->process));
        if (gone && !reader->told_gone) {
            reader->told_gone = 1;
            return SKINWARE_GONE;
        }
        if ((state & SKINWARE_STATE_PAUSED) && !reader->told_paused && !gone) {
            reader->told_paused = 1;
            return SKINWARE_PAUSED;
        }
        remaining_ns = deadline_ns == SKINWARE_FOREVER ? skinware__slice_ns : deadline_ns - skinware_now_ns();
        if (remaining_ns > 0) {
            error = skinware__sleep(reader->ring.map + SKINWARE__WAKE_WORD_OFFSET, wake_word,
                                    remaining_ns < skinware__slice_ns ? remaining_ns : skinware__slice_ns);
            if (error == EINTR)
                return SKINWARE_INTERRUPTED;
            if (error != 0 && error != EAGAIN && error != ETIMEDOUT)
                return skinware__fail(SKINWARE_SYSTEM, "futex");
        } else if (look_around) {
            return gone ? SKINWARE_GONE : (state & SKINWARE_STATE_PAUSED) ? SKINWARE_PAUSED : SKINWARE_TIMEOUT;
        }
        look_around = 1;
    }
}

static void skinware__fill(const skinware_reader *reader, skinware_frame *frame, const unsigned char *bytes,
                           uint64_t sequence, int alive) {
    skinware__slot slot;
    memcpy(&slot, bytes, sizeof slot);
    frame->generation = reader->header.generation;
    frame->sequence = sequence;
    frame->acquired_ns = slot.acquired_ns;
    frame->published_ns = slot.published_ns;
    frame->flags = slot.flags;
    frame->stale = !alive;
    frame->bytes = bytes;
    frame->size = (size_t)reader->header.slot_stride;
}

static skinware_result skinware__overrun(int alive) {
    return skinware__fail(SKINWARE_OVERRUN, alive ? "give the service more slots, or publish less often"
                                                  : "its writer is dead, and its newest sample is not whole; start it again");
}

skinware_result skinware_read(skinware_reader *reader, skinware_frame *frame) {
    const size_t size = (size_t)reader->header.slot_stride;
    const int alive = skinware_is_alive(reader);
    uint64_t sequence;
    if (skinware_latest(reader) == 0)
        return SKINWARE_EMPTY;
    if (frame->capacity < size) {
        unsigned char *buffer = (unsigned char *)malloc(size);
        if (buffer == NULL)
            return skinware__fail(SKINWARE_NO_MEMORY, "no memory for a frame");
        skinware_frame_free(frame);
        frame->buffer = buffer;
        frame->capacity = size;
    }
    sequence = skinware__copy_newest(&reader->ring, frame->buffer, SKINWARE__ATTEMPTS);
    if (sequence == 0)
        return SKINWARE_EMPTY;
    if (sequence != UINT64_MAX) {
        skinware__fill(reader, frame, frame->buffer, sequence, alive);
        return SKINWARE_OK;
    }
    frame->bytes = NULL; /* half of one frame, half of another */
    frame->generation = frame->sequence = 0;
    return skinware__overrun(alive);
}

skinware_result skinware_view(skinware_reader *reader, skinware_frame *frame) {
    const int alive = skinware_is_alive(reader);
    int attempt;
    for (attempt = 0; attempt < SKINWARE__ATTEMPTS; attempt++) {
        const uint64_t sequence = skinware_latest(reader);
        const unsigned char *slot = skinware__slot_at(&reader->ring, sequence);
        skinware_frame seen = *frame;
        if (sequence == 0)
            return SKINWARE_EMPTY;
        if (skinware__load_64(slot) != sequence)
            continue;
        skinware__fill(reader, &seen, slot, sequence, alive);
        if (skinware__still(slot, sequence)) {
            *frame = seen;
            return SKINWARE_OK;
        }
    }
    return skinware__overrun(alive);
}

int skinware_valid(const skinware_frame *frame) {
    if (frame->bytes == NULL)
        return 0;
    return frame->bytes == frame->buffer || skinware__still(frame->bytes, frame->sequence);
}

const void *skinware_data(const skinware_frame *frame, const skinware_column *column) {
    if (frame->bytes == NULL || column == NULL || !column->in_slot || column->offset > frame->size ||
        column->count > (frame->size - column->offset) / column->itemsize)
        return NULL;
    return frame->bytes + column->offset;
}

void skinware_frame_free(skinware_frame *frame) {
    static const skinware_frame empty = SKINWARE_FRAME_INIT;
    free(frame->buffer);
    *frame = empty;
}

/* -- what a service is made of ------------------------------------------------------------------------------------ */

static const skinware_column *skinware__find(const skinware_reader *reader, const char *name, int in_slot) {
    uint32_t i;
    for (i = 0; i < reader->header.column_count; i++)
        if (reader->columns[i].in_slot == in_slot && strcmp(reader->columns[i].name, name) == 0)
            return &reader->columns[i];
    return NULL;
}

const skinware_column *skinware_find_column(const skinware_reader *reader, const char *name) {
    return skinware__find(reader, name, 1);
}

const skinware_column *skinware_find_table(const skinware_reader *reader, const char *name) {
    return skinware__find(reader, name, 0);
}

const void *skinware_table_data(const skinware_reader *reader, const skinware_column *table) {
    if (table < reader->columns || table >= reader->columns + reader->header.column_count || table->in_slot)
        return NULL;
    return reader->ring.map + table->offset;
}

size_t skinware_column_count(const skinware_reader *reader) {
    return reader->header.column_count;
}

const skinware_column *skinware_column_at(const skinware_reader *reader, size_t index) {
    return index < reader->header.column_count ? &reader->columns[index] : NULL;
}

double skinware_number(const skinware_column *column, const void *data, size_t index) {
    const unsigned char *at = (const unsigned char *)data + index * column->itemsize;
    if (index >= column->count || !skinware__is_number(column->kind))
        return __builtin_nan("");
    switch (column->itemsize << 8 | (unsigned char)column->kind) {
#define SKINWARE__CASE(size, kind, type)                                                                               \
    case (size) << 8 | (kind): {                                                                                       \
        type value;                                                                                                    \
        memcpy(&value, at, sizeof value);                                                                              \
        return (double)value;                                                                                          \
    }
        SKINWARE__CASE(1, 'u', uint8_t)
        SKINWARE__CASE(2, 'u', uint16_t)
        SKINWARE__CASE(4, 'u', uint32_t)
        SKINWARE__CASE(8, 'u', uint64_t)
        SKINWARE__CASE(1, 'i', int8_t)
        SKINWARE__CASE(2, 'i', int16_t)
        SKINWARE__CASE(4, 'i', int32_t)
        SKINWARE__CASE(8, 'i', int64_t)
        SKINWARE__CASE(4, 'f', float)
        SKINWARE__CASE(8, 'f', double)
#undef SKINWARE__CASE
    default:
        return __builtin_nan("");
    }
}

/* -- drivers: sensors by type ------------------------------------------------------------------------------------- */

int skinware_is_driver(const skinware_reader *reader) {
    return strcmp(reader->kind, "driver") == 0;
}

size_t skinware_type_count(const skinware_reader *reader) {
    return reader->type_count;
}

const skinware_type *skinware_type_at(const skinware_reader *reader, size_t index) {
    return index < reader->type_count ? &reader->types[index] : NULL;
}

const skinware_type *skinware_find_type(const skinware_reader *reader, const char *name) {
    size_t i;
    for (i = 0; i < reader->type_count; i++)
        if (strcmp(reader->types[i].name, name) == 0)
            return &reader->types[i];
    return NULL;
}

size_t skinware_sensors(const skinware_reader *reader, const skinware_type *type, uint32_t *positions,
                        size_t capacity) {
    const skinware_column *table = type == NULL ? NULL : skinware_find_table(reader, "sensor_type");
    const uint32_t *ids = table == NULL ? NULL : (const uint32_t *)skinware_table_data(reader, table);
    size_t found = 0;
    uint32_t i;
    if (ids == NULL || !skinware_is_driver(reader))
        return 0;
    for (i = 0; i < table->count; i++) {
        if (ids[i] != type->id)
            continue;
        if (found < capacity)
            positions[found] = i;
        found++;
    }
    return found;
}

size_t skinware_physical(const skinware_frame *frame, const skinware_column *values, const skinware_type *type,
                         const uint32_t *positions, size_t count, float *out) {
    const void *data = skinware_data(frame, values);
    size_t i;
    if (data == NULL || type == NULL)
        return 0;
    for (i = 0; i < count; i++)
        if (positions[i] >= values->count)
            return 0;
    for (i = 0; i < count; i++) {
        const double raw = skinware_number(values, data, positions[i]);
        if (values->kind == 'i' && values->itemsize == 4)
            out[i] = (float)(raw * type->scale + type->offset); /* more digits than a float has */
        else
            out[i] = (float)raw * (float)type->scale + (float)type->offset;
    }
    return count;
}

static int64_t skinware__age_limit_ns(int64_t period_ns) {
    const int64_t most_ns = (int64_t)86400 * 1000000000; /* of a forged file */
    if (period_ns <= 0)
        return 1000000000;
    return period_ns < 200000000 / 3 ? 200000000 : 3 * (period_ns < most_ns ? period_ns : most_ns);
}

size_t skinware_fresh(const skinware_reader *reader, const skinware_frame *frame, int64_t max_age_ns,
                      const uint32_t *positions, size_t count, unsigned char *out) {
    const skinware_column *own_times = skinware_find_column(reader, "group_time_ns");
    const skinware_column *groups = skinware_find_table(reader, "sensor_group");
    const skinware_column *periods = skinware_find_table(reader, "group_period_ns");
    const skinware_column *status = skinware_find_column(reader, "status");
    const skinware_column *times = own_times != NULL ? own_times : skinware_find_column(reader, "module_time_ns");
    const skinware_column *owners = groups != NULL ? groups : skinware_find_table(reader, "sensor_module");
    const unsigned char *bits = status == NULL ? NULL : (const unsigned char *)skinware_data(frame, status);
    const int64_t *time_ns = times == NULL ? NULL : (const int64_t *)skinware_data(frame, times);
    const uint32_t *group = owners == NULL ? NULL : (const uint32_t *)skinware_table_data(reader, owners);
    const int64_t *own_period_ns = periods == NULL ? NULL : (const int64_t *)skinware_table_data(reader, periods);
    const int64_t period_ns = skinware_period_ns(reader);
    const int64_t now_ns = skinware_now_ns();
    size_t i, fresh = 0;
    if (!skinware_is_driver(reader) || bits == NULL || time_ns == NULL || group == NULL)
        return 0;
    for (i = 0; i < count; i++)
        if (positions[i] >= status->count || positions[i] >= owners->count || group[positions[i]] >= times->count)
            return 0;
    for (i = 0; i < count; i++) {
        /* Loaded once and checked below: the file's owner may change the table after the loop above. */
        const uint32_t own = skinware__load_32((const unsigned char *)(group + positions[i]));
        const int64_t own_ns = own_period_ns != NULL && own < periods->count ? own_period_ns[own] : 0;
        const int64_t limit_ns = max_age_ns != 0 ? max_age_ns : skinware__age_limit_ns(own_ns > 0 ? own_ns : period_ns);
        const int64_t acquired_ns = own < times->count ? time_ns[own] : 0;
        out[i] = !frame->stale && bits[positions[i]] == 0 && acquired_ns > 0 && acquired_ns >= now_ns - limit_ns &&
                 acquired_ns <= now_ns + SKINWARE__AHEAD_NS;
        fresh += out[i];
    }
    return fresh;
}

/* -- the state of things ------------------------------------------------------------------------------------------ */

int skinware_is_alive(const skinware_reader *reader) {
    return !(skinware_state(reader) & SKINWARE_STATE_CLOSED) && skinware__lives(reader->fd, reader->process);
}

uint32_t skinware_state(const skinware_reader *reader) {
    return skinware__load_32(reader->ring.map + SKINWARE__STATE_OFFSET);
}

uint64_t skinware_latest(const skinware_reader *reader) {
    return skinware__latest(&reader->ring);
}

uint64_t skinware_generation(const skinware_reader *reader) {
    return reader->header.generation;
}

uint64_t skinware_published_before(const skinware_reader *reader) {
    return reader->header.published_before;
}

int64_t skinware_period_ns(const skinware_reader *reader) {
    return reader->header.period_ns;
}

uint32_t skinware_slot_count(const skinware_reader *reader) {
    return reader->header.slot_count;
}

uint64_t skinware_writer_pid(const skinware_reader *reader) {
    return reader->header.writer_pid;
}

const char *skinware_kind(const skinware_reader *reader) {
    return reader->kind;
}

const unsigned char *skinware_digest(const skinware_reader *reader) {
    return reader->header.digest;
}

int64_t skinware_now_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

const char *skinware_text(skinware_result result) {
    switch (result) {
    case SKINWARE_OK: return "done";
    case SKINWARE_TIMEOUT: return "nothing newer in time; the writer lives, but is silent";
    case SKINWARE_EMPTY: return "nothing was published yet";
    case SKINWARE_PAUSED: return "the writer is paused";
    case SKINWARE_GONE: return "the writer died or was stopped; start it again";
    case SKINWARE_RESTARTED: return "the service came back; reattach";
    case SKINWARE_STRUCTURE_CHANGED: return "the service has another structure now; look everything up again";
    case SKINWARE_INTERRUPTED: return "a signal ended the wait";
    case SKINWARE_OVERRUN: return "the writer was faster than the copy";
    case SKINWARE_NOT_FOUND: return "no such service";
    case SKINWARE_BAD_NAME: return "not the name of a service or namespace";
    case SKINWARE_BAD_NAMESPACE: return "the namespace cannot be trusted or read";
    case SKINWARE_BAD_FILE: return "the service's file cannot be read safely";
    case SKINWARE_NO_MEMORY: return "out of memory";
    case SKINWARE_SYSTEM: return "the operating system refused";
    }
    return "unknown result";
}

const char *skinware_reason(void) {
    return skinware__reason;
}

#endif /* SKINWARE_IMPLEMENTATION */

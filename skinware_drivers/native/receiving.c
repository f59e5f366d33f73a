/* Takes what has arrived on a CAN socket: can/socketcan.py and receiving.py. */
#include "flow.h"

#include <errno.h>
#include <sys/socket.h>

enum { ROWS_AT_ONCE = 64, CONTROL_BYTES = 64, SOFTWARE_WORD = 2, CLOCK_READS = 3, GOOD_READ_NS = 2000 };
enum { MEMORY_INFO = 55, MEMORY_USED = 0, MEMORY_SIZE = 1, MEMORY_DROPS = 8, MEMORY_WORDS = 9 };
enum { SWITCHED = 1, PASSIVE_SENDER = 2, IS_FD = 4, CLASSIC_PAYLOAD = 8, LONGEST_SHORT_FD = 16 };
#define SLEW_NS INT64_C(2000000)
#define UNUSUAL UINT32_C(0x60000000) /* remote and error frames */
#define EXTENDED UINT32_C(0x80000000)

/* CLOCK_MONOTONIC - CLOCK_REALTIME, not bent by a pause between reading the two; `poll_ns`: now. */
static int64_t offset_now_ns(int64_t *poll_ns)
{
    int64_t best_ns = INT64_MAX, offset_ns = 0;
    for (int i = 0; i < CLOCK_READS && best_ns >= GOOD_READ_NS; i++) {
        int64_t first_ns = skinware__clock_ns(CLOCK_MONOTONIC), real_ns = skinware__clock_ns(CLOCK_REALTIME);
        int64_t second_ns = skinware__clock_ns(CLOCK_MONOTONIC);
        if (second_ns - first_ns < best_ns) {
            best_ns = second_ns - first_ns;
            offset_ns = (first_ns + second_ns) / 2 - real_ns;
        }
        *poll_ns = second_ns;
    }
    return offset_ns;
}

/* Give rows the times of their stamps; they were taken at `poll_ns`, with this offset of the clocks. */
SKINWARE_EXPORT void skinware_stamp(struct batch *batch, struct source *source, int64_t first, int64_t n,
                                    int64_t offset_ns, int64_t poll_ns)
{
    const int64_t *control = (const int64_t *)(intptr_t)source->control;
    int64_t before_ns = source->offset_ns, *stamps = batch->time_ns + first, latest_ns = INT64_MIN;
    int64_t step_ns = offset_ns - before_ns;
    bool is_step = step_ns > SLEW_NS || step_ns < -SLEW_NS, is_falling = false;
    for (int64_t i = 0; i < n; i++) {
        const int64_t *words = control + (first + i) * (CONTROL_BYTES / 8) + SOFTWARE_WORD;
        int64_t software_ns = words[0] * INT64_C(1000000000) + words[1], other_ns = software_ns + before_ns;
        stamps[i] = software_ns ? software_ns + offset_ns : poll_ns;
        if (is_step && other_ns >= source->last_poll_ns && other_ns <= poll_ns &&
            (stamps[i] < source->last_poll_ns || stamps[i] > poll_ns))
            stamps[i] = other_ns;
        if (stamps[i] < source->last_poll_ns)
            stamps[i] = source->last_poll_ns;
        if (stamps[i] > poll_ns)
            stamps[i] = poll_ns;
        if (is_step && stamps[i] < latest_ns)
            stamps[i] = latest_ns;
        is_falling |= stamps[i] < latest_ns;
        latest_ns = stamps[i];
    }
    for (int64_t i = n - 2; is_falling && i >= 0; i--)
        if (stamps[i] > stamps[i + 1])
            stamps[i] = stamps[i + 1];
    source->offset_ns = offset_ns;
    source->last_poll_ns = latest_ns < poll_ns ? latest_ns : poll_ns;
}

static bool is_usual(const struct path *path, const struct source *source, int64_t first, int64_t n)
{
    const struct mmsghdr *headers = (const struct mmsghdr *)(intptr_t)source->headers;
    uint32_t identifiers = 0;
    int flags = 0;
    int64_t longest = 0;
    for (int64_t row = first; row < first + n; row++) {
        identifiers |= identifier_of(path->batch, row);
        flags |= headers[row].msg_hdr.msg_flags;
        if (length_of(path->batch, row) > longest)
            longest = length_of(path->batch, row);
    }
    return !(identifiers & UNUSUAL) && !(flags & MSG_TRUNC) && longest <= path->batch->payload_size;
}

/* About how many bits of the nominal rate frames take; CAN FD frames may switch to one that is faster by `speed_up`. */
SKINWARE_EXPORT double skinware_wire_bits(const struct batch *batch, double speed_up, int64_t first, int64_t n)
{
    double bits = 0;
    for (int64_t row = first; row < first + n; row++) {
        int64_t length = length_of(batch, row), flags = batch->wire[row * batch->row_bytes + 5];
        bool is_extended = identifier_of(batch, row) & EXTENDED;
        bool is_fd = batch->payload_size > CLASSIC_PAYLOAD &&
                     (flags & (SWITCHED | PASSIVE_SENDER | IS_FD) || length > CLASSIC_PAYLOAD);
        if (is_fd)
            bits += (is_extended ? 49 : 30) + (double)((length > LONGEST_SHORT_FD ? 37 : 32) + 8 * length) *
                                                  (flags & SWITCHED ? 1 / speed_up : 1.0);
        else
            bits += (double)((is_extended ? 67 : 47) + 8 * length);
    }
    return 1.1 * bits;
}

/* How full the receive buffer is, and how many frames did not fit; whether more did not. */
static bool read_memory(struct source *source)
{
    uint32_t words[MEMORY_WORDS];
    socklen_t size = sizeof words;
    if (getsockopt((int)source->fd, SOL_SOCKET, MEMORY_INFO, words, &size) || size < sizeof words)
        return false;
    double full = (double)words[MEMORY_USED] / words[MEMORY_SIZE];
    int64_t dropped = source->dropped_before + words[MEMORY_DROPS];
    if (full > source->fullest)
        source->fullest = full;
    bool is_more = dropped != source->dropped;
    source->dropped = dropped;
    return is_more;
}

/* One call of the kernel: how many datagrams it gave, with their times, into rows from the batch's stop on; or -1. */
static int64_t receive_some(struct batch *batch, struct source *source, int64_t most)
{
    struct mmsghdr *headers = (struct mmsghdr *)(intptr_t)source->headers + batch->stop;
    int64_t n = batch->limit - batch->stop < most ? batch->limit - batch->stop : most, poll_ns = 0, offset_ns;
    for (int64_t i = 0; i < n; i++)
        headers[i].msg_hdr.msg_controllen = CONTROL_BYTES;
    n = recvmmsg((int)source->fd, headers, (unsigned)n, MSG_DONTWAIT, NULL);
    if (n <= 0)
        return n;
    offset_ns = offset_now_ns(&poll_ns);
    skinware_stamp(batch, source, batch->stop, n, offset_ns, poll_ns);
    for (int64_t row = batch->stop; row < batch->stop + n; row++)
        batch->bus[row] = (uint16_t)source->bus;
    return n;
}

/* The same for Python, which sorts the rows itself; below 0: errno. */
SKINWARE_EXPORT int64_t skinware_receive(struct batch *batch, struct source *source)
{
    int64_t n = receive_some(batch, source, batch->limit - batch->stop);
    if (n < 0)
        return -errno;
    read_memory(source);
    return n;
}

/* Append what has arrived to the batch, up to its limit; whether there are rows. */
bool receive(struct path *path, struct source *source)
{
    struct batch *batch = path->batch;
    int64_t begin = batch->stop, n = ROWS_AT_ONCE;
    while (n == ROWS_AT_ONCE && batch->stop < batch->limit) {
        int64_t first = batch->stop, kept;
        n = receive_some(batch, source, ROWS_AT_ONCE);
        if (n < 0 && errno != EAGAIN && errno != EINTR) {
            path->plan->hooks.lose(source->bus, errno);
            source->fd = -1;
            return batch->stop > begin;
        }
        if (n <= 0)
            break;
        if (source->tap)
            keep_frames(path, source, first, n);
        kept = is_usual(path, source, first, n) ? n : path->plan->hooks.sort_out(source->bus, first, n);
        batch->stop += kept;
        source->frames += kept;
        path->plan->counts[source->bus * path->plan->n_counts + path->plan->frames_column] += kept;
        if (source->is_counted)
            source->wire_bits += skinware_wire_bits(batch, source->speed_up, first, kept);
    }
    /* frames are lost only where many wait, or the buffer is full after a few */
    bool may_lose = batch->stop - begin >= ROWS_AT_ONCE || batch->stop == batch->limit || source->is_small;
    if (may_lose && read_memory(source)) {
        path->plan->counts[source->bus * path->plan->n_counts + path->plan->dropped_column] = source->dropped;
        path->plan->interrupted[source->bus] = 1;
    }
    return batch->stop > begin;
}

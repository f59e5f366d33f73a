/* Takes what has arrived on a CAN socket: can/socketcan.py. */
#include "flow.h"

#include <errno.h>
#include <sys/socket.h>

enum { ROWS_AT_ONCE = 64, CLOCK_READS = 3, GOOD_READ_NS = 2000, FD_FRAME = 72, FLAGS = 5 };
enum { CONTROL_WORDS = 8, SOFTWARE_WORD = 2, HARDWARE_WORD = 6 }; /* ancillary data: a header, then one timespec or three */
enum { MEMORY_INFO = 55, MEMORY_USED = 0, MEMORY_SIZE = 1, MEMORY_DROPS = 8, MEMORY_WORDS = 9 };
enum { SWITCHED = 1, IS_FD = 4, CLASSIC_PAYLOAD = 8, LONGEST_SHORT_FD = 16 };
#define SECOND_NS INT64_C(1000000000)
#define SLEW_NS INT64_C(2000000) /* a larger change of CLOCK_REALTIME between two calls is a step */
#define LONGEST_DELAY_NS INT64_C(100000000) /* no controller stamped a frame longer before the kernel had it */
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

/* Date frames, in order, by the words of their ancillary data; 0: there is no stamp.
 *
 * Stamps of the kernel are CLOCK_REALTIME. Its offset is read at each call, so that steps of that clock do no harm: a
 * frame lies between two calls, and only one of the offsets before and after a step puts it there. A controller has a
 * clock of its own, which may be set or started again at any time. */
SKINWARE_EXPORT void skinware_can_stamp(struct can_socket *can, const int64_t *control, int64_t *stamps, int64_t n,
                                        int64_t offset_ns, int64_t poll_ns)
{
    int64_t step_ns = offset_ns - can->offset_ns, latest_ns = INT64_MIN;
    bool is_step = step_ns > SLEW_NS || step_ns < -SLEW_NS, is_falling = false;
    for (int64_t i = 0; i < n; i++) {
        const int64_t *words = control + i * CONTROL_WORDS + SOFTWARE_WORD;
        int64_t software_ns = words[0] * SECOND_NS + words[1], other_ns = software_ns + can->offset_ns;
        stamps[i] = software_ns ? software_ns + offset_ns : poll_ns;
        if (software_ns && is_step && other_ns >= can->last_poll_ns && other_ns <= poll_ns &&
            (stamps[i] < can->last_poll_ns || stamps[i] > poll_ns))
            stamps[i] = other_ns;
        if (stamps[i] < can->last_poll_ns)
            stamps[i] = can->last_poll_ns;
        if (stamps[i] > poll_ns)
            stamps[i] = poll_ns;
        if (is_step && stamps[i] < latest_ns)
            stamps[i] = latest_ns;
        is_falling |= stamps[i] < latest_ns;
        latest_ns = stamps[i];
    }
    /* the kernel begins to stamp in the background: earlier frames have the time at which they were read */
    for (int64_t i = n - 2; is_falling && i >= 0; i--)
        if (stamps[i] > stamps[i + 1])
            stamps[i] = stamps[i + 1];
    can->offset_ns = offset_ns;
    can->last_poll_ns = latest_ns < poll_ns ? latest_ns : poll_ns;
    for (int64_t i = 0; can->clock && i < n; i++) {
        const int64_t *words = control + i * CONTROL_WORDS + HARDWARE_WORD;
        int64_t hardware_ns = words[0] * SECOND_NS + words[1], earliest_ns = stamps[i] - LONGEST_DELAY_NS;
        if (hardware_ns)
            skinware_clock_convert(can->clock, &hardware_ns, &stamps[i], 1);
        if (stamps[i] < earliest_ns)
            stamps[i] = earliest_ns;
    }
}

static bool is_usual(const struct batch *batch, int64_t first, int64_t n)
{
    uint32_t identifiers = 0;
    int64_t longest = 0, flags = 0;
    for (int64_t row = first; row < first + n; row++) {
        identifiers |= identifier_of(batch, row);
        flags |= batch->wire[row * batch->row_bytes + FLAGS];
        if (length_of(batch, row) > longest)
            longest = length_of(batch, row);
    }
    return !(identifiers & UNUSUAL) && !(flags & IS_FD && batch->payload_size == CLASSIC_PAYLOAD) &&
           longest <= batch->payload_size;
}

/* Count rows that are left, with about as many bits as they take at the nominal rate: ISO 11898-1, without payload and
 * stuff bits, with the pause behind a frame. Of CAN FD, what lies before the switch of the rate and from the
 * acknowledgement on is sent at the nominal one, the rest with fixed stuff bits and a check sum of 17 or 21. */
SKINWARE_EXPORT void skinware_can_count(struct can_socket *can, const struct batch *batch, int64_t first, int64_t n)
{
    double bits = 0;
    can->frames += n;
    for (int64_t row = first; can->is_counted && row < first + n; row++) {
        int64_t length = length_of(batch, row), flags = batch->wire[row * batch->row_bytes + FLAGS];
        bool is_extended = identifier_of(batch, row) & EXTENDED;
        if (flags & IS_FD)
            bits += (is_extended ? 49 : 30) + (double)((length > LONGEST_SHORT_FD ? 37 : 32) + 8 * length) *
                                                  (flags & SWITCHED ? 1 / can->speed_up : 1.0);
        else
            bits += (double)((is_extended ? 67 : 47) + 8 * length);
    }
    can->wire_bits += 1.1 * bits;
}

/* Ask how full the receive buffer is, and how many frames did not fit; whether more were lost. */
SKINWARE_EXPORT int64_t skinware_can_look(struct can_socket *can)
{
    uint32_t words[MEMORY_WORDS];
    socklen_t size = sizeof words;
    if (getsockopt((int)can->fd, SOL_SOCKET, MEMORY_INFO, words, &size) || size < sizeof words)
        return false;
    double full = (double)words[MEMORY_USED] / words[MEMORY_SIZE];
    int64_t before = can->dropped;
    if (full > can->fullest)
        can->fullest = full;
    can->dropped = can->dropped_before + words[MEMORY_DROPS];
    return can->dropped != before;
}

/* Fill rows from the batch's stop on by one call of the kernel: dated, marked with their bus, CAN FD frames flagged as
 * such, which kernels before 5.14 do not do, and kept if somebody wants them; how many, or minus errno. */
SKINWARE_EXPORT int64_t skinware_can_receive(const struct source *source, struct batch *batch)
{
    struct can_socket *can = source->can;
    struct mmsghdr headers[ROWS_AT_ONCE];
    struct iovec parts[ROWS_AT_ONCE][2];
    int64_t control[ROWS_AT_ONCE][CONTROL_WORDS], first = batch->stop, most = batch->limit - first, poll_ns = 0;
    uint8_t beyond[FD_FRAME], *wire = batch->wire + first * batch->row_bytes; /* beyond: the end of a longer frame */
    bool is_wide = batch->payload_size > CLASSIC_PAYLOAD && batch->row_bytes < FD_FRAME;
    if (most > ROWS_AT_ONCE)
        most = ROWS_AT_ONCE;
    for (int64_t i = 0; i < most; i++) {
        memset(control[i] + SOFTWARE_WORD, 0, sizeof control[i] - SOFTWARE_WORD * sizeof **control);
        parts[i][0] = (struct iovec){wire + i * batch->row_bytes, (size_t)batch->row_bytes};
        parts[i][1] = (struct iovec){beyond, (size_t)(FD_FRAME - batch->row_bytes)};
        headers[i].msg_hdr = (struct msghdr){.msg_iov = parts[i],
                                             .msg_iovlen = is_wide ? 2 : 1,
                                             .msg_control = control[i],
                                             .msg_controllen = sizeof control[i]};
    }
    int64_t n = recvmmsg((int)can->fd, headers, (unsigned)most, MSG_DONTWAIT, NULL);
    if (n <= 0)
        return n < 0 && errno != EAGAIN && errno != EINTR ? -errno : 0;
    for (int64_t i = 0; i < n; i++) {
        bool is_fd = headers[i].msg_len == FD_FRAME || headers[i].msg_hdr.msg_flags & MSG_TRUNC;
        uint8_t *flags = wire + i * batch->row_bytes + FLAGS;
        *flags = (uint8_t)(is_fd ? *flags | IS_FD : 0);
        batch->bus[first + i] = (uint16_t)source->bus;
    }
    int64_t offset_ns = offset_now_ns(&poll_ns);
    skinware_can_stamp(can, *control, batch->time_ns + first, n, offset_ns, poll_ns);
    if (source->tap)
        keep_frames(source->tap, batch, first, n);
    return n;
}

/* Append what has arrived to the batch, up to its limit; whether there are rows. */
bool receive(struct path *path, struct source *source)
{
    struct batch *batch = path->batch;
    const struct plan *plan = path->plan;
    struct can_socket *can = source->can;
    int64_t begin = batch->stop, n = ROWS_AT_ONCE, *counts = plan->counts + source->bus * plan->n_counts;
    while (n == ROWS_AT_ONCE && batch->stop < batch->limit) {
        int64_t first = batch->stop, kept;
        n = skinware_can_receive(source, batch);
        if (n < 0) {
            plan->hooks.lose(source->bus, -n);
            source->fd = -1;
            return batch->stop > begin;
        }
        if (n == 0)
            break;
        can->is_heard = is_usual(batch, first, n);
        kept = can->is_heard ? n : plan->hooks.sort_out(source->bus, first, n);
        batch->stop += kept;
        counts[plan->frames_column] += kept;
        skinware_can_count(can, batch, first, kept);
    }
    /* frames are lost only where many wait, or the buffer is full after a few */
    if ((batch->stop - begin >= ROWS_AT_ONCE || batch->stop == batch->limit || can->is_small) && skinware_can_look(can)) {
        counts[plan->dropped_column] = can->dropped;
        plan->interrupted[source->bus] = 1;
    }
    return batch->stop > begin;
}

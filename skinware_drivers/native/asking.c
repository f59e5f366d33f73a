/* Asks for registers and takes the replies, as long as all is well; what is not is left to Python: modbus/master.py. */
#include "flow.h"

#include <errno.h>
#include <poll.h>
#include <unistd.h>

enum { ROOM = 1024, CRC_BYTES = 2 };

static bool leave_to_python(struct asker *asker)
{
    asker->is_stuck = 1;
    return false;
}

static uint16_t crc_of(const uint32_t *table, const uint8_t *at, int64_t n)
{
    uint32_t state = 0xFFFF;
    for (int64_t i = 0; i < n; i++)
        state = state >> 8 ^ table[(state ^ at[i]) & 0xFF];
    return (uint16_t)state;
}

static void ask(const struct source *source, int64_t time_ns)
{
    struct asker *asker = source->asker;
    struct asked_read *read = &asker->reads[asker->next];
    if (asker->is_tcp) {
        asker->number = asker->number % 0xFFFF + 1;
        read->question[0] = read->reply[0] = (uint8_t)(asker->number >> 8);
        read->question[1] = read->reply[1] = (uint8_t)asker->number;
    }
    asker->open = asker->next++;
    asker->until_ns = time_ns + asker->timeout_ns;
    asker->sent++;
    ssize_t written = write((int)asker->fd, read->question, (size_t)read->question_bytes);
    if (source->tap && written > 0)
        keep_bytes(source->tap, read->question, written, time_ns, true);
    if (written != read->question_bytes)
        leave_to_python(asker); /* to which it looks as if no reply came */
}

static void begin_cycle(struct asker *asker, int64_t time_ns)
{
    int64_t missed = (time_ns - asker->deadline_ns) / asker->period_ns;
    asker->polls_missed += missed;
    asker->deadline_ns += (missed + 1) * asker->period_ns;
    asker->cycle_ns = time_ns;
    asker->next = 0;
    asker->cycle++;
}

/* Ask what is due. */
static void say(const struct source *source, int64_t time_ns)
{
    struct asker *asker = source->asker;
    if (asker->open >= 0) {
        if (time_ns >= asker->until_ns)
            leave_to_python(asker);
        return;
    }
    if (time_ns < asker->free_ns)
        return;
    if (asker->next == asker->n_reads) {
        if (time_ns < asker->deadline_ns)
            return;
        begin_cycle(asker, time_ns);
    }
    ask(source, time_ns);
}

/* Whether the reply is whole; what cannot be the reply is left to Python. */
static bool is_whole(struct asker *asker, const struct asked_read *read)
{
    int64_t known = asker->size < read->reply_head ? asker->size : read->reply_head;
    if (asker->size > read->reply_bytes || memcmp(asker->buffer, read->reply, (size_t)known))
        return leave_to_python(asker);
    if (asker->size < read->reply_bytes)
        return false;
    if (!asker->is_tcp) {
        const uint8_t *end = asker->buffer + asker->size - CRC_BYTES;
        if (crc_of(asker->crc_table, asker->buffer, asker->size - CRC_BYTES) != (end[0] | end[1] << 8))
            return leave_to_python(asker);
    }
    return true;
}

/* Append the frames that are whole now. */
static void take_registers(struct asker *asker, const struct asked_read *read, struct batch *batch, int64_t bus,
                           int64_t time_ns)
{
    memcpy(read->registers, asker->buffer + read->reply_head, (size_t)(2 * read->count));
    for (int64_t i = 0; i < read->count; i++)
        read->heard_ns[i] = time_ns;
    for (int64_t i = 0; i < read->n_blocks; i++) {
        const struct asked_block *block = &read->blocks[i];
        int64_t oldest_ns = block->heard_ns[0];
        for (int64_t j = 1; j < block->count; j++)
            oldest_ns = block->heard_ns[j] < oldest_ns ? block->heard_ns[j] : oldest_ns;
        if (oldest_ns <= *block->told_ns || oldest_ns < asker->cycle_ns)
            continue;
        *block->told_ns = time_ns;
        append_row(batch, bus, block->identifier, block->registers, 2 * block->count, oldest_ns);
        asker->frames++;
    }
}

static void count(const struct path *path, int64_t bus, const struct asker *asker)
{
    const struct plan *plan = path->plan;
    int64_t *counts = plan->counts + bus * plan->n_counts;
    counts[plan->frames_column] = asker->frames;
    counts[plan->bytes_column] = asker->bytes_in;
    counts[plan->bytes_column + 1] = asker->frame_bytes;
}

static bool take_reply(struct path *path, struct source *source, int64_t time_ns)
{
    struct asker *asker = source->asker;
    const struct asked_read *read = &asker->reads[asker->open];
    if (!is_whole(asker, read))
        return false;
    take_registers(asker, read, path->batch, source->bus, time_ns);
    asker->bytes_in += asker->size;
    asker->frame_bytes += asker->size;
    asker->found++;
    asker->size = 0;
    asker->open = -1;
    asker->free_ns = time_ns + asker->turnaround_ns;
    count(path, source->bus, asker);
    return true;
}

/* Whether somebody else wants to ask. */
static bool has_guests(const struct asker *asker)
{
    struct pollfd guests = {.fd = (int)asker->guests_fd, .events = POLLIN};
    return asker->guests_fd >= 0 && poll(&guests, 1, 0) > 0;
}

/* Take the reply to what was asked, and ask what is next; whether a reply was whole. */
bool receive_asked(struct path *path, struct source *source)
{
    struct asker *asker = source->asker;
    int64_t time_ns = path_time_ns(path);
    bool is_taken = false;
    if (asker->is_stuck || path->batch->limit - path->batch->stop < asker->most_blocks)
        return false;
    ssize_t n = read((int)asker->fd, asker->buffer + asker->size, (size_t)(ROOM - asker->size));
    if (n > 0) {
        if (source->tap)
            keep_bytes(source->tap, asker->buffer + asker->size, n, time_ns, false);
        asker->size += n;
        is_taken = asker->open >= 0 ? take_reply(path, source, time_ns) : leave_to_python(asker);
    } else if (!(n < 0 && (errno == EAGAIN || errno == EINTR)))
        return leave_to_python(asker); /* which reads it again */
    if (has_guests(asker))
        leave_to_python(asker);
    if (!asker->is_stuck)
        say(source, time_ns);
    return is_taken;
}

/* When something has to be done even if nothing comes. */
int64_t asker_due_ns(const struct asker *asker)
{
    if (asker->is_stuck)
        return 0;
    if (asker->open >= 0)
        return asker->until_ns;
    if (asker->next < asker->n_reads || asker->free_ns > asker->deadline_ns)
        return asker->free_ns;
    return asker->deadline_ns;
}

/* Takes what has arrived on a serial line: serial/bus.py. */
#include "flow.h"

#include <errno.h>
#include <unistd.h>

enum { CHUNK = 1 << 16, MORE_WAITS = 2048 }; /* a read that gave so much is followed by another */

/* Read what is there, up to a chunk; whether there is something. */
static bool read_chunk(struct path *path, struct source *source)
{
    struct stream *stream = source->stream;
    uint8_t *at = begin_chunk(stream);
    int64_t total = 0, n = MORE_WAITS;
    while (n >= MORE_WAITS && total < CHUNK) {
        n = read((int)stream->fd, at + total, (size_t)(CHUNK - total));
        if (n > 0)
            total += n;
        else if (!total && !(n < 0 && (errno == EAGAIN || errno == EINTR))) {
            path->plan->hooks.lose(source->bus, n ? errno : 0);
            source->fd = -1;
            return false;
        }
    }
    if (total) {
        int64_t time_ns = path_time_ns(path);
        if (source->tap)
            keep_bytes(source->tap, at, total, time_ns, false);
        end_chunk(stream, total, time_ns);
    }
    return total > 0;
}

static void count(const struct path *path, const struct source *source)
{
    const struct plan *plan = path->plan;
    const struct stream *stream = source->stream;
    const int64_t bytes[] = {stream->bytes_in,      stream->frame_bytes,     stream->idle_bytes,
                             stream->skipped_bytes, stream->checksum_errors, stream->bad_form};
    int64_t *counts = plan->counts + source->bus * plan->n_counts;
    counts[plan->frames_column] = stream->frames;
    counts[plan->errors_column] = stream->checksum_errors + stream->bad_form;
    counts[plan->refused_column] = stream->too_long;
    memcpy(counts + plan->bytes_column, bytes, sizeof bytes);
}

/* Append the frames that have arrived to the batch, up to its limit; whether something has, frames or not. */
bool receive_line(struct path *path, struct source *source)
{
    const struct plan *plan = path->plan;
    struct stream *stream = source->stream;
    if (!stream->is_behind && !read_chunk(path, source))
        return false;
    skinware_stream_fill(stream, path->batch, source->bus);
    count(path, source);
    if (stream->is_damaged && !stream->is_good &&
        path_time_ns(path) >= plan->sample_next_ns[source->bus * N_SAMPLE_KINDS + SAMPLE_REFUSED])
        plan->hooks.damaged(source->bus, stream->chunk, stream->chunk_bytes);
    return true;
}

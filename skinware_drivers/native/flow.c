/* Takes, publishes and rests until Python has something to do: running/generation.py. */
#include "flow.h"

#include <errno.h>
#include <poll.h>
#include <sys/epoll.h>
#include <time.h>

enum { TURNS = 32, MOST_EVENTS = 64, FEW = 4 };
enum { MOST_ROWS = 512, FEWEST_ROWS = 64 }; /* of a turn: what the processor's nearest caches hold; of one bus */
#define TURN_NS INT64_C(20000000)

enum taken { NOTHING, ALL, SOME };
enum reason { TIME, LOOP, OTHER_BUS, NEWS, NO_MEMORY };

static int64_t least(int64_t one, int64_t other)
{
    return one < other ? one : other;
}

static struct source *source_of(const struct flow *flow, int fd)
{
    for (struct source *source = flow->sources; source < flow->sources + flow->n_sources; source++)
        if (source->fd == fd)
            return source;
    return NULL;
}

static bool receive_from(struct path *path, struct source *source)
{
    return (source->asker ? receive_asked : source->stream ? receive_line : receive)(path, source);
}

/* Fill the batch from buses, each with its share; how many of them had something, and whether one has more. */
static int64_t fill(struct path *path, struct source **ready, int64_t n, int64_t time_ns, bool *is_behind)
{
    struct batch *batch = path->batch;
    int64_t n_taken = 0, most = n * FEWEST_ROWS > MOST_ROWS ? n * FEWEST_ROWS : MOST_ROWS;
    bool is_news = false;
    if (n < MOST_EVENTS)
        path->words->read_ns = time_ns;
    batch->stop = batch->headroom;
    *is_behind = n == MOST_EVENTS;
    for (int64_t i = 0; i < n; i++) {
        batch->limit = batch->stop + (least(batch->capacity, batch->headroom + most) - batch->stop) / (n - i);
        int64_t first = batch->stop;
        if (ready[i]->fd < 0 || !receive_from(path, ready[i]))
            continue;
        n_taken++;
        if (batch->stop == first)
            continue;
        ready[i]->heard_ns = time_ns;
        if (batch->stop == batch->limit) {
            *is_behind = true;
            path->words->read_ns = least(path->words->read_ns, batch->time_ns[batch->stop - 1] - 1);
        }
        is_news |= ready[i]->is_watched;
    }
    if (is_news)
        path->plan->hooks.heard();
    return n_taken;
}

static bool is_among(struct source **ready, int64_t n, const struct source *source)
{
    while (n > 0 && ready[n - 1] != source)
        n--;
    return n > 0;
}

/* The buses that have something, -1: Python has to read one of them. Of a few, all are asked without a look before. */
static int64_t find_ready(struct flow *flow, struct source **ready)
{
    struct epoll_event events[MOST_EVENTS];
    for (struct source *source = flow->sources; source < flow->sources + flow->n_sources; source++)
        if (source->asker && source->asker->is_stuck)
            return -1;
    if (!flow->has_others && flow->n_sources <= FEW) {
        for (int64_t i = 0; i < flow->n_sources; i++)
            ready[i] = &flow->sources[i];
        return flow->n_sources;
    }
    int64_t n = epoll_wait((int)flow->epoll_fd, events, MOST_EVENTS, 0);
    if (n < 0)
        n = 0; /* interrupted: the next turn asks again */
    for (int64_t i = 0; i < n; i++) {
        ready[i] = source_of(flow, events[i].data.fd);
        if (!ready[i])
            return -1;
    }
    for (struct source *source = flow->sources; source < flow->sources + flow->n_sources && n < MOST_EVENTS; source++)
        if ((source->asker || (source->stream && source->stream->is_behind)) && !is_among(ready, n, source))
            ready[n++] = source;
    return n;
}

/* Take what has arrived. OTHER: a bus that Python has to read has something. */
static enum taken take(struct path *path, struct flow *flow, bool *is_other)
{
    int64_t begun_ns = path_time_ns(path);
    for (int turn = 0; turn < TURNS; turn++) {
        struct source *ready[MOST_EVENTS];
        int64_t time_ns = path_time_ns(path), n;
        bool is_behind;
        if (time_ns - begun_ns > TURN_NS)
            return SOME;
        n = find_ready(flow, ready);
        *is_other |= n < 0;
        if (n < 0 || !fill(path, ready, n, time_ns, &is_behind))
            return turn ? ALL : NOTHING;
        decode_batch(path);
        if (path->failed)
            return ALL;
        take_updates(path);
        if (!is_behind)
            return ALL;
    }
    return SOME;
}

/* Whether a bus has fallen silent that Python takes for a living one; if not, when that will be. */
static bool is_any_silent(const struct flow *flow, int64_t time_ns, int64_t *until_ns)
{
    bool any = false;
    for (const struct source *source = flow->sources; source < flow->sources + flow->n_sources; source++) {
        if (source->fd < 0 || source->is_watched)
            continue;
        any |= time_ns - source->heard_ns > flow->silence_ns;
        if (source->heard_ns + flow->silence_ns + 1 < *until_ns)
            *until_ns = source->heard_ns + flow->silence_ns + 1;
    }
    return any;
}

/* What is waited for beside the loop: of a few buses each one, which costs less than through an epoll. */
static nfds_t find_awaited(struct flow *flow, struct pollfd *fds)
{
    nfds_t n = 0;
    if (flow->has_others || flow->n_sources > FEW) {
        fds[0] = (struct pollfd){.fd = (int)flow->epoll_fd, .events = POLLIN};
        return 1;
    }
    for (const struct source *source = flow->sources; source < flow->sources + flow->n_sources; source++) {
        const struct asker *asker = source->fd >= 0 ? source->asker : NULL;
        bool is_bare = asker && asker->guests_fd < 0;
        fds[n++] = (struct pollfd){.fd = (int)(is_bare ? asker->fd : source->fd), .events = POLLIN};
    }
    return n;
}

/* Sleep until then, or until Python has something to do (true), or, if it may, a bus. */
static bool sleep_until(struct flow *flow, int64_t until_ns, int64_t time_ns, bool is_resting)
{
    struct pollfd fds[1 + FEW] = {{.fd = (int)flow->loop_fd, .events = POLLIN}};
    nfds_t n_fds = 1 + (is_resting ? 0 : find_awaited(flow, fds + 1));
    int64_t left_ns = until_ns > time_ns ? until_ns - time_ns : 0;
    struct timespec timeout = {.tv_sec = left_ns / 1000000000, .tv_nsec = left_ns % 1000000000};
    int n = ppoll(fds, n_fds, &timeout, NULL);
    return n < 0 || fds[0].revents;
}

/* When the first of those that ask has something to do. */
static int64_t first_question_ns(const struct flow *flow, int64_t until_ns)
{
    for (const struct source *source = flow->sources; source < flow->sources + flow->n_sources; source++)
        if (source->fd >= 0 && source->asker)
            until_ns = least(until_ns, asker_due_ns(source->asker));
    return until_ns;
}

/* Until there is a reason to come back. */
SKINWARE_EXPORT int64_t skinware_flow_run(struct path *path, struct flow *flow)
{
    for (;;) {
        int64_t time_ns = path_time_ns(path), due_ns = deadline_ns(path);
        bool is_other = false, is_due = time_ns >= due_ns;
        if (time_ns >= flow->until_ns)
            return TIME;
        if (is_due || time_ns >= flow->rest_until_ns) {
            enum taken taken = take(path, flow, &is_other);
            if (path->failed)
                return NO_MEMORY;
            if (is_due)
                publish_if_due(path);
            if (taken == ALL || is_other) /* Python takes, and then lets more come together */
                flow->rest_until_ns = path_time_ns(path) + flow->latency_ns;
            if (is_other)
                return OTHER_BUS;
            if (path->words->must_leave) {
                path->words->must_leave = 0;
                return NEWS;
            }
            if (taken == SOME) {
                if (sleep_until(flow, 0, 0, true))
                    return LOOP;
                continue;
            }
            time_ns = path_time_ns(path);
            due_ns = deadline_ns(path);
        }
        bool is_resting = time_ns < flow->rest_until_ns;
        int64_t until_ns = least(flow->until_ns, due_ns);
        if (is_any_silent(flow, time_ns, &until_ns))
            return NEWS;
        until_ns = first_question_ns(flow, until_ns);
        if (is_resting)
            until_ns = least(until_ns, flow->rest_until_ns);
        if (sleep_until(flow, until_ns, time_ns, is_resting))
            return LOOP;
    }
}

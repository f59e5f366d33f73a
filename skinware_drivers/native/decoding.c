/* Frames in, updates out: tests/specification/decoding.py. */
#include "inside.h"

#include <stdlib.h>

static bool grow(void *list, int64_t bytes)
{
    void *grown = realloc(*(void **)list, (size_t)bytes);
    if (grown)
        *(void **)list = grown;
    return grown;
}

/* Room for so many updates. */
bool make_room(struct path *path, int64_t most)
{
    if (!grow(&path->store, most * path->stride) || !grow(&path->spare, most * path->stride))
        return false;
    int64_t **lists[] = {&path->list, &path->other, &path->before, &path->of_patch};
    for (size_t i = 0; i < sizeof lists / sizeof *lists; i++)
        if (!grow(lists[i], most * (int64_t)sizeof **lists[i]))
            return false;
    path->most_updates = most;
    return true;
}

/* Room for one update more; its number, -1 if there is no memory. */
int64_t new_update(struct path *path)
{
    if (path->n_updates == path->most_updates) {
        int64_t most = 2 * path->most_updates;
        if (!make_room(path, most)) {
            path->failed = 1;
            return -1;
        }
    }
    memset(path->store + path->n_updates * path->stride, 0, (size_t)path->stride);
    return path->n_updates++;
}

static void keep_after_boot(struct path *path)
{
    struct batch *batch = path->batch;
    int64_t first = batch->start > batch->headroom ? batch->start : batch->headroom;
    for (int64_t row = first; row < batch->stop; row++)
        if (batch->time_ns[row] < 1) {
            batch->time_ns[row] = 1;
            path->plan->bus_counters[batch->bus[row] * N_DECODER_COUNTERS + BEFORE_BOOT]++;
        }
}

static void read_alone(struct path *path)
{
    const struct plan *plan = path->plan;
    for (int64_t row = path->batch->start; row < path->batch->stop; row++) {
        if (path->kind[row] == NO_KIND || path->entry[row] >= plan->n_modules)
            continue;
        const struct kind *kind = &plan->kinds[path->kind[row]];
        int64_t number = kind->cycle < 0 ? new_update(path) : -1;
        if (number < 0)
            continue;
        update_at(path, number)->module = path->entry[row];
        read_update(path, &plan->assemblies[kind->assembly], number, &row);
    }
}

static void leave_out_overtaken(struct path *path)
{
    for (int64_t row = path->batch->start; row < path->batch->stop; row++) {
        if (path->kind[row] == NO_KIND || path->entry[row] >= path->plan->n_modules)
            continue;
        const struct kind *kind = &path->plan->kinds[path->kind[row]];
        if (kind->cycle < 0 && kind->sequence.is_there && is_overtaken(path, &kind->sequence, row))
            path->kind[row] = NO_KIND;
    }
}

static bool comes_before(const struct path *path, int64_t one, int64_t other)
{
    const struct update *a = update_at(path, one), *b = update_at(path, other);
    return a->newest_ns < b->newest_ns || (a->newest_ns == b->newest_ns && a->row < b->row);
}

/* The updates from `first` on, in order of their time, in `list`: they are so nearly always already. */
static void put_in_order(struct path *path, int64_t first)
{
    int64_t n = path->n_updates - first, *from = path->list + first, *to = path->other + first;
    bool is_sorted = true;
    for (int64_t i = 0; i < n; i++) {
        from[i] = first + i;
        is_sorted &= !i || !comes_before(path, first + i, first + i - 1);
    }
    for (int64_t run = 1; !is_sorted && run < n; run *= 2) {
        for (int64_t begin = 0; begin < n; begin += 2 * run) {
            int64_t middle = begin + run < n ? begin + run : n, end = begin + 2 * run < n ? begin + 2 * run : n;
            int64_t i = begin, j = middle;
            for (int64_t at = begin; at < end; at++)
                to[at] = i < middle && (j >= end || !comes_before(path, from[j], from[i])) ? from[i++] : from[j++];
        }
        int64_t *swap = from;
        from = to;
        to = swap;
    }
    if (from != path->list + first)
        memcpy(path->list + first, from, (size_t)n * sizeof *from);
}

/* What waits for its partners comes first in the next batch. */
static void put_back(struct path *path)
{
    struct batch *batch = path->batch;
    int64_t n = path->n_carried;
    batch->start = batch->headroom - n;
    memcpy(batch->wire + batch->start * batch->row_bytes, path->carried_wire, (size_t)(n * batch->row_bytes));
    memcpy(batch->time_ns + batch->start, path->carried_time_ns, (size_t)n * sizeof *batch->time_ns);
    memcpy(batch->bus + batch->start, path->carried_bus, (size_t)n * sizeof *batch->bus);
    batch->stop = batch->headroom;
    batch->limit = batch->capacity;
    path->words->carried = n;
}

/* Frames that wait for partners on a bus that has lost some since are not joined with what came after. */
static void sever(struct path *path)
{
    const struct batch *batch = path->batch;
    memset(path->is_severed + batch->start, 0, (size_t)(batch->stop - batch->start));
    for (int64_t row = batch->start; row < batch->headroom && row < batch->stop; row++)
        path->is_severed[row] = path->plan->interrupted[batch->bus[row]];
    memset(path->plan->interrupted, 0, (size_t)path->plan->n_buses);
}

static bool is_awaited(const struct plan *plan, uint32_t identifier)
{
    bool found = false;
    for (int64_t i = 0; i < plan->n_awaited && !found; i++)
        found = (identifier & plan->awaited[i].mask) == plan->awaited[i].value;
    return found;
}

/* Offer rows that are of no module of ours to those who wait for such; the others are strangers. */
static void part_with(struct path *path, int64_t time_ns)
{
    int64_t n_awaited = 0, n_strangers = 0, *awaited = path->rows, *strangers = path->foreign;
    for (int64_t i = 0; i < path->n_foreign; i++) {
        int64_t row = path->foreign[i];
        if (is_awaited(path->plan, identifier_of(path->batch, row)))
            awaited[n_awaited++] = row;
        else
            strangers[n_strangers++] = row;
    }
    if (n_strangers)
        count_strangers(path, strangers, n_strangers, time_ns);
    if (n_awaited)
        path->plan->hooks.offer(awaited, n_awaited);
}

/* The batch becomes updates: those held back come first, then the new ones in order of time, all in `list`. */
void decode_batch(struct path *path)
{
    const struct plan *plan = path->plan;
    int64_t time_ns = path_time_ns(path), first = path->n_updates;
    sever(path);
    if (path->words->expects_data)
        plan->hooks.hear();
    name_rows(path, time_ns);
    leave_out_overtaken(path);
    tell_times(path);
    keep_after_boot(path);
    path->n_carried = 0;
    read_alone(path);
    for (int64_t number = 0; number < plan->n_cycles; number++)
        find_cycles(path, &plan->cycles[number], number);
    finish_updates(path, first);
    put_in_order(path, first);
    add_module_flags(path, first);
    if (path->n_foreign)
        part_with(path, time_ns);
    put_back(path);
}

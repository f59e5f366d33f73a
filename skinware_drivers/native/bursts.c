/* Where one frame of the skin ends and the next begins: tests/specification/bursts.py.
 *
 * Updates are numbers; `list` holds those of the take in order of time. An element of `before` is what Bursts._previous
 * says of the update at the same place.
 */
#include "inside.h"

enum { NEVER = -1 };

void skip(struct path *path, int64_t patch, int64_t n)
{
    const struct plan *plan = path->plan;
    plan->skipped[plan->patch_bus[patch]] += n;
}

/* Put n elements of so many bytes where they belong. */
static inline void scatter(uint8_t *to, const int32_t *places, const uint8_t *from, int64_t n, size_t bytes)
{
    for (int64_t i = 0; i < n; i++)
        memcpy(to + bytes * (size_t)places[i], from + bytes * (size_t)i, bytes);
}

static void copy_values(const struct path *path, int64_t number)
{
    const struct plan *plan = path->plan;
    const int32_t *sensors = sensors_of(path, number);
    const uint8_t *values = values_of(path, number);
    scatter(plan->status, sensors, status_of(path, number), plan->width, 1);
    switch (plan->value_bytes) { /* constants: an element is moved in one instruction */
    case 1:
        scatter(plan->values, sensors, values, plan->width, 1);
        break;
    case 2:
        scatter(plan->values, sensors, values, plan->width, 2);
        break;
    case 4:
        scatter(plan->values, sensors, values, plan->width, 4);
        break;
    default:
        scatter(plan->values, sensors, values, plan->width, 8);
        break;
    }
}

/* Of several updates of one group, the last one stays. */
void show(struct path *path, const int64_t *updates, int64_t n)
{
    const struct plan *plan = path->plan;
    bool is_to_see = n && path->words->sees_all;
    for (int64_t i = 0; i < n; i++) {
        const struct update *update = update_at(path, updates[i]);
        const int64_t *groups = (const int64_t *)(intptr_t)update->groups;
        for (int64_t j = 0; j < plan->most_groups; j++) {
            plan->touched[groups[j]] = 1;
            plan->updated[groups[j]] |= (uint8_t)update->whole;
            if (update->whole)
                plan->group_time_ns[groups[j]] = update->oldest_ns;
        }
        if (!update->whole)
            continue;
        copy_values(path, updates[i]);
        if (plan->is_prompt[update->group])
            plan->patch_time_ns[plan->group_patch[update->group]] = update->newest_ns;
        is_to_see |= update->is_flagged;
    }
    if (n && update_at(path, updates[n - 1])->newest_ns > path->words->newest_ns)
        path->words->newest_ns = update_at(path, updates[n - 1])->newest_ns;
    if (is_to_see && plan->hooks.look) {
        path->words->store = (int64_t)(intptr_t)path->store;
        plan->hooks.look(updates, n);
    }
}

/* Leave out all but the last updates of every group, so many at the most; how many are left. */
static int64_t skip_the_oldest(struct path *path, int64_t n, int64_t most)
{
    const struct plan *plan = path->plan;
    int64_t left = n, *from_last = path->of_group, limit = most > 1 ? most : 1;
    if (n <= most)
        return n;
    memset(from_last, 0, (size_t)plan->n_groups * sizeof *from_last);
    for (int64_t i = n - 1; i >= 0; i--) {
        const struct update *update = update_at(path, path->list[i]);
        if (++from_last[update->group] <= limit)
            path->list[--left] = path->list[i];
        else if (update->whole)
            skip(path, plan->group_patch[update->group], 1);
    }
    memmove(path->list, path->list + left, (size_t)(n - left) * sizeof *path->list);
    return n - left;
}

static void show_the_newest(struct path *path, const int64_t *updates, int64_t n)
{
    const struct plan *plan = path->plan;
    int64_t *of_group = path->of_group;
    memset(of_group, 0, (size_t)plan->n_groups * sizeof *of_group);
    for (int64_t i = 0; i < n; i++)
        of_group[update_at(path, updates[i])->group] += update_at(path, updates[i])->whole;
    for (int64_t group = 0; group < plan->n_groups; group++)
        if (of_group[group] + plan->updated[group] > 1)
            skip(path, plan->group_patch[group], of_group[group] + plan->updated[group] - 1);
    show(path, updates, n);
}

/* `has_begun`: patches of which this frame shows something. */
void find_begun(struct path *path)
{
    const struct plan *plan = path->plan;
    memset(path->has_begun, 0, (size_t)plan->n_patches);
    for (int64_t group = 0; group < plan->n_groups; group++)
        path->has_begun[plan->group_patch[group]] |= plan->updated[group] & plan->is_prompt[group];
}

/* `is_open`: patches whose burst has begun in this frame, is not whole, and not too old to go on. Whether any is. */
bool find_open(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    bool any = false;
    memset(path->is_open, 0, (size_t)plan->n_patches);
    for (int64_t group = 0; group < plan->n_groups; group++)
        if (!plan->touched[group] && lives(path, group))
            any = (path->is_open[plan->group_patch[group]] = 1);
    if (!any)
        return false;
    any = false;
    find_begun(path);
    for (int64_t patch = 0; patch < plan->n_patches; patch++) {
        path->is_open[patch] &= path->has_begun[patch];
        path->is_open[patch] &= time_ns - plan->patch_time_ns[patch] <= plan->burst_pause_ns[patch];
        any |= path->is_open[patch];
    }
    return any;
}

static void learn_pauses(struct path *path, int64_t n, const int64_t *gap_ns)
{
    const struct plan *plan = path->plan;
    int64_t longest_pause_ns = plan->period_ns / 2, *longest_ns = path->of_patch_ns;
    for (int64_t patch = 0; patch < plan->n_patches; patch++)
        longest_ns[patch] = INT64_MIN;
    for (int64_t i = 0; i < n; i++) {
        int64_t group = update_at(path, path->list[i])->group, patch = plan->group_patch[group];
        if (!plan->is_prompt[group])
            continue;
        plan->gap_ns[group] = gap_ns[i] < 2 * longest_pause_ns ? gap_ns[i] : 0;
        if (plan->gap_ns[group] > longest_ns[patch])
            longest_ns[patch] = plan->gap_ns[group];
    }
    for (int64_t group = 0; group < plan->n_groups; group++)
        if (plan->gap_ns[group] > longest_ns[plan->group_patch[group]])
            longest_ns[plan->group_patch[group]] = plan->gap_ns[group];
    for (int64_t patch = 0; patch < plan->n_patches; patch++) {
        double own_ns = (double)longest_pause_ns;
        if ((double)longest_ns[patch] >= plan->standing_out_ns[patch])
            own_ns = 0.75 * (double)longest_ns[patch];
        plan->burst_pause_ns[patch] = own_ns < (double)longest_pause_ns ? (int64_t)own_ns : longest_pause_ns;
    }
}

/* Fill in `before`: of an update that begins a burst, 1 + the last update of the burst before, or 0 if that was shown;
 * -1 for all others. */
static void find_bursts(struct path *path, int64_t n)
{
    const struct plan *plan = path->plan;
    int64_t *before = path->before, *of_patch = path->of_patch, *gap_ns = path->other;
    begin_chains(&path->updated_groups);
    begin_chains(&path->patches);
    for (int64_t i = 0; i < n; i++) {
        const struct update *update = update_at(path, path->list[i]);
        int64_t group = update->group, patch = plan->group_patch[group];
        int64_t previous = chain_on(&path->updated_groups, group, i);
        bool is_shown = update->whole ? plan->touched[group] : plan->updated[group];
        if (previous == NEVER)
            before[i] = is_shown ? 0 : NEVER;
        else if (!update->whole && !update_at(path, path->list[previous])->whole)
            before[i] = NEVER;
        else
            before[i] = previous + 1;
        if (!plan->is_prompt[group])
            continue; /* slow groups come at any time: they neither begin nor end a burst */
        of_patch[i] = chain_on(&path->patches, patch, i);
        gap_ns[i] = update->oldest_ns - (of_patch[i] == NEVER ? plan->patch_time_ns[patch]
                                                              : update_at(path, path->list[of_patch[i]])->newest_ns);
    }
    learn_pauses(path, n, gap_ns);
    find_begun(path);
    for (int64_t i = 0; i < n; i++) {
        int64_t group = update_at(path, path->list[i])->group, patch = plan->group_patch[group];
        if (plan->is_prompt[group] && gap_ns[i] > plan->burst_pause_ns[patch] && (of_patch[i] != NEVER || path->has_begun[patch]) &&
            of_patch[i] + 1 > before[i])
            before[i] = of_patch[i] + 1;
    }
}

static void count_and_publish(struct path *path)
{
    path->left--;
    publish(path);
}

/* From `begin` on, a burst of another patch is open: draw forward what belongs to it. If that ends it, publish, else
 * hold the rest back. How many updates are left in `list`. */
static int64_t finish(struct path *path, int64_t begin, int64_t n, int64_t threshold)
{
    const struct plan *plan = path->plan;
    int64_t n_early = 0, n_rest = 0, *early = path->other;
    memcpy(path->has_begun, path->is_open, (size_t)plan->n_patches); /* of these, what comes belongs to the open burst */
    for (int64_t i = begin; i < n; i++) {
        int64_t number = path->list[i], patch = plan->group_patch[update_at(path, number)->group];
        if (path->has_begun[patch] && path->before[i] >= threshold)
            path->has_begun[patch] = path->is_open[patch] = 0;
        if (path->has_begun[patch])
            early[n_early++] = number;
        else
            path->list[n_rest++] = number;
    }
    uint8_t *still = path->was_open;
    memcpy(still, path->is_open, (size_t)plan->n_patches);
    show(path, early, n_early);
    bool holds = false;
    if (find_open(path, update_at(path, path->list[n_rest - 1])->newest_ns))
        for (int64_t patch = 0; patch < plan->n_patches; patch++)
            holds |= still[patch] && path->is_open[patch];
    if (holds) {
        path->words->n_held = n_rest;
        return 0;
    }
    count_and_publish(path);
    return n_rest;
}

/* Cut where bursts begin; how many updates are left in `list`, to be cut anew. */
static int64_t take_in_order(struct path *path, int64_t n)
{
    const struct plan *plan = path->plan;
    int64_t begin = 0, threshold = 0;
    find_bursts(path, n);
    while (begin < n) {
        int64_t end = begin;
        while (end < n && path->before[end] < threshold)
            end++;
        show(path, path->list + begin, end - begin);
        if (end == n)
            return 0;
        if (path->left <= 0) {
            memmove(path->list, path->list + end, (size_t)(n - end) * sizeof *path->list);
            return n - end;
        }
        const struct update *next = update_at(path, path->list[end]);
        find_open(path, next->oldest_ns);
        path->is_open[plan->group_patch[next->group]] = 0;
        for (int64_t patch = 0; patch < plan->n_patches; patch++)
            if (path->is_open[patch])
                return finish(path, end, n, threshold);
        count_and_publish(path);
        begin = end;
        threshold = end + 1;
    }
    return 0;
}

/* Keep what is held back, and forget all other updates. */
static void keep_held(struct path *path)
{
    for (int64_t i = 0; i < path->words->n_held; i++)
        memcpy(path->spare + i * path->stride, path->store + path->list[i] * path->stride, (size_t)path->stride);
    uint8_t *store = path->store;
    path->store = path->spare;
    path->spare = store;
    path->n_updates = path->words->n_held;
}

/* Show the updates in as many frames as they belong to, `most` at the most; those held back come first. */
void cut_into_bursts(struct path *path, int64_t most)
{
    int64_t n = path->n_updates;
    path->left = most;
    for (int64_t i = 0; i < path->words->n_held; i++)
        path->list[i] = i;
    path->words->n_held = 0;
    n = skip_the_oldest(path, n, most);
    while (n) {
        if (path->left <= 0) {
            show_the_newest(path, path->list, n);
            break;
        }
        n = take_in_order(path, n);
    }
    keep_held(path);
}

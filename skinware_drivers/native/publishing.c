/* When a frame is published, and what it says: running/publisher.py, tests/specification/publishing.py. */
#include "inside.h"

enum { SPLIT = 4 }; /* so many frames in turn that hold a long pause are no accident */

int64_t path_time_ns(const struct path *path)
{
    return path->words->fixed_ns ? path->words->fixed_ns : skinware__clock_ns(CLOCK_MONOTONIC);
}

int64_t deadline_ns(const struct path *path)
{
    const struct words *words = path->words;
    if (!path->plan->by_cycle)
        return words->last_published_ns + path->plan->period_ns;
    int64_t deadline_ns = words->last_published_ns + path->plan->idle_ns;
    if (words->due_ns && words->due_ns < deadline_ns)
        deadline_ns = words->due_ns;
    return deadline_ns > words->not_before_ns ? deadline_ns : words->not_before_ns;
}

static void count_timing(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    int64_t *intervals = plan->timing, *ages = plan->timing + plan->n_patches * SKINWARE__BUCKETS;
    for (int64_t group = 0; group < plan->n_groups; group++) {
        if (!plan->updated[group] || !plan->is_prompt[group])
            continue;
        int64_t shown_ns = plan->group_time_ns[group], before_ns = plan->timing_before_ns[group];
        int64_t first = plan->group_patch[group] * SKINWARE__BUCKETS;
        if (before_ns > 0)
            intervals[first + skinware__bucket(shown_ns - before_ns)]++;
        ages[first + skinware__bucket(time_ns - shown_ns)]++;
        plan->timing_before_ns[group] = shown_ns;
    }
}

/* Marks groups that have been silent for too long; `of_group`: their bits. */
static bool judge_groups(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    bool any = false;
    for (int64_t group = 0; group < plan->n_groups; group++) {
        int64_t shown_ns = plan->group_time_ns[group];
        bool is_stale = shown_ns > 0 && shown_ns < time_ns - plan->age_limit_ns[group];
        path->of_group[group] = (is_stale ? plan->stale : 0) | plan->module_status[plan->group_module[group]];
        any |= path->of_group[group] != 0;
    }
    return any;
}

static void fill_status(struct path *path, uint8_t *status, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    memcpy(status, plan->status, (size_t)plan->n_sensors);
    if (judge_groups(path, time_ns))
        for (int64_t sensor = 0; sensor < plan->n_sensors; sensor++)
            status[sensor] |= (uint8_t)path->of_group[plan->sensor_group[sensor]];
}

/* What buses count themselves is there already. */
static void count_buses(const struct plan *plan)
{
    for (int64_t bus = 0; bus < plan->n_buses; bus++) {
        int64_t *counts = plan->counts + bus * plan->n_counts;
        memcpy(counts + plan->n_own_counts, plan->bus_counters + bus * N_DECODER_COUNTERS,
               N_DECODER_COUNTERS * sizeof *counts);
        counts[plan->skipped_column] = plan->skipped_before[bus] + plan->skipped[bus];
    }
}

static void fill(const void *from, uint8_t *slot, int64_t column, int64_t bytes)
{
    memcpy(slot + column, from, (size_t)bytes);
}

/* The times of groups, and of each module the oldest of its groups. */
static void fill_times(const struct plan *plan, uint8_t *slot)
{
    int64_t *of_modules = (int64_t *)(void *)(slot + plan->columns.module_time_ns);
    if (plan->groups_are_modules) {
        fill(plan->group_time_ns, slot, plan->columns.module_time_ns, plan->n_modules * 8);
        return;
    }
    fill(plan->group_time_ns, slot, plan->columns.group_time_ns, plan->n_groups * 8);
    for (int64_t group = plan->n_groups - 1; group >= 0; group--) {
        int64_t module = plan->group_module[group], time_ns = plan->group_time_ns[group];
        bool is_last = group == plan->n_groups - 1 || plan->group_module[group + 1] != module;
        if (is_last || time_ns < of_modules[module])
            of_modules[module] = time_ns;
    }
}

static void write_frame(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    const struct columns *columns = &plan->columns;
    int64_t n_timing = plan->n_patches * SKINWARE__BUCKETS;
    count_timing(path, time_ns);
    skinware_ring_writer *ring = (skinware_ring_writer *)(intptr_t)path->words->ring;
    uint8_t *slot = skinware_ring_begin(ring);
    fill(plan->values, slot, columns->values, plan->n_sensors * plan->value_bytes);
    fill_times(plan, slot);
    fill_status(path, slot + columns->status, time_ns);
    fill(plan->module_untouched, slot, columns->module_untouched, plan->n_modules);
    fill(plan->patch_state, slot, columns->patch_state, plan->n_patches);
    fill(plan->bus_state, slot, columns->bus_state, plan->n_buses);
    fill(plan->bus_reason, slot, columns->bus_reason, plan->n_buses);
    fill(plan->bus_since_ns, slot, columns->bus_since_ns, plan->n_buses * 8);
    fill(plan->bus_load, slot, columns->bus_load, plan->n_buses * 2);
    fill(plan->bus_samples, slot, columns->bus_samples, plan->bus_samples_bytes);
    fill(plan->counts, slot, columns->bus_counters, plan->n_buses * plan->n_counts * 8);
    fill(plan->patch_counters, slot, columns->patch_counters, plan->n_patches * N_PATCH_COUNTERS * 8);
    fill(plan->timing, slot, columns->patch_interval_counts, n_timing * 8);
    fill(plan->timing + n_timing, slot, columns->patch_age_counts, n_timing * 8);
    fill(plan->latency_ns, slot, columns->latency_ns, 8);
    fill(plan->data_path, slot, columns->data_path, 1);
    fill(plan->bus_data_path, slot, columns->bus_data_path, plan->n_buses);
    int64_t acquired_ns = path->words->newest_ns ? path->words->newest_ns : time_ns;
    path->words->sequence = (int64_t)skinware_ring_commit(ring, acquired_ns, 0);
}

/* Oldest stamp of what is new in this frame; if nothing is, the frame says so as of now. */
static int64_t oldest_new_ns(const struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    int64_t oldest_ns = INT64_MAX;
    for (int64_t group = 0; group < plan->n_groups; group++)
        if (plan->updated[group] && plan->group_time_ns[group] < oldest_ns)
            oldest_ns = plan->group_time_ns[group];
    return oldest_ns == INT64_MAX ? time_ns : oldest_ns;
}

void publish(struct path *path)
{
    const struct plan *plan = path->plan;
    struct words *words = path->words;
    int64_t time_ns = path_time_ns(path);
    if (!words->on_request || !words->sequence || words->wanted_ns <= oldest_new_ns(path, time_ns)) {
        write_frame(path, time_ns);
        if (words->wanted_ns != INT64_MAX)
            plan->hooks.published(oldest_new_ns(path, time_ns));
    }
    memset(plan->updated, 0, (size_t)plan->n_groups);
    memset(plan->touched, 0, (size_t)plan->n_groups);
    words->due_ns = words->not_before_ns = 0;
    words->last_published_ns = time_ns;
}

/* Note which groups live. Of a patch that begins to send, all: its first burst is not over after one. */
static void hear(struct path *path, int64_t first, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    for (int64_t number = first; number < path->n_updates; number++) {
        const struct update *update = update_at(path, number);
        int64_t patch = plan->group_patch[update->group];
        if (plan->is_prompt[update->group]) {
            if (time_ns - plan->patch_heard_ns[patch] > plan->silence_ns)
                for (int64_t group = plan->first_group[patch];
                     group < plan->n_groups && plan->group_patch[group] == patch; group++)
                    plan->group_heard_ns[group] = time_ns;
            plan->patch_heard_ns[patch] = time_ns;
        }
        plan->group_heard_ns[update->group] = time_ns;
        int64_t seen_ns = update->newest_ns < time_ns ? update->newest_ns : time_ns;
        int64_t until_ns = seen_ns + plan->age_limit_ns[update->group];
        if (update->whole && until_ns > plan->patch_lives_until_ns[patch])
            plan->patch_lives_until_ns[patch] = until_ns;
    }
}

static void update_patch_states(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    for (int64_t patch = 0; patch < plan->n_patches; patch++)
        if (plan->patch_lives_until_ns[patch] > time_ns)
            plan->patch_state[patch] = (uint8_t)plan->state_live;
        else if (plan->patch_state[patch] == plan->state_live)
            plan->patch_state[patch] = (uint8_t)plan->state_stale;
}

/* Whether patches send together, and pause, and this complete frame ends before that pause; if not, `is_early`: the
 * groups that came before the pause. */
static void find_pause(struct path *path)
{
    const struct plan *plan = path->plan;
    int64_t oldest_ns = INT64_MAX, newest_ns = INT64_MIN;
    for (int64_t group = 0; group < plan->n_groups; group++) {
        if (!plan->updated[group] || !plan->is_prompt[group])
            continue;
        if (plan->group_time_ns[group] < oldest_ns)
            oldest_ns = plan->group_time_ns[group];
        if (plan->group_time_ns[group] > newest_ns)
            newest_ns = plan->group_time_ns[group];
    }
    if (newest_ns <= oldest_ns) {
        path->n_split = 0;
        return;
    }
    int64_t middle_ns = oldest_ns + (newest_ns - oldest_ns) / 2, begin_ns = oldest_ns, end_ns = newest_ns;
    for (int64_t group = 0; group < plan->n_groups; group++) {
        int64_t shown_ns = plan->group_time_ns[group];
        bool is_new = plan->updated[group] && plan->is_prompt[group];
        path->is_early[group] = is_new && shown_ns <= middle_ns;
        if (path->is_early[group] && shown_ns > begin_ns)
            begin_ns = shown_ns;
        else if (is_new && shown_ns > middle_ns && shown_ns < end_ns)
            end_ns = shown_ns;
    }
    path->n_split = end_ns - begin_ns > plan->period_ns / 8 * 5 ? path->n_split + 1 : 0;
}

/* Whether all has come that comes before the pause, so that the next frame can begin behind it. */
static bool is_at_pause(const struct path *path)
{
    if (path->n_split < SPLIT || path->words->on_request)
        return false;
    for (int64_t group = 0; group < path->plan->n_groups; group++)
        if (path->is_early[group] && !path->plan->updated[group])
            return false;
    return true;
}

/* After new data: publish a complete frame, or say when it will be due. */
static void look_at_frame(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    bool any_updated = false, any_touched = false, is_complete = true;
    if (path->words->n_held) {
        path->words->due_ns = time_ns + plan->pause_ns;
        return;
    }
    for (int64_t group = 0; group < plan->n_groups; group++) {
        any_updated |= plan->updated[group];
        any_touched |= plan->touched[group];
        is_complete &= plan->touched[group] || !lives(path, group);
    }
    if (any_updated && is_complete) {
        find_pause(path);
        publish(path);
    } else if (any_updated && is_at_pause(path)) {
        path->n_split = 0;
        publish(path);
    } else if (!path->words->due_ns && any_touched)
        path->words->due_ns = time_ns + plan->patience_ns;
}

/* Show the updates of a batch, publishing as often as needed for none to be overwritten unseen. */
void take_updates(struct path *path)
{
    const struct plan *plan = path->plan;
    int64_t time_ns = path_time_ns(path), first = path->words->n_held;
    if (path->n_updates == first)
        return;
    count_buses(plan);
    hear(path, first, time_ns);
    update_patch_states(path, time_ns);
    if (!plan->by_cycle) {
        show(path, path->list, path->n_updates);
        path->n_updates = 0;
        return;
    }
    path->living_ns = time_ns;
    cut_into_bursts(path, plan->most_at_once - 1);
    look_at_frame(path, time_ns);
}

/* Publish if the time has come, and nothing speaks against it. */
void publish_if_due(struct path *path)
{
    const struct plan *plan = path->plan;
    struct words *words = path->words;
    int64_t time_ns = path_time_ns(path);
    if (time_ns < deadline_ns(path))
        return;
    count_buses(plan);
    update_patch_states(path, time_ns);
    if (!plan->by_cycle) {
        publish(path);
        return;
    }
    int64_t read_ns = words->read_ns < time_ns ? words->read_ns : time_ns;
    path->living_ns = read_ns;
    if (find_open(path, read_ns)) {
        words->due_ns = 0;
        for (int64_t patch = 0; patch < plan->n_patches; patch++)
            if (path->is_open[patch] && plan->patch_time_ns[patch] + plan->burst_pause_ns[patch] >= words->due_ns)
                words->due_ns = plan->patch_time_ns[patch] + plan->burst_pause_ns[patch] + 1;
        words->not_before_ns = words->due_ns;
        return;
    }
    publish(path);
    cut_into_bursts(path, plan->most_at_once - 2);
    look_at_frame(path, read_ns);
}

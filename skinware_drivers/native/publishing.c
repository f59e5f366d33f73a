/* When a frame is published, and what it says: running/publisher.py and patch_timing.py. */
#include "inside.h"

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
    for (int64_t module = 0; module < plan->n_modules; module++) {
        if (!plan->updated[module])
            continue;
        int64_t shown_ns = plan->module_time_ns[module], before_ns = plan->timing_before_ns[module];
        int64_t first = plan->module_patch[module] * SKINWARE__BUCKETS;
        if (before_ns > 0)
            intervals[first + skinware__bucket(shown_ns - before_ns)]++;
        ages[first + skinware__bucket(time_ns - shown_ns)]++;
        plan->timing_before_ns[module] = shown_ns;
    }
}

/* Marks modules that missed their patch's last update, or have been silent for too long; `of_module`: their bits. */
static bool judge_modules(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    bool any = false;
    find_begun(path);
    for (int64_t module = 0; module < plan->n_modules; module++) {
        int64_t patch = plan->module_patch[module], shown_ns = plan->module_time_ns[module];
        if (plan->by_cycle)
            plan->behind[module] = (plan->behind[module] | path->has_begun[patch]) && !plan->updated[module];
        else
            plan->behind[module] = plan->patch_time_ns[patch] - shown_ns > plan->period_ns * 3 / 2;
        bool is_stale = shown_ns > 0 && (plan->behind[module] || shown_ns < time_ns - plan->silence_ns);
        path->of_module[module] = (is_stale ? plan->stale : 0) | plan->module_status[module];
        any |= path->of_module[module] != 0;
    }
    return any;
}

static void fill_status(struct path *path, uint8_t *status, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    memcpy(status, plan->status, (size_t)plan->n_sensors);
    if (judge_modules(path, time_ns))
        for (int64_t sensor = 0; sensor < plan->n_sensors; sensor++)
            status[sensor] |= (uint8_t)path->of_module[plan->sensor_module[sensor]];
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

static void write_frame(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    const struct columns *columns = &plan->columns;
    int64_t n_timing = plan->n_patches * SKINWARE__BUCKETS;
    count_timing(path, time_ns);
    skinware_ring_writer *ring = (skinware_ring_writer *)(intptr_t)path->words->ring;
    uint8_t *slot = skinware_ring_begin(ring);
    fill(plan->values, slot, columns->values, plan->n_sensors * plan->value_bytes);
    fill(plan->module_time_ns, slot, columns->module_time_ns, plan->n_modules * 8);
    fill_status(path, slot + columns->status, time_ns);
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
    for (int64_t module = 0; module < plan->n_modules; module++)
        if (plan->updated[module] && plan->module_time_ns[module] < oldest_ns)
            oldest_ns = plan->module_time_ns[module];
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
    memset(plan->updated, 0, (size_t)plan->n_modules);
    memset(plan->touched, 0, (size_t)plan->n_modules);
    words->due_ns = words->not_before_ns = 0;
    words->last_published_ns = time_ns;
}

/* Note who lives. Of a patch that begins to send, all its modules: its first burst is not over after one. */
static void hear(struct path *path, int64_t first, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    for (int64_t number = first; number < path->n_updates; number++) {
        const struct update *update = update_at(path, number);
        int64_t patch = plan->module_patch[update->module];
        if (time_ns - plan->patch_heard_ns[patch] > plan->silence_ns)
            for (int64_t module = plan->first_module[patch];
                 module < plan->n_modules && plan->module_patch[module] == patch; module++)
                plan->module_heard_ns[module] = time_ns;
        plan->patch_heard_ns[patch] = plan->module_heard_ns[update->module] = time_ns;
    }
    for (int64_t i = first; i < path->n_updates; i++) {
        const struct update *update = update_at(path, path->list[i]);
        if (update->whole)
            plan->patch_updated_ns[plan->module_patch[update->module]] = update->newest_ns;
    }
}

static void update_patch_states(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    int64_t since_ns = time_ns > plan->silence_ns ? time_ns - plan->silence_ns : 0;
    for (int64_t patch = 0; patch < plan->n_patches; patch++)
        if (plan->patch_updated_ns[patch] > since_ns)
            plan->patch_state[patch] = (uint8_t)plan->state_live;
        else if (plan->patch_state[patch] == plan->state_live)
            plan->patch_state[patch] = (uint8_t)plan->state_stale;
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
    for (int64_t module = 0; module < plan->n_modules; module++) {
        any_updated |= plan->updated[module];
        any_touched |= plan->touched[module];
        is_complete &= plan->touched[module] || !lives(path, module);
    }
    if (any_updated && is_complete)
        publish(path);
    else if (!path->words->due_ns && any_touched)
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

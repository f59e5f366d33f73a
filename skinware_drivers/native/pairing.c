/* Which frames belong together: tests/specification/pairing.py.
 *
 * The rows of a batch are put in the order of their groups (patches or modules), in which the members of a cycle follow
 * each other. All arrays below are in that order; `order` has the row of each.
 */
#include "inside.h"

/* Fill in `order` and `group`; the groups come as they appear, each with its rows in order of arrival. */
static int64_t by_group(struct path *path, const struct cycle *cycle)
{
    const struct batch *batch = path->batch;
    int64_t n_groups = 0, n = 0, *first = path->first_of_group;
    begin_chains(&path->groups);
    for (int64_t row = batch->start; row < batch->stop; row++) {
        int64_t before = chain_on(&path->groups, cycle->group_of_entry[path->entry[row]], row);
        path->next[row] = -1;
        if (before < 0)
            first[n_groups++] = row;
        else
            path->next[before] = row;
    }
    for (int64_t group = 0; group < n_groups; group++)
        for (int64_t row = first[group]; row >= 0; row = path->next[row]) {
            path->order[n] = row;
            path->group[n++] = group;
        }
    return n;
}

/* Tell how frames come: soon after the one before of their kind, held up, or after one that was lost. */
static void judge(struct path *path, const struct cycle *cycle, int64_t m)
{
    begin_chains(&path->punctual);
    for (int64_t i = 0; i < m; i++) {
        if (path->place[i] >= cycle->n)
            continue;
        int64_t key = path->shared[i] * cycle->n + path->place[i];
        bool is_first = chain_on(&path->punctual, key, i) < 0;
        int64_t before_ns = is_first ? cycle->last_ns[key] : path->before_ns[key];
        int64_t usual_ns = is_first ? cycle->spacing_ns[key] : path->before_spacing_ns[key];
        int64_t spacing_ns = before_ns == NEVER_NS ? cycle->period_ns : path->time_ns[i] - before_ns;
        int64_t longer_ns = usual_ns > cycle->period_ns ? usual_ns : cycle->period_ns;
        bool is_late = spacing_ns >= 2 * longer_ns - cycle->reach_ns - cycle->margin_ns, is_held_up = is_late;
        if (is_late && !cycle->all_as_they_should) {
            int64_t half_ns = cycle->period_ns / 2;
            int64_t beside_ns = floor_mod(spacing_ns + half_ns, cycle->period_ns) - half_ns;
            is_held_up = 2 * (beside_ns < 0 ? -beside_ns : beside_ns) >= cycle->period_ns - cycle->reach_ns;
        }
        path->before_ns[key] = path->time_ns[i];
        path->before_spacing_ns[key] = path->spacing_ns[i] = spacing_ns;
        path->is_soon[i] = spacing_ns <= cycle->soon_ns;
        path->is_held_up[i] = is_held_up;
        path->is_doubtful[i] = is_late;
    }
}

/* Whether the n frames from i on are a whole cycle. */
static bool is_cycle(const struct path *path, const struct cycle *cycle, int64_t i)
{
    uint32_t seen = 0; /* of an order that is not given */
    for (int64_t j = 0; j < cycle->n; j++) {
        int64_t place = path->place[i + j];
        if (place >= cycle->n || path->shared[i + j] != path->shared[i] || (cycle->order == GIVEN && place != j))
            return false;
        if (cycle->order != GIVEN)
            seen |= UINT32_C(1) << place;
    }
    if (cycle->order == ENDS_WITH && path->place[i + cycle->n - 1] != cycle->n - 1)
        return false;
    return cycle->order == GIVEN || seen == (uint32_t)((UINT64_C(1) << cycle->n) - 1);
}

static bool can_be_trusted(const struct path *path, const struct cycle *cycle, int64_t i)
{
    bool all_doubtful = true;
    for (int64_t j = i; j < i + cycle->n; j++) {
        if (path->is_soon[j] || path->is_held_up[j])
            return false;
        all_doubtful &= path->is_doubtful[j];
    }
    return !all_doubtful;
}

/* Rows at the end of a group, before `end`, that may become a cycle with what comes next. */
static void hope(struct path *path, const struct cycle *cycle, int64_t begin, int64_t end)
{
    int64_t last = end - 1;
    if (path->place[last] >= cycle->n || path->is_used[last])
        return;
    for (int64_t length = cycle->n - 1; length > 0; length--) {
        int64_t first = end - length;
        uint32_t seen = 0;
        bool fits = first >= begin;
        for (int64_t j = 0; fits && j < length; j++) {
            int64_t place = path->place[first + j];
            fits = place < cycle->n && !path->is_used[first + j] && path->shared[first + j] == path->shared[last] &&
                   (cycle->order == GIVEN ? place == j : !(seen >> place & 1));
            if (fits && cycle->order != GIVEN)
                seen |= UINT32_C(1) << place;
        }
        if (fits) {
            memset(path->is_waiting + first, 1, (size_t)length);
            return;
        }
    }
}

/* The cycles among the rows; afterwards is_used, is_waiting and is_orphan say what became of each. The first places of
 * the cycles are in `starts`, of those that took too long or came out of time in `found`. */
static int64_t match(struct path *path, const struct cycle *cycle, int64_t m, int64_t *n_late)
{
    int64_t n = cycle->n, n_starts = 0, n_candidates = 0, n_out = 0;
    int64_t *starts = path->starts, *late = path->found;
    for (int64_t i = 0; i + n <= m; i++) {
        if (!is_cycle(path, cycle, i))
            continue;
        if (!can_be_trusted(path, cycle, i) || path->time_ns[i + n - 1] - path->time_ns[i] > cycle->maximum_age_ns)
            late[n_candidates++] = i;
        else if (!n_starts || i >= starts[n_starts - 1] + n)
            starts[n_starts++] = i;
    }
    for (int64_t s = 0; s < n_starts; s++)
        memset(path->is_used + starts[s], 1, (size_t)n);
    for (int64_t begin = 0, end; begin < m; begin = end) {
        for (end = begin + 1; end < m && path->group[end] == path->group[begin];)
            end++;
        hope(path, cycle, begin, end);
    }
    for (int64_t i = 0; i < m; i++)
        path->is_orphan[i] = path->is_member[i] && !path->is_used[i] && !path->is_waiting[i];
    for (int64_t c = 0; c < n_candidates; c++) {
        bool all_orphans = !n_out || late[c] >= late[n_out - 1] + n;
        for (int64_t j = 0; all_orphans && j < n; j++)
            all_orphans = path->is_orphan[late[c] + j];
        if (all_orphans)
            late[n_out++] = late[c];
    }
    *n_late = n_out;
    return n_starts;
}

static void carry(struct path *path, int64_t row)
{
    const struct batch *batch = path->batch;
    if (path->n_carried >= batch->headroom)
        return; /* cannot be: a group has one unfinished cycle */
    memcpy(path->carried_wire + path->n_carried * batch->row_bytes, batch->wire + row * batch->row_bytes,
           (size_t)batch->row_bytes);
    path->carried_time_ns[path->n_carried] = batch->time_ns[row];
    path->carried_bus[path->n_carried++] = batch->bus[row];
}

static void fill_in(struct path *path, const struct cycle *cycle, int64_t number, int64_t m)
{
    const struct plan *plan = path->plan;
    for (int64_t i = 0; i < m; i++) {
        int64_t row = path->order[i], entry = path->entry[row];
        const struct kind *kind = path->kind[row] == NO_KIND ? NULL : &plan->kinds[path->kind[row]];
        bool is_member = entry < plan->n_modules && kind && kind->cycle == number;
        path->shared[i] = entry;
        if (is_member && cycle->has_counter) {
            uint64_t count = (uint64_t)read_number(payload_of(path->batch, row), &cycle->counters[kind->place]);
            path->shared[i] = entry << 32 | (int64_t)(count & UINT32_MAX);
        } else if (cycle->has_counter)
            path->shared[i] = entry << 32;
        path->is_member[i] = is_member;
        path->place[i] = (uint8_t)(is_member && !path->is_severed[row] ? kind->place : cycle->n);
        path->time_ns[i] = path->batch->time_ns[row];
    }
    uint8_t *unset[] = {path->is_soon, path->is_held_up, path->is_doubtful, path->is_used, path->is_waiting};
    for (size_t i = 0; i < sizeof unset / sizeof *unset; i++)
        memset(unset[i], 0, (size_t)m);
}

static void add_orphan(struct path *path, const struct cycle *cycle, int64_t row)
{
    int64_t number = new_update(path);
    if (number < 0)
        return;
    struct update *update = update_at(path, number);
    update->module = path->entry[row];
    update->row = row;
    join_groups(path, update, &path->plan->assemblies[cycle->assembly]);
    update->oldest_ns = update->newest_ns = path->batch->time_ns[row];
    path->plan->patch_counters[path->plan->module_patch[update->module] * N_PATCH_COUNTERS + ORPHANS]++;
}

static void add_cycle(struct path *path, const struct cycle *cycle, int64_t start)
{
    int64_t rows[MOST_MEMBERS];
    for (int64_t j = 0; j < cycle->n; j++)
        rows[path->place[start + j]] = path->order[start + j];
    if (cycle->compared_member >= 0 && is_overtaken(path, &cycle->compared, rows[cycle->compared_member]))
        return;
    int64_t number = new_update(path);
    if (number < 0)
        return;
    update_at(path, number)->module = path->entry[rows[0]];
    read_update(path, &path->plan->assemblies[cycle->assembly], number, rows);
}

/* Make updates of the whole cycles of a batch, and of the orphans; what may still become whole is carried on. */
void find_cycles(struct path *path, const struct cycle *cycle, int64_t number)
{
    const struct plan *plan = path->plan;
    int64_t n_late = 0, m = by_group(path, cycle);
    fill_in(path, cycle, number, m);
    if (cycle->is_timed)
        judge(path, cycle, m);
    int64_t n_starts = match(path, cycle, m, &n_late);
    for (int64_t i = 0; i < m; i++) {
        int64_t row = path->order[i];
        path->next[row] = -1; /* from now on: the cycle that ends with this row */
        if (cycle->is_timed && path->place[i] < cycle->n && !path->is_waiting[i]) {
            int64_t key = path->shared[i] * cycle->n + path->place[i];
            cycle->last_ns[key] = path->time_ns[i];
            cycle->spacing_ns[key] = path->spacing_ns[i];
        }
        if (path->is_orphan[i]) {
            path->next[row] = m + i;
            path->words->warns |= path->is_soon[i];
            plan->haste[plan->module_patch[path->entry[row]]] += path->is_soon[i];
        } else if (path->is_waiting[i])
            path->next[row] = 2 * m + i;
    }
    for (int64_t late = 0; late < n_late; late++) {
        int64_t module = path->entry[path->order[path->found[late]]];
        plan->patch_counters[plan->module_patch[module] * N_PATCH_COUNTERS + LATE]++;
    }
    for (int64_t s = 0; s < n_starts; s++) {
        int64_t start = path->starts[s], patch = plan->module_patch[path->entry[path->order[start]]];
        path->next[path->order[start + cycle->n - 1]] = start;
        if (plan->haste[patch] > 0)
            plan->haste[patch] = 0;
    }
    for (int64_t row = path->batch->start; row < path->batch->stop; row++) {
        int64_t what = path->next[row];
        if (what >= 2 * m)
            carry(path, row);
        else if (what >= m)
            add_orphan(path, cycle, row);
        else if (what >= 0)
            add_cycle(path, cycle, what);
    }
}

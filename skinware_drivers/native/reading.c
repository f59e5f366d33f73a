/* From payloads to values and flags: tests/specification/reading.py. */
#include "inside.h"

static const uint8_t bytes_of_type[] = {1, 1, 2, 2, 4, 4, 8, 8, 4, 8};

struct value { /* what was read: integer (of type U8: its bits), or real (of types F4 and F8) */
    int64_t integer;
    double real;
};

/* The bits of a word, those of a signed one extended. */
uint64_t read_word(const uint8_t *at, int64_t type, int64_t is_swapped)
{
    uint64_t word = 0;
    switch (bytes_of_type[type]) {
    case 1:
        word = at[0];
        break;
    case 2: {
        uint16_t half;
        memcpy(&half, at, sizeof half);
        word = is_swapped ? __builtin_bswap16(half) : half;
        break;
    }
    case 4: {
        uint32_t whole;
        memcpy(&whole, at, sizeof whole);
        word = is_swapped ? __builtin_bswap32(whole) : whole;
        break;
    }
    default:
        memcpy(&word, at, sizeof word);
        word = is_swapped ? __builtin_bswap64(word) : word;
    }
    switch (type) {
    case I1:
        return (uint64_t)(int64_t)(int8_t)word;
    case I2:
        return (uint64_t)(int64_t)(int16_t)word;
    case I4:
        return (uint64_t)(int64_t)(int32_t)word;
    default:
        return word;
    }
}

int64_t read_number(const uint8_t *payload, const struct number *number)
{
    uint64_t word = read_word(payload + number->offset, number->type, number->is_swapped);
    return (int64_t)((word & (uint64_t)number->mask) >> number->shift);
}

static struct value read_value(const uint8_t *at, int64_t type, int64_t is_swapped)
{
    uint64_t word = read_word(at, type, is_swapped);
    struct value value = {.integer = (int64_t)word};
    if (type == F4) {
        float real;
        uint32_t bits = (uint32_t)word;
        memcpy(&real, &bits, sizeof real);
        value.real = (double)real;
    } else if (type == F8)
        memcpy(&value.real, &word, sizeof word);
    return value;
}

static int64_t unpack(const uint8_t *payload, const struct run *run, int64_t number)
{
    int64_t first = run->skip + number * run->bits, value = 0;
    for (int64_t bit = 0; bit < run->bits; bit++) {
        int64_t at = first + bit;
        int64_t set = payload[run->offset + at / 8] >> (run->is_little ? at % 8 : 7 - at % 8) & 1;
        value |= set << (run->is_little ? bit : run->bits - 1 - bit);
    }
    if (run->is_signed)
        value -= (value >> (run->bits - 1) & 1) << run->bits;
    return value;
}

static void store(uint8_t *at, int64_t to, struct value value, int64_t from)
{
    uint64_t word = (uint64_t)value.integer;
    float single;
    double real;
    switch (to) {
    case F4:
        single = from == F4 || from == F8 ? (float)value.real : from == U8 ? (float)word : (float)value.integer;
        memcpy(at, &single, sizeof single);
        return;
    case F8:
        real = from == F4 || from == F8 ? value.real : from == U8 ? (double)word : (double)value.integer;
        memcpy(at, &real, sizeof real);
        return;
    default:
        memcpy(at, &word, bytes_of_type[to]);
    }
}

static void read_run(const struct run *run, const uint8_t *payload, uint8_t *values, int64_t to)
{
    int64_t size = bytes_of_type[to];
    if (run->type == to && !run->is_swapped) {
        memcpy(values, payload + run->offset, (size_t)(run->count * size));
        return;
    }
    for (int64_t i = 0; i < run->count; i++) {
        const uint8_t *at = payload + run->offset + i * (run->type == PACKED ? 0 : bytes_of_type[run->type]);
        if (run->type == PACKED)
            store(values + i * size, to, (struct value){.integer = unpack(payload, run, i)}, I8);
        else if (run->type == to) { /* as it is: a double would make a quiet NaN of a signaling one */
            uint64_t word = read_word(at, to, run->is_swapped);
            memcpy(values + i * size, &word, (size_t)size);
        } else
            store(values + i * size, to, read_value(at, run->type, run->is_swapped), run->type);
    }
}

/* Whether a flag means a value: it is equal to a sentinel, or above a limit. */
static bool is_meant(const struct flag *flag, struct value value, int64_t type)
{
    bool is_above = flag->form == ABOVE, is_real = type == F4 || type == F8;
    if (is_real || flag->is_float) {
        double real = is_real ? value.real : type == U8 ? (double)(uint64_t)value.integer : (double)value.integer;
        if (is_above)
            return real > flag->real;
        return is_real && flag->real != flag->real ? real != real : real == flag->real;
    }
    if (!is_above)
        return value.integer == flag->integer;
    return type == U8 ? (uint64_t)value.integer > (uint64_t)flag->integer : value.integer > flag->integer;
}

static void flag_values(const struct path *path, const struct kind *kind, const struct flag *flag,
                        const uint8_t *payload, const uint8_t *values, uint8_t *status)
{
    int64_t to = path->plan->value_type, size = path->plan->value_bytes;
    for (int64_t i = 0; kind->is_expanded && i < kind->width; i++)
        if (is_meant(flag, read_value(values + (kind->column + i) * size, to, 0), to))
            status[kind->column + i] |= (uint8_t)flag->status;
    for (const struct run *run = kind->runs; run < kind->runs + kind->n_runs; run++)
        for (int64_t i = 0; i < run->count; i++) {
            struct value value = {0};
            if (run->type == PACKED)
                value.integer = unpack(payload, run, i);
            else
                value = read_value(payload + run->offset + i * bytes_of_type[run->type], run->type, run->is_swapped);
            if (is_meant(flag, value, run->type == PACKED ? I8 : run->type))
                status[run->column + i] |= (uint8_t)flag->status;
        }
}

static void flag_word(const struct path *path, const struct assembly *assembly, const struct flag *flag,
                      const uint8_t *payload, int64_t length, uint8_t *status)
{
    int64_t width = path->plan->width;
    if (length < flag->offset + bytes_of_type[flag->type])
        return;
    uint64_t word = read_word(payload + flag->offset, flag->type, flag->is_swapped) ^ (uint64_t)flag->normal;
    if (!word)
        return;
    for (int64_t i = 0; word & (uint64_t)flag->mask && i < width; i++)
        status[i] |= (uint8_t)flag->status;
    for (const struct channel_bit *each = flag->each; each < flag->each + flag->n_each; each++) {
        if (!(word >> each->shift & 1))
            continue;
        for (int64_t i = 0; i < width; i++)
            if (assembly->channels[i] == each->channel)
                status[i] |= (uint8_t)flag->status;
    }
}

static void apply_flags(const struct path *path, const struct kind *kind, int64_t number, int64_t row)
{
    const uint8_t *payload = payload_of(path->batch, row);
    int64_t length = length_of(path->batch, row);
    uint8_t *status = status_of(path, number);
    for (const struct flag *flag = kind->flags; flag < kind->flags + kind->n_flags; flag++) {
        if (flag->form == SENTINEL || flag->form == ABOVE)
            flag_values(path, kind, flag, payload, values_of(path, number), status);
        else if (flag->form == WORD)
            flag_word(path, &path->plan->assemblies[kind->assembly], flag, payload, length, status);
        else if (length >= flag->offset + kind->width)
            for (int64_t i = 0; i < kind->width; i++)
                status[kind->column + i] |= payload[flag->offset + i] & (uint8_t)flag->mask;
    }
}

/* A frame with the status of other modules says which flags they have from now on. */
static void flag_modules(const struct path *path, const struct kind *kind, int64_t module, int64_t row)
{
    const struct plan *plan = path->plan;
    for (const struct flag *flag = kind->flags; flag < kind->flags + kind->n_flags; flag++) {
        if (!flag->n_modules || length_of(path->batch, row) < flag->offset + bytes_of_type[flag->type])
            continue;
        uint64_t word = read_word(payload_of(path->batch, row) + flag->offset, flag->type, flag->is_swapped);
        word ^= (uint64_t)flag->normal;
        const struct module_bit *bit = flag->modules + plan->module_patch[module] * flag->n_modules;
        for (const struct module_bit *end = bit + flag->n_modules; bit < end; bit++) {
            if (bit->module < 0)
                continue;
            uint8_t *flags = &plan->module_flags[bit->module];
            *flags = (uint8_t)((word >> bit->shift & 1) ? *flags | flag->status : *flags & ~flag->status);
        }
    }
}

/* Add the flags that frames of other modules set, up to each whole update from `first` on, in order of time. */
void add_module_flags(struct path *path, int64_t first)
{
    const struct plan *plan = path->plan;
    for (int64_t i = first; plan->module_flags && i < path->n_updates; i++) {
        struct update *update = update_at(path, path->list[i]);
        const struct kind *kind = &plan->kinds[path->kind[update->row]];
        uint8_t *status = status_of(path, path->list[i]);
        if (!update->whole)
            continue;
        flag_modules(path, kind, update->module, update->row);
        for (int64_t value = 0; value < plan->width; value++) {
            status[value] |= plan->module_flags[update->module];
            update->is_flagged |= status[value] != 0;
        }
    }
}

/* Note which groups an update of a module belongs to. */
void join_groups(const struct path *path, struct update *update, const struct assembly *assembly)
{
    const int64_t *groups = assembly->groups + update->module * path->plan->most_groups;
    update->groups = (int64_t)(intptr_t)groups;
    update->group = groups[0];
}

/* Read the frames of a whole update, those that Python reads excepted. `rows`: one of each member, in order. */
void read_update(struct path *path, const struct assembly *assembly, int64_t number, const int64_t *rows)
{
    const struct plan *plan = path->plan;
    const struct batch *batch = path->batch;
    struct update *update = update_at(path, number);
    memcpy(sensors_of(path, number), assembly->destination + update->module * plan->width,
           (size_t)plan->width * sizeof(int32_t));
    join_groups(path, update, assembly);
    update->whole = 1;
    update->row = rows[0];
    update->oldest_ns = update->newest_ns = batch->time_ns[rows[0]];
    for (int64_t member = 0; member < assembly->n_members; member++) {
        int64_t row = rows[member], time_ns = batch->time_ns[row];
        const struct kind *kind = &plan->kinds[assembly->members[member]];
        if (time_ns < update->oldest_ns)
            update->oldest_ns = time_ns;
        if (time_ns > update->newest_ns)
            update->newest_ns = time_ns;
        if (row > update->row)
            update->row = row;
        if (kind->is_expanded) {
            path->expanded_update[path->n_expanded] = number;
            path->expanded_kind[path->n_expanded] = assembly->members[member];
            path->expanded_row[path->n_expanded++] = row;
            continue;
        }
        for (const struct run *run = kind->runs; run < kind->runs + kind->n_runs; run++)
            read_run(run, payload_of(batch, row), values_of(path, number) + run->column * plan->value_bytes,
                     plan->value_type);
        apply_flags(path, kind, number, row);
    }
}

/* Let Python read the frames of one kind. */
static void expand(struct path *path, int64_t kind)
{
    const struct plan *plan = path->plan;
    int64_t n = 0, *updates = path->rows, *rows = path->found;
    for (int64_t i = 0; i < path->n_expanded; i++)
        if (path->expanded_kind[i] == kind) {
            updates[n] = path->expanded_update[i];
            rows[n++] = path->expanded_row[i];
        }
    if (!n)
        return;
    memset(path->has_failed, 0, (size_t)n);
    path->words->store = (int64_t)(intptr_t)path->store;
    plan->hooks.expand(kind, updates, rows, path->has_failed, n);
    for (int64_t i = 0; i < n; i++) {
        struct update *update = update_at(path, updates[i]);
        if (path->has_failed[i])
            update->whole--; /* one of its frames cannot be read */
        else
            apply_flags(path, &plan->kinds[kind], updates[i], rows[i]);
    }
}

/* An update that lacks frames, as they could not be read; the others are orphans. Not the first row tells its bus: all
 * frames of a module come over the same. */
static void spoil(struct path *path, int64_t number)
{
    const struct plan *plan = path->plan;
    struct update *update = update_at(path, number);
    const struct kind *kind = &plan->kinds[path->kind[update->row]];
    int64_t n_failed = 1 - update->whole, patch = plan->module_patch[update->module];
    int64_t bus = path->batch->bus[update->row];
    plan->bus_counters[bus * N_DECODER_COUNTERS + BAD_CONTENT] += n_failed;
    plan->patch_counters[patch * N_PATCH_COUNTERS + ORPHANS] += plan->assemblies[kind->assembly].n_members - n_failed;
    update->whole = 0;
    memset(status_of(path, number), 0, (size_t)plan->width);
}

/* All rows are read: let Python read its own, count the whole updates, and see which are flagged. */
void finish_updates(struct path *path, int64_t first)
{
    const struct plan *plan = path->plan;
    for (int64_t kind = 0; path->n_expanded && kind < plan->n_kinds; kind++)
        if (plan->kinds[kind].is_expanded)
            expand(path, kind);
    for (int64_t i = 0; i < path->n_expanded; i++)
        if (update_at(path, path->expanded_update[i])->whole < 1 &&
            (!i || path->expanded_update[i] != path->expanded_update[i - 1]))
            spoil(path, path->expanded_update[i]);
    path->n_expanded = 0;
    for (int64_t number = first; number < path->n_updates; number++) {
        struct update *update = update_at(path, number);
        const uint8_t *status = status_of(path, number);
        if (!update->whole)
            continue;
        plan->patch_counters[plan->module_patch[update->module] * N_PATCH_COUNTERS + UPDATES]++;
        for (int64_t i = 0; i < plan->width && !update->is_flagged; i++)
            update->is_flagged = status[i] != 0;
    }
}

/* Compare the number in a frame with those of its module before; whether another frame has overtaken it. One whose number
 * has come already is taken for that, too, unless the next one follows it: then the device has begun to count again. */
bool is_overtaken(struct path *path, const struct number *sequence, int64_t row)
{
    const struct plan *plan = path->plan;
    int64_t module = path->entry[row], number = read_number(payload_of(path->batch, row), sequence);
    int64_t *last = plan->last_sequence + N_OF_SEQUENCE * module, turn = sequence->turn;
    int64_t step = last[NEWEST] == -1 ? 1 : floor_mod((int64_t)((uint64_t)number - (uint64_t)last[NEWEST]), turn);
    int64_t *counters = plan->patch_counters + plan->module_patch[module] * N_PATCH_COUNTERS, back = turn - step;
    uint64_t came = (uint64_t)last[CAME];
    bool is_back = step > turn / 2, is_near = is_back && back <= 64 && turn > 2 * 64; /* small ones turn in a loss */
    counters[SEQUENCE_BACK] += is_back;
    if (is_near && !(came >> (back - 1) & 1)) {
        counters[SEQUENCE_LOST]--;
        last[CAME] = (int64_t)(came | UINT64_C(1) << (back - 1));
        return true;
    }
    if (is_near && last[LEFT_OUT] != floor_mod(number - 1, turn)) {
        last[LEFT_OUT] = number;
        return true;
    }
    counters[SEQUENCE_LOST] += is_back || step < 2 ? 0 : step - 1;
    counters[SEQUENCE_REPEATED] += step == 0;
    if (is_back)
        came = UINT64_MAX; /* nothing is awaited of before */
    else if (step)
        came = step > 64 ? 0 : (came << 1 | 1) << (step - 1);
    last[NEWEST] = number;
    last[CAME] = (int64_t)came;
    last[LEFT_OUT] = -1;
    return false;
}

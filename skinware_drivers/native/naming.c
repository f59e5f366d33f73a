/* Whose is each frame, and of what kind: tests/specification/decoding.py. */
#include "inside.h"

static int64_t find_code(const int64_t *codes, int64_t n, int64_t code)
{
    int64_t low = 0, high = n;
    while (low < high) {
        int64_t middle = (low + high) / 2;
        if (codes[middle] < code)
            low = middle + 1;
        else
            high = middle;
    }
    return low < n && codes[low] == code ? low : -1;
}

static int64_t take_field(const struct field *field, int64_t identifier)
{
    return (identifier >> field->shift & field->mask) | field->constant;
}

static int64_t extended_slot(const struct plan *plan, int64_t bus, int64_t identifier)
{
    int64_t slot = plan->nobody;
    if (!(identifier & INT64_C(0x80000000)))
        return slot;
    for (const struct form *form = plan->forms; form < plan->forms + plan->n_forms; form++) {
        bool fits = form->bus == bus;
        for (int64_t i = 0; fits && i < form->n_conditions; i++)
            fits = (identifier & form->conditions[i].mask) == form->conditions[i].value;
        if (!fits)
            continue;
        int64_t patch = take_field(&form->patch, identifier);
        int64_t at = find_code(form->patch_codes, form->n_patch_codes, patch);
        if (at >= 0)
            slot = form->patch_slots[at];
        at = find_code(form->codes, form->n_codes, patch << 29 | take_field(&form->module, identifier));
        if (at >= 0)
            slot = form->slots[at];
    }
    return slot;
}

static bool is_right_length(const struct plan *plan, int64_t kind, int64_t length)
{
    return length < plan->length_columns && plan->length_ok[kind * plan->length_columns + length];
}

/* The last kind whose conditions hold. */
static uint8_t match_kind(const struct plan *plan, int64_t slot, const uint8_t *payload, int64_t length)
{
    const uint8_t *set = plan->sets + plan->candidates[slot] * plan->n_kinds;
    for (int64_t number = plan->n_kinds - 1; number >= 0; number--) {
        if (!set[number])
            continue;
        const struct kind *kind = &plan->kinds[number];
        bool fits = true;
        for (int64_t i = 0; fits && i < kind->n_conditions; i++) {
            const struct byte_condition *byte = &kind->conditions[i];
            fits = length > byte->offset && (payload[byte->offset] & byte->mask) == byte->value;
        }
        if (fits)
            return (uint8_t)number;
    }
    return NO_KIND;
}

static int64_t name_module(const struct plan *plan, const struct kind *kind, int64_t entry, const uint8_t *payload)
{
    int64_t patch = entry - plan->n_modules;
    if (patch < 0 || patch >= plan->n_patches)
        return entry;
    int64_t key = payload[kind->key_byte] >> kind->key_shift & kind->key_mask;
    int64_t found = kind->module_by_key[patch * kind->n_keys + key];
    return found >= 0 ? found : entry;
}

/* Whether a frame of ours that is of no kind, or of a wrong length, counts as wrong; if not, it is a stranger's. */
static bool is_wrong(struct path *path, int64_t row, int64_t *why)
{
    const struct plan *plan = path->plan;
    int64_t entry = path->entry[row], length = length_of(path->batch, row);
    const uint8_t *payload = payload_of(path->batch, row);
    if (entry >= plan->n_modules && !plan->payload_names[plan->candidates[path->slot[row]]])
        return false;
    uint8_t likely = match_kind(plan, path->slot[row], payload, length);
    if (likely != NO_KIND) {
        const struct kind *kind = &plan->kinds[likely];
        if (kind->names_module && length > kind->key_byte && name_module(plan, kind, entry, payload) >= plan->n_modules)
            return false;
    }
    *why = is_right_length(plan, likely, length) ? BAD_CONTENT : BAD_LENGTH;
    return true;
}

static bool is_sample_wanted(const struct plan *plan, int64_t bus, int64_t why, int64_t time_ns)
{
    return time_ns >= plan->sample_next_ns[bus * N_SAMPLE_KINDS + why];
}

static void keep_samples(struct path *path, int64_t why, const int64_t *rows, int64_t n, int64_t time_ns)
{
    for (int64_t i = 0; i < n; i++)
        if (is_sample_wanted(path->plan, path->batch->bus[rows[i]], why, time_ns)) {
            path->plan->hooks.keep(why, rows, n);
            return;
        }
}

/* Of rows that are of a patch of ours, but of no kind. */
static void count_wrong(struct path *path, const int64_t *rows, int64_t n, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    const struct batch *batch = path->batch;
    int64_t n_wrong = 0, n_odd = 0, *odd = path->found, why = 0;
    for (int64_t i = 0; i < n; i++) {
        int64_t row = rows[i];
        path->is_wrong[row] = is_wrong(path, row, &why);
        if (!path->is_wrong[row])
            continue;
        plan->bus_counters[batch->bus[row] * N_DECODER_COUNTERS + why]++;
        if (why == BAD_LENGTH)
            path->rows[n_wrong++] = row;
        else
            odd[n_odd++] = row;
    }
    keep_samples(path, SAMPLE_BAD_LENGTH, path->rows, n_wrong, time_ns);
    keep_samples(path, SAMPLE_BAD_CONTENT, odd, n_odd, time_ns);
}

/* Fill in entry, kind and is_wrong of all rows; the foreign ones are listed. */
void name_rows(struct path *path, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    const struct batch *batch = path->batch;
    int64_t ours = plan->n_modules + plan->n_patches;
    int64_t *outside = path->foreign, n_outside = 0, *unknown = path->order, n_unknown = 0;
    for (int64_t row = batch->start; row < batch->stop; row++) {
        int64_t identifier = identifier_of(batch, row), bus = batch->bus[row], length = length_of(batch, row);
        int64_t slot = identifier < STANDARD_IDENTIFIERS ? bus * STANDARD_IDENTIFIERS + identifier
                                                         : extended_slot(plan, bus, identifier);
        uint8_t kind = NO_KIND;
        path->slot[row] = slot;
        path->entry[row] = plan->entry[slot];
        path->is_wrong[row] = 0;
        if (path->entry[row] < ours) {
            const uint8_t *payload = payload_of(batch, row);
            if (plan->header) {
                if (length < plan->length_columns)
                    kind = plan->header[payload[plan->header_byte] * plan->length_columns + length];
            } else {
                kind = match_kind(plan, slot, payload, length);
                if (kind != NO_KIND && !is_right_length(plan, kind, length))
                    kind = NO_KIND;
            }
            if (kind == NO_KIND)
                unknown[n_unknown++] = row;
        }
        path->kind[row] = kind;
        if (path->entry[row] >= plan->n_modules)
            outside[n_outside++] = row;
    }
    if (n_unknown)
        count_wrong(path, unknown, n_unknown, time_ns);
    path->n_foreign = 0;
    for (int64_t i = 0; i < n_outside; i++) {
        int64_t row = outside[i];
        if (path->kind[row] != NO_KIND && plan->kinds[path->kind[row]].names_module)
            path->entry[row] = name_module(plan, &plan->kinds[path->kind[row]], path->entry[row], payload_of(batch, row));
        if (path->entry[row] >= plan->n_modules && !path->is_wrong[row])
            path->foreign[path->n_foreign++] = row;
    }
}

/* Rows that are of no module of ours, and that nobody waited for. */
void count_strangers(struct path *path, const int64_t *rows, int64_t n, int64_t time_ns)
{
    const struct plan *plan = path->plan;
    const struct batch *batch = path->batch;
    for (int64_t i = 0; i < n; i++) {
        uint32_t identifier = identifier_of(batch, rows[i]);
        plan->bus_counters[batch->bus[rows[i]] * N_DECODER_COUNTERS + UNKNOWN]++;
        if (identifier < STANDARD_IDENTIFIERS)
            plan->unknown_identifiers[batch->bus[rows[i]] * STANDARD_IDENTIFIERS + identifier]++;
    }
    keep_samples(path, SAMPLE_UNKNOWN, rows, n, time_ns);
}

/* A data path's life, and what Python calls. */
#include "flow.h"

#include <stdlib.h>

enum { FIRST_UPDATES = 64 };

/* The checksum of the headers that this was compiled with. */
SKINWARE_EXPORT uint32_t skinware_native_headers(void)
{
    return SKINWARE_HEADERS;
}

static void *room(struct path *path, int64_t n, size_t size)
{
    void *memory = calloc(n > 0 ? (size_t)n : 1, size);
    path->failed |= !memory;
    return memory;
}

static void make_chain(struct path *path, struct chain *chain, int64_t n_keys)
{
    chain->n_keys = n_keys;
    chain->last = room(path, n_keys, sizeof *chain->last);
    chain->turn = room(path, n_keys, sizeof *chain->turn);
}

static void make_rows(struct path *path, int64_t n)
{
    int64_t **words[] = {&path->entry, &path->slot,       &path->rows,            &path->foreign,      &path->next,
                         &path->order, &path->shared,     &path->group,           &path->time_ns,      &path->spacing_ns,
                         &path->starts, &path->found,     &path->expanded_update, &path->expanded_row, &path->expanded_kind,
                         &path->first_of_group};
    uint8_t **bytes[] = {&path->kind,        &path->is_wrong,    &path->is_severed, &path->place,      &path->is_member,
                         &path->is_soon,     &path->is_held_up,  &path->is_doubtful, &path->is_used,   &path->is_waiting,
                         &path->is_orphan,   &path->has_failed};
    for (size_t i = 0; i < sizeof words / sizeof *words; i++)
        *words[i] = room(path, n, sizeof **words);
    for (size_t i = 0; i < sizeof bytes / sizeof *bytes; i++)
        *bytes[i] = room(path, n, 1);
}

SKINWARE_EXPORT void skinware_path_free(struct path *path)
{
    void *all[] = {path->entry,           path->slot,          path->rows,          path->foreign,      path->next,
                   path->order,           path->shared,        path->group,         path->time_ns,      path->spacing_ns,
                   path->starts,          path->found,         path->expanded_update, path->expanded_row,
                   path->expanded_kind,   path->first_of_group, path->kind,         path->is_wrong,     path->is_severed,
                   path->place,           path->is_member,     path->is_soon,       path->is_held_up,   path->is_doubtful,
                   path->is_used,         path->is_waiting,    path->is_orphan,     path->has_failed,   path->groups.last,
                   path->groups.turn,     path->punctual.last, path->punctual.turn, path->updated_groups.last,
                   path->updated_groups.turn,
                   path->patches.last,    path->patches.turn,  path->before_ns,     path->before_spacing_ns,
                   path->carried_wire,    path->carried_time_ns, path->carried_bus, path->store,        path->spare,
                   path->list,            path->other,         path->before,        path->of_patch,     path->of_group,
                   path->of_patch_ns,     path->is_open,       path->was_open,      path->has_begun,
                   path->clocks,          path->clock_points,
                   path->is_early};
    for (size_t i = 0; i < sizeof all / sizeof *all; i++)
        free(all[i]);
    free(path);
}

static void lay_out_updates(struct path *path)
{
    const struct plan *plan = path->plan;
    int64_t sensors = (int64_t)sizeof(struct update), word = 8;
    path->values_at = (sensors + plan->width * (int64_t)sizeof(int32_t) + word - 1) / word * word;
    path->status_at = path->values_at + plan->width * plan->value_bytes;
    path->stride = (path->status_at + plan->width + word - 1) / word * word;
}

/* A data path over what Python owns; NULL: there is no memory. */
SKINWARE_EXPORT struct path *skinware_path_new(const struct plan *plan, struct batch *batch, struct words *words)
{
    struct path *path = calloc(1, sizeof *path);
    int64_t n_keys = 0;
    if (!path)
        return NULL;
    path->plan = plan;
    path->batch = batch;
    path->words = words;
    for (int64_t i = 0; i < plan->n_cycles; i++)
        if (plan->cycles[i].is_timed && plan->cycles[i].n * plan->n_modules > n_keys)
            n_keys = plan->cycles[i].n * plan->n_modules;
    make_rows(path, batch->capacity);
    make_chain(path, &path->groups, plan->n_modules + plan->n_patches + 1);
    make_chain(path, &path->punctual, n_keys);
    make_chain(path, &path->updated_groups, plan->n_groups);
    make_chain(path, &path->patches, plan->n_patches);
    path->before_ns = room(path, n_keys, sizeof *path->before_ns);
    path->before_spacing_ns = room(path, n_keys, sizeof *path->before_spacing_ns);
    path->carried_wire = room(path, batch->headroom, (size_t)batch->row_bytes);
    path->carried_time_ns = room(path, batch->headroom, sizeof *path->carried_time_ns);
    path->carried_bus = room(path, batch->headroom, sizeof *path->carried_bus);
    path->of_group = room(path, plan->n_groups, sizeof *path->of_group);
    path->of_patch_ns = room(path, plan->n_patches, sizeof *path->of_patch_ns);
    path->is_open = room(path, plan->n_patches, 1);
    path->was_open = room(path, plan->n_patches, 1);
    path->has_begun = room(path, plan->n_patches, 1);
    path->is_early = room(path, plan->n_groups, 1);
    path->clocks = room(path, plan->n_patches, sizeof *path->clocks);
    path->clock_points = room(path, CLOCK_PARTS * plan->n_patches, sizeof *path->clock_points);
    lay_out_updates(path);
    words->entry = (int64_t)(intptr_t)path->entry;
    words->kind = (int64_t)(intptr_t)path->kind;
    words->wanted_ns = INT64_MAX;
    if (path->failed || !make_room(path, FIRST_UPDATES)) {
        skinware_path_free(path);
        return NULL;
    }
    return path;
}

/* Decode a batch, and publish what is due; -1: there is no memory for its updates. */
SKINWARE_EXPORT int64_t skinware_path_digest(struct path *path)
{
    decode_batch(path);
    if (path->failed)
        return -1;
    take_updates(path);
    return 0;
}

SKINWARE_EXPORT void skinware_path_publish_if_due(struct path *path)
{
    publish_if_due(path);
}

SKINWARE_EXPORT int64_t skinware_path_deadline_ns(const struct path *path)
{
    return deadline_ns(path);
}

/* Rows that nobody waited for, of those that were offered. */
SKINWARE_EXPORT void skinware_path_count_strangers(struct path *path, const int64_t *rows, int64_t n)
{
    count_strangers(path, rows, n, path_time_ns(path));
}

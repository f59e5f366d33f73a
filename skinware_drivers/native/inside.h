/* What the parts of the data path share among each other. */
#ifndef SKINWARE_DRIVERS_INSIDE_H
#define SKINWARE_DRIVERS_INSIDE_H

#include "../../skinware/native/ring.h" /* before any system header */

#include "path.h"

struct words { /* what Python sees and sets between calls */
    int64_t fixed_ns; /* not 0: the time is this, whatever the clock says */
    int64_t carried;  /* rows before the batch's headroom ends that wait for partners */
    int64_t n_held;   /* updates that are held back from one take to the next */
    int64_t newest_ns, due_ns, not_before_ns, last_published_ns;
    int64_t on_request, wanted_ns; /* publish only what is asked for; the oldest data that somebody waits for */
    int64_t warns;                 /* frames came too soon, or a clock stands still: plan.haste, plan.clock_stops */
    int64_t store;                 /* address of the updates */
    int64_t sequence;              /* of the newest frame */
    int64_t must_leave;            /* the event loop has something to do */
    int64_t expects_data;          /* somebody waits for a frame that may be data */
    int64_t entry, kind;           /* addresses of what is known of the rows */
    int64_t ring;                  /* address of the ring's end: another one if somebody removed its file */
    int64_t read_ns;               /* all that arrived until then was taken */
    int64_t sees_all;              /* the watch wants to look at all updates */
};

struct update { /* followed by int32_t sensors[width], values[width], uint8_t status[width] */
    int64_t module, row, whole, is_flagged, oldest_ns, newest_ns;
    int64_t group;  /* the first of its update groups stands for it */
    int64_t groups; /* address of all of them, plan.most_groups */
};

struct clock_point { /* a frame: the number of its part of time, and since the clock's origin, its stamp and delay */
    int64_t part;
    double device_ns, delay_ns;
};

struct device_clock { /* stamp: the last one, -1: the next one begins; drift, offset_ns: of the line of delays */
    double unit_ns, drift, offset_ns;
    int64_t modulo, part_ns, jump_ns; /* a part has one point; a stamp so far in the future: the clock was set */
    struct clock_point *points;       /* (CLOCK_PARTS,) the frame of least delay of each part, oldest first */
    int64_t n_points, origin_ns, ticks, stamp, received_ns, last_ns, restarts, stops, is_still;
};

struct chain { /* the last element of every key so far, forgotten all at once */
    int64_t n_keys, *last;
    uint32_t *turn, now;
};

struct path {
    const struct plan *plan;
    struct batch *batch;
    struct words *words;
    int64_t failed; /* memory ran out */

    /* (capacity,) of the batch: what is known of each row */
    int64_t *entry;
    uint8_t *kind, *is_wrong, *is_severed;
    int64_t *slot, *rows, *foreign;
    int64_t n_foreign;

    /* a cycle's frames, group by group */
    int64_t *next, *order, *shared, *group, *time_ns, *spacing_ns, *starts, *found;
    uint8_t *place, *is_member, *is_soon, *is_held_up, *is_doubtful, *is_used, *is_waiting, *is_orphan;
    struct chain groups, punctual;
    int64_t *first_of_group, *before_ns, *before_spacing_ns;
    uint8_t *carried_wire;
    int64_t *carried_time_ns;
    uint16_t *carried_bus;
    int64_t n_carried;

    /* updates: the first n_held were held back */
    uint8_t *store, *spare;
    int64_t stride, values_at, status_at, n_updates, most_updates;
    int64_t *list, *other, *before, *of_patch; /* (most_updates,) */
    int64_t *expanded_update, *expanded_row, *expanded_kind, n_expanded; /* frames that are read by Python */
    uint8_t *has_failed;
    int64_t *of_group, *of_patch_ns; /* (n_groups,), (n_patches,) */
    struct chain updated_groups, patches;
    struct device_clock *clocks; /* (n_patches,) */
    struct clock_point *clock_points;
    uint8_t *is_open, *was_open, *has_begun; /* (n_patches,) */
    int64_t n_split;              /* frames in turn that held a long pause */
    uint8_t *is_early;            /* (n_groups,) what came before it */
    int64_t left;                 /* publications of this take */
    int64_t living_ns;            /* as of when groups live, in this take */
};

static inline struct update *update_at(const struct path *path, int64_t number)
{
    return (struct update *)(path->store + number * path->stride);
}
static inline int32_t *sensors_of(const struct path *path, int64_t number)
{
    return (int32_t *)(path->store + number * path->stride + (int64_t)sizeof(struct update));
}
static inline uint8_t *values_of(const struct path *path, int64_t number)
{
    return path->store + number * path->stride + path->values_at;
}
static inline uint8_t *status_of(const struct path *path, int64_t number)
{
    return path->store + number * path->stride + path->status_at;
}

static inline const uint8_t *payload_of(const struct batch *batch, int64_t row)
{
    return batch->wire + row * batch->row_bytes + 8;
}
static inline uint32_t identifier_of(const struct batch *batch, int64_t row)
{
    uint32_t identifier;
    memcpy(&identifier, batch->wire + row * batch->row_bytes, sizeof identifier);
    return identifier;
}
static inline int64_t length_of(const struct batch *batch, int64_t row)
{
    uint32_t length;
    if (batch->payload_size <= 64)
        return batch->wire[row * batch->row_bytes + 4];
    memcpy(&length, batch->wire + row * batch->row_bytes + 4, sizeof length);
    return length;
}

static inline void begin_chains(struct chain *chain)
{
    if (++chain->now)
        return;
    memset(chain->turn, 0, (size_t)chain->n_keys * sizeof *chain->turn);
    chain->now = 1;
}

/* `last`, or -1: the element that had the key before, which is this one from now on */
static inline int64_t chain_on(struct chain *chain, int64_t key, int64_t element)
{
    int64_t before = chain->turn[key] == chain->now ? chain->last[key] : -1;
    chain->turn[key] = chain->now;
    chain->last[key] = element;
    return before;
}

/* Whether a group can be expected to send in every period. */
static inline bool lives(const struct path *path, int64_t group)
{
    return path->plan->is_prompt[group] && path->living_ns - path->plan->group_heard_ns[group] < path->plan->silence_ns;
}

static inline int64_t floor_mod(int64_t value, int64_t by)
{
    int64_t rest = value % by;
    return rest < 0 ? rest + by : rest;
}

int64_t path_time_ns(const struct path *path);
bool make_room(struct path *path, int64_t most);
uint64_t read_word(const uint8_t *at, int64_t type, int64_t is_swapped);
int64_t read_number(const uint8_t *payload, const struct number *number);

void name_rows(struct path *path, int64_t time_ns);
void tell_times(struct path *path);
void count_strangers(struct path *path, const int64_t *rows, int64_t n, int64_t time_ns);
void find_cycles(struct path *path, const struct cycle *cycle, int64_t number);
int64_t new_update(struct path *path);
void join_groups(const struct path *path, struct update *update, const struct assembly *assembly);
void read_update(struct path *path, const struct assembly *assembly, int64_t number, const int64_t *rows);
void finish_updates(struct path *path, int64_t first);
void add_module_flags(struct path *path, int64_t first);
bool is_overtaken(struct path *path, const struct number *sequence, int64_t row);
void decode_batch(struct path *path);
void take_updates(struct path *path);
void publish_if_due(struct path *path);
void publish(struct path *path);
void show(struct path *path, const int64_t *updates, int64_t n);
void skip(struct path *path, int64_t patch, int64_t n);
bool find_open(struct path *path, int64_t time_ns);
void find_begun(struct path *path);
void cut_into_bursts(struct path *path, int64_t most);
int64_t deadline_ns(const struct path *path);

#endif

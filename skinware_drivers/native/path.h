/* A driver's data path: from the rows of a batch to a published slot.
 *
 * The numpy path (tests/specification) is its specification: same state, same results, bit by bit. Both work on the same
 * arrays, which Python owns; `struct plan` says where they are. What only Python can do (a driver's own functions,
 * whoever waits for a frame) is called from inside, through `struct hooks`.
 *
 * All fields are 8 bytes wide, so that Python can describe them without padding (structs.py has the same fields in the
 * same order). Modules, patches, buses, sensors and kinds of frame are numbers; times are CLOCK_MONOTONIC ns.
 */
#ifndef SKINWARE_DRIVERS_PATH_H
#define SKINWARE_DRIVERS_PATH_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum { NO_KIND = 255, STANDARD_IDENTIFIERS = 1 << 11, MOST_MEMBERS = 128, CLOCK_PARTS = 60 };
#define NEVER_NS (-(INT64_C(1) << 62)) /* punctuality: none came yet */

/* -- what a layout compiles to ------------------------------------------------------------------------------------- */

enum type { U1, I1, U2, I2, U4, I4, U8, I8, F4, F8, PACKED };

struct byte_condition {
    int64_t offset, mask, value;
};

struct identifier_condition {
    int64_t mask, value;
};

struct field { /* bits of an identifier */
    int64_t shift, mask, constant;
};

struct form { /* 29-bit identifiers of one bus that are built alike; codes ascend, each has the slot beside it */
    int64_t bus, n_conditions;
    const struct identifier_condition *conditions;
    struct field patch, module;
    int64_t n_patch_codes, n_codes;
    const int64_t *patch_codes, *patch_slots, *codes, *slots;
};

struct number { /* a number in a payload that a device counts up */
    int64_t is_there, offset, type, is_swapped, mask, shift, turn;
};

struct run { /* values that lie side by side in a payload; bits, is_little, is_signed, skip: of packed ones */
    int64_t offset, count, type, is_swapped, column, bits, is_little, is_signed, skip;
};

enum flag_form { SENTINEL, ABOVE, STATUS_BYTES, WORD };

struct channel_bit {
    int64_t channel, shift;
};

struct module_bit { /* module: -1 = the patch has none of this key */
    int64_t module, shift;
};

struct flag { /* mask: of a word, or of the status bytes; normal: the word when nothing is to be told */
    int64_t form, status, offset, type, is_swapped, mask, normal, n_each;
    const struct channel_bit *each;
    int64_t n_modules;
    const struct module_bit *modules; /* (patches, n_modules) */
    int64_t is_float, integer; /* of a sentinel or a limit: how values are compared, and with what */
    double real;
};

struct kind { /* a kind of frame */
    int64_t n_conditions;
    const struct byte_condition *conditions;
    int64_t width, column, assembly, cycle, place; /* cycle: -1 = it is an update by itself */
    int64_t is_expanded, n_runs;
    const struct run *runs;
    int64_t n_flags;
    const struct flag *flags;
    int64_t names_module, key_byte, key_shift, key_mask, n_keys;
    const int64_t *module_by_key; /* (patches, n_keys) */
    struct number sequence, stamp; /* stamp: of the device's clock */
    double stamp_unit_ns;
};

struct assembly { /* what makes one update of a module */
    int64_t n_members;
    const int64_t *members;     /* kinds, in order */
    const int64_t *channels;    /* (width,) */
    const int32_t *destination; /* (modules, width) sensor of each value */
    const int64_t *groups;      /* (modules, most_groups) update groups, n_groups: none */
};

enum order { GIVEN, ANY, ENDS_WITH };

struct cycle {
    int64_t n, order, maximum_age_ns, assembly, has_counter;
    const struct number *counters; /* (n,) */
    const uint16_t *group_of_entry;
    int64_t compared_member; /* whose sequence numbers are compared, -1: none */
    struct number compared;
    int64_t is_timed, all_as_they_should, period_ns, reach_ns, margin_ns, soon_ns;
    int64_t *last_ns, *spacing_ns; /* (modules * n,) */
};

/* -- what moves frames --------------------------------------------------------------------------------------------- */

struct batch {
    uint8_t *wire;
    int64_t *time_ns;
    uint16_t *bus;
    int64_t row_bytes, payload_size, headroom, capacity, start, stop, limit;
};

/* -- what only Python can do --------------------------------------------------------------------------------------- */

struct hooks {             /* NULL: there is nothing to do */
    void (*hear)(void);       /* frames of the batch have come, and somebody may wait for one that is data */
    void (*offer)(const int64_t *rows, int64_t n); /* rows that are of no module of ours */
    void (*keep)(int64_t why, const int64_t *rows, int64_t n); /* rows that cannot be used, for the samples */
    void (*expand)(int64_t kind, const int64_t *updates, const int64_t *rows, uint8_t *has_failed, int64_t n);
    void (*look)(const int64_t *updates, int64_t n); /* updates were shown; see words.sees_all */
    void (*published)(int64_t oldest_ns);
    int64_t (*sort_out)(int64_t bus, int64_t first, int64_t n); /* unusual rows are among these; how many are left */
    void (*lose)(int64_t bus, int64_t error);
    void (*heard)(void); /* frames came on a bus that Python wanted to know of */
    void (*damaged)(int64_t bus, const uint8_t *bytes, int64_t n); /* bytes of a line without a frame, for the samples */
};

/* -- the whole ----------------------------------------------------------------------------------------------------- */

enum { UNKNOWN, BAD_LENGTH, BAD_CONTENT, BEFORE_BOOT, N_DECODER_COUNTERS };               /* of a bus */
enum { UPDATES, ORPHANS, LATE, SEQUENCE_LOST, SEQUENCE_REPEATED, SEQUENCE_BACK, N_PATCH_COUNTERS }; /* of a patch */
enum { NEWEST, CAME, LEFT_OUT, N_OF_SEQUENCE }; /* sequence numbers of a module; came: a bit for each of the 64 before */
enum { SAMPLE_UNKNOWN = 1, SAMPLE_BAD_LENGTH = 2, SAMPLE_BAD_CONTENT = 3, SAMPLE_REFUSED, N_SAMPLE_KINDS };

struct columns { /* of a slot: where they begin, bytes from its start */
    int64_t values, status, module_time_ns, group_time_ns, module_untouched, patch_state, bus_state, bus_reason, bus_since_ns;
    int64_t bus_load, bus_samples;
    int64_t bus_counters, patch_counters, patch_interval_counts, patch_age_counts, latency_ns, data_path, bus_data_path;
};

struct plan {
    int64_t n_buses, n_patches, n_modules, n_groups, n_sensors, value_type, value_bytes, width;

    /* naming */
    int64_t nobody, n_kinds, n_forms, length_columns, header_byte;
    const int64_t *entry;       /* of each slot */
    const uint16_t *candidates; /* of each slot, row of sets */
    const uint8_t *sets;        /* (sets, n_kinds) bool */
    const uint8_t *payload_names; /* of each set, bool */
    const struct form *forms;
    const uint8_t *length_ok; /* (256, length_columns) bool */
    const uint8_t *header;    /* (256, length_columns) kind; NULL: conditions have to be looked at */
    const struct kind *kinds;

    /* updates */
    int64_t n_cycles, most_groups, groups_are_modules;
    const struct assembly *assemblies;
    const struct cycle *cycles;
    const int64_t *module_patch;  /* (n_modules,) */
    const int64_t *group_module, *group_patch; /* (n_groups,) */
    const int64_t *sensor_group;  /* (n_sensors,) */
    const int64_t *first_group;   /* (n_patches,) */
    const uint8_t *is_prompt;     /* (n_groups,) bool: in every period, so that frames wait for it */
    const int64_t *age_limit_ns;  /* (n_groups,) */
    int64_t *last_sequence;       /* (n_modules, N_OF_SEQUENCE) */
    uint8_t *module_flags;        /* (n_modules,) status that frames of others set; NULL: no frame does */
    int64_t *haste;               /* (n_patches,) */
    uint8_t *knows_clock;         /* (n_patches,) bool: something is known of the device's clock */
    int64_t *clock_stops;         /* (n_patches,) how often it was found to stand still */
    int64_t *unknown_identifiers; /* (n_buses, 2048) */
    int64_t *sample_next_ns;      /* (n_buses, N_SAMPLE_KINDS): when a sample is wanted again */
    uint8_t *interrupted;         /* (n_buses,) bool: frames were lost since the last batch */

    /* what is shown */
    uint8_t *values; /* (n_sensors + 1,) */
    uint8_t *status; /* (n_sensors + 1,) */
    int64_t *group_time_ns, *patch_time_ns; /* one more than there are */
    uint8_t *updated, *touched;             /* (n_groups + 1,) bool */
    int64_t *bus_counters, *patch_counters;

    /* bursts and publication */
    int64_t period_ns, patience_ns, pause_ns, silence_ns, by_cycle, most_at_once, idle_ns, n_counts, n_own_counts;
    int64_t stale, state_live, state_stale; /* bit of a status; states of a patch */
    int64_t *burst_pause_ns;           /* (n_patches,) */
    const double *standing_out_ns;     /* (n_patches,) */
    int64_t *gap_ns;                   /* (n_groups,) */
    int64_t *group_heard_ns;           /* (n_groups,) */
    int64_t *patch_heard_ns, *patch_lives_until_ns; /* (n_patches,) */
    uint8_t *patch_state;
    const uint8_t *module_status, *module_untouched; /* (n_modules,) of the watch */
    const uint8_t *bus_state, *bus_reason, *bus_samples;
    const int64_t *bus_since_ns;
    const uint16_t *bus_load;
    int64_t bus_samples_bytes;
    const int64_t *latency_ns;
    const uint8_t *data_path, *bus_data_path;
    int64_t *counts;  /* (n_buses, n_counts) */
    int64_t *skipped;              /* (n_buses,) updates that were never published, since Python looked */
    const int64_t *skipped_before; /* (n_buses,) and before that */
    const int64_t *patch_bus;
    int64_t skipped_column, dropped_column, frames_column, errors_column, refused_column;
    int64_t bytes_column; /* of a line: bytes_in, and the five behind it */
    int64_t *timing;  /* (2, n_patches, SKINWARE__BUCKETS) */
    int64_t *timing_before_ns;
    struct columns columns;

    struct hooks hooks;
    int64_t n_awaited; /* frames of no module that somebody waits for */
    const struct identifier_condition *awaited;
};

#endif

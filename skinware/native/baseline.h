/*
 * The rule of baselines: its numbers, and all that is known of taxels, patches and modules. docs/tactile/baselines.md has
 * the formulas. Python makes its structs from this header (structs.py), so every field has 8 bytes.
 */

#ifndef SKINWARE_NATIVE_BASELINE_H
#define SKINWARE_NATIVE_BASELINE_H

#include <math.h>
#include <stdint.h>

/* Marks the functions that a library exports: all others are hidden. */
#define SKINWARE_EXPORT __attribute__((visibility("default")))

/* The rounds of a loop over taxels may run side by side: its arrays do not overlap. */
#ifdef __clang__
#define INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#else
#define INDEPENDENT _Pragma("GCC ivdep")
#endif

/* Levels of evidence */

#define DRIFT_SIGMA 3.0f      /* standard deviations: an innovation counts for at most this; a load within it may be drift */
#define STEPS_OF_A_TOUCH 2.0  /* steps of the raw values that a touch rises by at least: rounding alone moves one */
#define OFF_TO_ON 0.6f        /* share of minimum_on: the least threshold at which a touch ends, so that none flickers */
#define EPSILON 1e-6f         /* share of the level: the least noise of values without steps, ten times float32's */
#define TINY 1e-12f           /* in the unit of the type: keeps a noise above 0 where the level itself is 0 */
#define FEW_LEVELS 2.0        /* steps from 0 to the largest value: with no more, each step is a touch, none is drift */

/* The first measurement */

#define BLOCKS 10             /* parts of calibrate_s: the median over ten survives a touch of a third of the time */
#define BLOCK_FRAMES 4        /* values of a taxel in a part at least, as a variance of fewer says nothing */
#define ENOUGH_BLOCKS 6       /* parts in which a taxel must have data */
#define RESTLESS 100.0f       /* times the noise of the quietest part, squared: with more in half of them, the taxel moves */
#define MOVED_SHARE 0.05      /* share of the taxels that may move; where more do, those that move have to wait */

/* Drift, as it is learned */

#define GAIN_SPREAD2 0.09f    /* variance of the gains of taxels to the common mode before anything is known */
#define GAIN_LASTS_S 604800.0 /* seconds, a week, in which a known gain becomes as uncertain as that: skins age */
#define LEAST_GAIN 0.1f       /* with less, something else moves the taxel */
#define MOST_GAIN 3.0f        /* with more, too */
#define QUIET 0.15f           /* share of the typical variance of noise of a patch: with less, a taxel is dead */
#define FEW_TAXELS 3.0        /* taxels, free ones, of a patch of which nothing is common */
#define MANY_TAXELS 20.0      /* free taxels of a patch that no touch covers evenly but for a hand that slams on all of it */
#define NEARLY_ALL 0.85       /* share of them that has to move alike where the mode jumps */
#define GAP_S 2.0             /* seconds without data in which a device may have restarted: a jump after them may be a rise */
#define MATCH_S 2.0           /* seconds in which the agility of the common mode changes e-fold until it explains moves */
#define RATE_S 30.0           /* seconds over which the speed of the common drift is averaged */
#define SLOW_S 5.0            /* seconds: deviations that last longer are drift of the taxel, quicker ones are noise */
#define NOISE_S 60.0f         /* seconds: time constant of the noise, which changes with temperature and motors */
#define FEWEST 0.1f           /* weight of one frame in the noise, at most */
#define FIRST_DRIFT 1e-4      /* times the variance of noise, a second: drift of its own, before a patch showed it */
#define LEAST_DRIFT 1e-6      /* the same, at least: from less, it takes minutes until a new drift is believed */
#define MOST_DRIFT 1e-1       /* the same, at most: with more, noise is followed */
#define HEATS 0.003f          /* share of the largest present load in the patch: its heat and sweat raise other taxels by so much a second */
#define HEATS_ON 0.25f        /* share of that load: with a higher threshold, a rise below it may be a touch */
#define WANDER_S 10.0         /* seconds over which errors of offsets at rest, and speeds of own drift, are averaged */
#define TICK_S 1.0            /* seconds between adjustments of what changes slowly */

/* Contacts */

#define FALLEN 0.5f           /* share of the peak of a load: below it the load has fallen, the rest may be drift */
#define PEAK_S 2.0            /* seconds: time constant of the peak, which a bump of a moment must not move */
#define USED_S 40.0           /* seconds in which the material gets used to a load, and forgets it */
#define RESETTLE_S 3.0        /* seconds in which a taxel finds back after a load, instead of tau_s */
#define FADED 0.75f           /* share: what is left after a sudden fall, and fades below this, was a remainder */
#define MOST_REMAINDER 0.35f  /* share of a load: no cover keeps more of it */
#define LEFT_AT_S 3.0f        /* seconds after a sudden fall at which it is noted how much is left */
#define SETTLED_S 1.0f        /* seconds after the end of a touch at which the rest of it is known */
#define STEP_OVER_ON 3.0f     /* thresholds: a module whose taxels all rise alike by less moved its own baseline */
#define ALIKE 0.3f            /* share of the median: taxels that are nearer to it moved alike */
#define MOST_ALIKE 0.5        /* share of the taxels of a module that have to */
#define AT_ONCE 0.25          /* share of a rise that may come after its first frame: what rises farther is pressed */
#define SAG_RETURNS_S 0.6f    /* seconds from the end of a contact until the cover around it is back */
#define SAG_RETURNS_BY 1.5f   /* times the sag: a value that rises farther (and a threshold) is a touch */
#define SAG_SHARE 0.3f        /* share of the largest load in the patch: a pressed cover sinks around by no more */
#define LOOK_AT_S 0.3f        /* seconds after the beginning of a touch at which it is looked at again */
#define QUICK_S 0.12          /* seconds: with frames more apart one high value is a touch; with more frames it takes two */
#define DIP_S 60.0f           /* seconds in which a taxel that fell and returns shows that touches may lower it */

struct run { /* neighbouring taxels of one patch */
    int64_t first, last, patch;
};

struct patch {
    double taxels;    /* their number */
    double variance;  /* of the common mode */
    double agility;   /* variance that the mode gains in a second */
    double rate;      /* average speed, a second */
    double rate2;     /* its mean square */
    double unknown_s; /* how long too few taxels have been free to say how it moves */
    double known_s;
    double own_rate2; /* mean square of the speeds at which its taxels drift by themselves */
    double noise2;    /* of a typical taxel */
    double drift;     /* variance that the offset of a taxel gains in a second by a drift of its own */
    double wander;    /* square of how far a typical taxel at rest is from its offset, over some seconds */
    double largest;   /* load of a touch, now or a moment ago */
    double present;   /* the largest load now */
    double since_s;   /* the last touch */
    double share;     /* of a load that its cover keeps */
    double moves2;    /* by how much the mode moves from frame to frame, squared, as measured at rest */
    double common;    /* the mode while the rest is measured */
    double fall, fell_s; /* by how much the mode jumped down of late, and how long ago */
    double jump, before; /* of a patch that may jump: medians of its free taxels, deviation and smoothed deviation */
    double move, sure; /* by how much the mode moves with this frame, and how much of that is sure */
    double sums[4];   /* of this frame */
};

struct module {
    double old_s;   /* how long ago it was touched by a touch that is not new */
    double begun_s; /* how long ago the newest touch began on it */
    double touched; /* number of its taxels */
    double near;    /* 1: something touches it */
    double looked;  /* a touch on it is looked at: touches.c has when */
    double median, onset, slow, on, off, number, alike; /* of a module that is looked at */
    double living, speed2; /* number of its taxels with values, sum of the squares of their speeds */
    double rate2;          /* mean square of the speeds at which its taxels drift by themselves */
};

struct baseline {
    int64_t n, n_patches, n_modules, n_runs;
    int64_t is_signed, is_held;
    int64_t has_no_common; /* what taxels had in common was taken off before */
    double resolution, least, most;
    double forget_after_s; /* without data: then a baseline is measured again */

    /* settings; minimum_on: NaN where none is given */
    double tau_s, settle_s, smooth_s, on_sigma, off_sigma, minimum_on, recover_s, maximum_hold_s, calibrate_s;

    struct baseline *normal; /* of the axis along the normal of the same taxels, if this is an axis within the skin */
    struct run *runs;
    struct patch *patches;
    struct module *modules;
    int64_t *patch, *module;

    int64_t time_ns, has_time, few_levels, is_near, all_ready;
    int64_t doubts; /* 1: a touch seems to lower some of them in the newest frame */
    double tick_s, refused_share;
    int64_t block_ns, block_frames, n_blocks; /* the tenth that is being measured, and how many are over */

    float *level, *gain, *variance, *cross, *gain_variance, *noise2; /* offset, its gain, and how uncertain both are */
    float *noise_s;                             /* for how long the noise has been measured */
    float *slow;                                /* deviation at rest, over some seconds */
    float *own_rate2;                           /* rate2 of its module */
    float *speed, *unseen_s, *strayed2;         /* of its own drift; since it was measured, and how far it led, squared */
    float *gain_before;                         /* gain at the last tick */
    float *last, *away_s;                       /* newest value, and time since */
    float *smooth, *peak, *contact_s;           /* deviation, smoothed; highest load and age of a touch */
    float *settling_s;                          /* time for which it is still held */
    float *onset;                               /* deviation in the first frame above the threshold of the end */
    float *below_s, *down_s, *lowered, *sunk, *dip, *dip_s;
    float *used, *left, *steady, *used_then, *since_fall_s, *noted, *since_end_s;
    float *first; /* value in the first frame of the measurement */

    /* of this frame: deviation, thresholds, room for what is sorted */
    float *deviation, *on, *off, *scratch;
    uint8_t *live, *at_end, *low, *flag;
    uint8_t *bears; /* the vector of which this is an axis bears a load */

    uint8_t *ready, *seen, *touched, *high, *felt, *below, *sagging, *returned, *held, *forced;

    float *blocks; /* (BLOCKS, 6, n): frames, deviations d from the first value, modes c, d * d, d * c and c * c */
    int64_t *list; /* taxels that are touched */
    int64_t n_touched;
};

/* The shares of time constants that pass with a frame. */
static inline double passed_share(double passed_s, double constant_s) {
    return -expm1(-passed_s / constant_s);
}
static inline float highest(float a, float b) {
    return a > b ? a : b;
}
static inline float lowest(float a, float b) {
    return a < b ? a : b;
}
static inline float within(float value, float limit) {
    return lowest(highest(value, -limit), limit);
}
static inline float load_of(const struct baseline *b, float deviation) {
    return b->is_signed ? fabsf(deviation) : deviation;
}

/* baseline.c */
SKINWARE_EXPORT void skinware_baseline_update(struct baseline *b, int64_t time_ns, const float *values,
                                              const uint8_t *usable, const uint8_t *jumped, const uint8_t *bears,
                                              float *to);
double least_on(const struct baseline *b);
float least_noise2(const struct baseline *b, float level);
void put(struct baseline *b, int64_t taxel, float by);

/* offsets.c */
void follow_jumps(struct baseline *b, double passed_s);
void follow_common(struct baseline *b, double passed_s);
void learn(struct baseline *b, float rustle_share, double passed_s);

/* rest.c */
void measure(struct baseline *b, int64_t time_ns, double passed_s);
int measure_now(const struct baseline *b, int64_t taxel, float *level, float *noise2);
void medians(struct baseline *b, const int64_t *group, int64_t n_groups, const float *values, const uint8_t *counts,
             double *first_of_result, int64_t stride);

/* touches.c */
void follow_touches(struct baseline *b, double passed_s);
void forget_touch(struct baseline *b, int64_t taxel);
void end_touch(struct baseline *b, int64_t taxel);
void follow_remainders(struct baseline *b, double passed_s);
int64_t is_looked_at(const struct baseline *b, int64_t taxel, double passed_s);

/* surroundings.c */
void hold_near(struct baseline *b, double passed_s);
void follow_falls(struct baseline *b, float rustle_share, double passed_s);
void return_from_falls(struct baseline *b, double passed_s);

#endif

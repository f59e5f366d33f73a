/* Follow the baselines of the taxels of one sensor type: one call a frame. */

#include "baseline.h"

#include <float.h>
#include <string.h>

enum { REST, HELD, RELEARNING, COVERED, DOUBTED, SATURATED, NO_RESOLUTION }; /* skinware/status.py: Why */

enum { NO_VALUE = -1, NO_NOISE = -2 }; /* of a tare */

SKINWARE_EXPORT void skinware_baseline_begin(struct baseline *b);
SKINWARE_EXPORT int64_t skinware_baseline_tare(struct baseline *b, int64_t patch);
SKINWARE_EXPORT void skinware_baseline_lose_common(struct baseline *b);

/* Begins with memory that is 0. */
void skinware_baseline_begin(struct baseline *b) {
    int64_t i;
    b->few_levels = b->resolution > 0;
    for (i = 0; i < b->n; i++) {
        b->level[i] = b->noise2[i] = b->last[i] = b->noted[i] = b->first[i] = NAN;
        b->gain[i] = b->gain_before[i] = 1;
        b->patches[b->patch[i]].taxels += 1;
        b->gain_variance[i] = GAIN_SPREAD2;
        b->noise_s[i] = NOISE_S;
        b->since_fall_s[i] = b->since_end_s[i] = INFINITY;
    }
    for (i = 0; i < b->n_patches; i++)
        b->patches[i].since_s = INFINITY;
    for (i = 0; i < b->n_modules; i++)
        b->modules[i].old_s = b->modules[i].begun_s = INFINITY;
}

double least_on(const struct baseline *b) {
    return isnan(b->minimum_on) ? b->resolution * (b->few_levels ? 0.5 : STEPS_OF_A_TOUCH) : b->minimum_on;
}

float least_noise2(const struct baseline *b, float level) {
    const double rounding = b->resolution * (b->few_levels ? 0.05 : 0.28867513459481287 /* 1 / sqrt(12) */);
    const float least = EPSILON * fabsf(level) + TINY;
    return rounding > 0 ? (float)(rounding * rounding) : least > 0 ? least * least : 0;
}

static void put_at(struct baseline *b, int64_t taxel, float level) {
    b->level[taxel] = level;
    b->variance[taxel] = b->noise2[taxel];
    b->cross[taxel] = b->slow[taxel] = 0;
    b->forced[taxel] = 1;
}

/* Moves an offset at once; it is as certain as one value is. */
void put(struct baseline *b, int64_t taxel, float by) {
    put_at(b, taxel, b->level[taxel] + by);
    b->deviation[taxel] -= by;
    b->smooth[taxel] -= by;
    b->onset[taxel] -= by;
}

/* Takes a frame in. A taxel that sends again after too long is measured again. */
static void take_in(struct baseline *b, const float *values, const uint8_t *usable, const uint8_t *jumped,
                    double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    const float most = (float)(FEW_LEVELS * b->resolution), passed = (float)passed_s, long_s = (float)b->forget_after_s;
    uint8_t above = 0, fresh = 0, rare = 0;
    int64_t i;
    INDEPENDENT
    for (i = 0; i < a.n; i++) { /* at_end: which values are usable, until compare() */
        a.at_end[i] = fabsf(values[i]) <= FLT_MAX;
        a.away_s[i] += passed;
    }
    for (i = 0; usable && i < a.n; i++)
        a.at_end[i] &= usable[i] != 0;
    INDEPENDENT
    for (i = 0; i < a.n; i++)
        rare |= a.at_end[i] & (a.away_s[i] > long_s);
    for (i = 0; rare && i < a.n; i++) {
        if (!a.at_end[i] || !(a.away_s[i] > long_s))
            continue;
        a.ready[i] = 0;
        a.level[i] = NAN;
        forget_touch(b, i);
    }
    for (i = 0; jumped && i < a.n; i++) {
        if (!a.at_end[i] || !jumped[i] || !a.ready[i])
            continue;
        a.level[i] += values[i] - a.last[i];
        a.forced[i] = 1;
    }
    INDEPENDENT
    for (i = 0; i < a.n; i++) {
        const int is_usable = a.at_end[i];
        a.away_s[i] = is_usable ? 0.0f : a.away_s[i];
        a.last[i] = is_usable ? values[i] : a.last[i];
    }
    INDEPENDENT
    for (i = 0; i < a.n; i++) {
        a.seen[i] |= a.at_end[i];
        a.live[i] = a.at_end[i] & a.ready[i];
        a.flag[i] = a.at_end[i] & (a.ready[i] ^ 1);
        fresh |= a.ready[i] ^ 1;
    }
    for (i = 0; b->few_levels && !above && i < a.n; i++)
        above |= a.at_end[i] & (fabsf(values[i]) > most);
    b->few_levels &= !above;
    b->all_ready = !fresh;
}

/* How far values are from their offsets, and from when on that is a touch. A value at an end of its range shows nothing, but
 * at the lower end that an offset is not above it. */
static void compare(struct baseline *b) {
    const struct baseline a = *b; /* no store can change it */
    const float least = (float)b->least, most = (float)b->most, on_sigma = (float)b->on_sigma;
    const float minimum = (float)least_on(b), minimum_off = (float)((double)OFF_TO_ON * least_on(b));
    const float off_sigma = (float)b->off_sigma;
    const int has_ends = isfinite(b->most - b->least), is_signed = b->is_signed != 0;
    int64_t number, i;
    for (number = 0; number < b->n_runs; number++) {
        const struct run *run = &b->runs[number];
        const float common = (float)b->patches[run->patch].variance;
        const int64_t first = run->first, last = run->last;
        INDEPENDENT
        for (i = first; i < last; i++) {
            const float deviation = a.last[i] - a.level[i] - a.left[i], noise2 = a.noise2[i];
            a.deviation[i] = a.live[i] ? deviation : 0.0f;
            a.on[i] = highest(minimum, on_sigma * sqrtf(noise2 + a.variance[i] + a.gain[i] * a.gain[i] * common));
            a.off[i] = highest(minimum_off, off_sigma * sqrtf(noise2));
            a.at_end[i] = (uint8_t)(has_ends & ((a.last[i] >= most) | ((a.last[i] <= least) & (is_signed | (deviation > 0)))));
        }
    }
}

/* Writes value, baseline, uncertainty and noise, (n,) float each, then touched, held, why, forced and live, (n,) bytes. */
static void show(struct baseline *b, float *to) {
    const struct baseline a = *b; /* no store can change it */
    const int64_t n = b->n;
    float *value = to, *baseline = to + n, *uncertainty = to + 2 * n, *noise = to + 3 * n;
    uint8_t *touched = (uint8_t *)(to + 4 * n), *held = touched + n, *why = held + n, *forced = why + n;
    uint8_t *const flag = a.flag;
    const uint8_t few_levels = (uint8_t)(a.few_levels != 0), is_held = (uint8_t)(a.is_held != 0);
    uint8_t doubts = 0;
    const float other_side = a.is_signed ? -1.0f : 1.0f, lowest_shown = a.is_signed ? -INFINITY : 0.0f;
    int64_t number, i;
    for (number = 0; number < b->n_runs; number++) {
        const struct run *run = &b->runs[number];
        const float common = (float)b->patches[run->patch].variance, wander = (float)b->patches[run->patch].wander;
        INDEPENDENT
        for (i = run->first; i < run->last; i++) { /* no taxel is surer than it, or a typical one, was right at rest */
            const float least = highest(wander, a.slow[i] * a.slow[i]) + a.strayed2[i];
            const float variance = highest(a.variance[i], least) + a.gain[i] * a.gain[i] * common;
            baseline[i] = a.level[i] + a.left[i];
            uncertainty[i] = a.ready[i] ? sqrtf(variance) : NAN;
            noise[i] = sqrtf(a.noise2[i]);
        }
    }
    INDEPENDENT
    for (i = 0; i < n; i++) { /* the present load of some is gone while the smoothed one is not */
        const float deviation = a.deviation[i], smooth = a.smooth[i], off = a.off[i];
        const float known = a.live[i] ? deviation : smooth;
        const float load = highest(known, known * other_side), smoothed = highest(smooth, smooth * other_side);
        const float shown = highest(known, lowest_shown), least = lowest(off, FALLEN * smoothed);
        value[i] = load >= least ? shown : 0.0f;
        touched[i] = load >= least;
        flag[i] = a.variance[i] > a.noise2[i];
    }
    INDEPENDENT
    for (i = 0; i < n; i++)
        value[i] = a.touched[i] ? value[i] : 0.0f;
    INDEPENDENT
    for (i = 0; i < n; i++) {
        touched[i] &= a.touched[i];
        held[i] = is_held | a.held[i];
        flag[i] = (a.ready[i] ^ 1) | (flag[i] & (a.touched[i] ^ 1));
    }
    INDEPENDENT
    for (i = 0; i < n; i++) { /* the last reason that holds */
        uint8_t reason = touched[i] ? HELD : REST;
        reason = flag[i] ? RELEARNING : reason;
        reason = a.low[i] ? COVERED : reason;
        reason = a.returned[i] ? DOUBTED : reason;
        reason = (a.touched[i] & a.at_end[i]) ? SATURATED : reason;
        why[i] = (few_levels & a.live[i]) ? NO_RESOLUTION : reason;
    }
    for (i = 0; i < n; i++)
        doubts |= why[i] == DOUBTED;
    b->doubts = doubts;
    memcpy(forced, b->forced, (size_t)n);
    memset(b->forced, 0, (size_t)n);
    memcpy(forced + n, b->live, (size_t)n);
}

void skinware_baseline_update(struct baseline *b, int64_t time_ns, const float *values, const uint8_t *usable,
                              const uint8_t *jumped, const uint8_t *bears, float *to) {
    double passed_s, smoothing;
    float rustle_share;
    int64_t i;
    if (!b->has_time || time_ns < b->time_ns)
        time_ns = b->has_time ? b->time_ns : time_ns;
    passed_s = b->has_time ? (double)(time_ns - b->time_ns) / 1e9 : 0;
    b->time_ns = time_ns;
    b->has_time = 1;
    take_in(b, values, usable, jumped, passed_s);
    if (bears)
        memcpy(b->bears, bears, (size_t)b->n);
    if (!b->all_ready) {
        measure(b, time_ns, passed_s);
        for (i = 0; i < b->n; i++)
            b->live[i] = b->ready[i] & b->at_end[i];
    }
    compare(b);
    smoothing = b->smooth_s > 0 ? passed_share(passed_s, b->smooth_s) : 1;
    rustle_share = (float)fmax(0.5, sqrt(smoothing / (2 - smoothing)));
    follow_jumps(b, passed_s);
    follow_common(b, passed_s);
    follow_touches(b, passed_s);
    hold_near(b, passed_s);
    follow_falls(b, rustle_share, passed_s);
    if (!b->is_held)
        learn(b, rustle_share, passed_s);
    if (!b->is_signed)
        follow_remainders(b, passed_s);
    show(b, to);
}

/* Takes the present values as the rest, of all taxels or (0 or more) of a patch; returns their number, or why not. */
int64_t skinware_baseline_tare(struct baseline *b, int64_t patch) {
    const int is_stepless = least_on(b) <= 0;
    int64_t i, number = 0, n_seen = 0;
    for (i = 0; i < b->n; i++) {
        float level = b->level[i] + b->smooth[i], noise2 = 0;
        const int is_asked = b->seen[i] && (patch < 0 || b->patch[i] == patch);
        n_seen += is_asked;
        if (is_asked && !b->ready[i]) {
            if (!measure_now(b, i, &level, &noise2))
                level = b->last[i];
            if (noise2 <= 0 && is_stepless)
                continue;
            b->noise2[i] = highest(noise2, least_noise2(b, level));
            b->noise_s[i] = 0;
            b->ready[i] = 1;
        } else if (!is_asked) {
            continue;
        }
        number++;
        put_at(b, i, level);
        forget_touch(b, i);
        b->settling_s[i] = 0;
    }
    return number ? number : n_seen ? NO_NOISE : NO_VALUE;
}

/* Forgets where the common modes are, after a time without data: the next frames find them again. */
void skinware_baseline_lose_common(struct baseline *b) {
    int64_t i;
    for (i = 0; i < b->n_patches; i++)
        b->patches[i].sums[0] = b->patches[i].sums[1] = 0;
    for (i = 0; i < b->n; i++) {
        struct patch *p = &b->patches[b->patch[i]];
        p->sums[0] += b->noise2[i] > 0;
        p->sums[1] += b->noise2[i] > 0 ? (double)b->noise2[i] : 0;
    }
    for (i = 0; i < b->n_patches; i++)
        b->patches[i].variance = b->patches[i].sums[1] / fmax(b->patches[i].sums[0], 1);
}

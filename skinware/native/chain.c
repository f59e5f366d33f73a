/*
 * Take the frames of a driver into the signals of a chain and out again, and find the loads of its taxels:
 * tests/specification/chain.py.
 */

#include "chain.h"

#include "baseline.h"
#include "../include/skinware.h"

#include <float.h>
#include <string.h>

enum {
    UNUSABLE = SKINWARE_STATUS_NEVER_SEEN | SKINWARE_STATUS_STALE | SKINWARE_STATUS_MASKED | SKINWARE_STATUS_NOT_CONNECTED
};

SKINWARE_EXPORT void skinware_chain_begin(struct chain *chain);
SKINWARE_EXPORT void skinware_chain_calm(struct baseline *b, struct signal *signal, int64_t time_ns, float *given,
                                         float *shown);
SKINWARE_EXPORT void skinware_chain_end(struct chain *chain);
SKINWARE_EXPORT void skinware_chain_loads(const struct chain *chain, struct loads *loads);

/* Puts the values and the status of a snapshot into the signals. */
void skinware_chain_begin(struct chain *chain) {
    const uint8_t has_before = chain->has_before != 0;
    int64_t number, i;
    for (number = 0; number < chain->n_signals; number++) {
        const struct signal s = *chain->signals[number];
        for (i = 0; i < s.n; i++) {
            const float value = chain->values[s.index[i]];
            const uint8_t status = chain->status[s.index[i]], suspect = (status & SKINWARE_STATUS_SUSPECT) != 0;
            s.values[i] = s.deviation[i] = value;
            s.usable[i] = !(status & UNUSABLE) & (fabsf(value) <= FLT_MAX);
            s.jumped[i] = has_before & suspect & !s.suspect[i];
            s.suspect[i] = suspect;
        }
        memset(s.forced, 0, (size_t)s.n);
        memset(s.unknown, 0, (size_t)s.n);
        memset(s.bears, 0, (size_t)s.n);
    }
    chain->has_before = 1;
}

/* Takes the baselines of a signal off; keeps its values in given, and shows the rest as skinware_baseline_update does. */
void skinware_chain_calm(struct baseline *b, struct signal *signal, int64_t time_ns, float *given, float *shown) {
    const struct signal s = *signal;
    const float *baseline = shown + s.n;
    const uint8_t *forced = (uint8_t *)(shown + 4 * s.n) + 3 * s.n;
    int64_t i;
    memcpy(given, s.values, (size_t)s.n * sizeof *given);
    skinware_baseline_update(b, time_ns, given, s.usable, s.jumped, s.bears, shown);
    INDEPENDENT
    for (i = 0; i < s.n; i++) {
        s.deviation[i] = given[i] - baseline[i];
        s.values[i] = shown[i];
        s.forced[i] |= forced[i];
        s.unknown[i] |= baseline[i] != baseline[i];
    }
}

/* Puts the signals into the snapshot. */
void skinware_chain_end(struct chain *chain) {
    int64_t number, i;
    for (number = 0; number < chain->n_signals; number++) {
        const struct signal s = *chain->signals[number];
        for (i = 0; i < s.n; i++) {
            chain->values[s.index[i]] = s.values[i];
            chain->status[s.index[i]] |= (uint8_t)(s.forced[i] * SKINWARE_STATUS_SUSPECT);
            chain->status[s.index[i]] |= (uint8_t)(s.unknown[i] * SKINWARE_STATUS_NEVER_SEEN);
        }
    }
}

/* Finds the loads in the snapshot behind the chain: of one axis its values, of several the lengths of vectors. */
void skinware_chain_loads(const struct chain *chain, struct loads *loads) {
    const struct loads l = *loads;
    const struct axis last = l.axes[l.n_axes - 1]; /* along the normal: shear moves the length before it slips */
    const float least = ONSET_STEPS * (float)l.resolution, most = (float)l.maximum, parts = sqrtf((float)l.n_axes);
    int64_t number, i;
    for (i = 0; i < l.n; i++) {
        float load = 0, above = 0, doubt = 0;
        uint8_t touched = 0, usable = 1, seen = 1, clipped = 0, is_above;
        for (number = 0; number < l.n_axes; number++) {
            const struct axis *axis = &l.axes[number];
            const float value = chain->values[axis->index[i]], deviation = axis->given[i] - axis->baseline[i];
            const float spread = hypotf(axis->noise[i], axis->uncertainty[i]);
            load = l.n_axes == 1 ? value : load + value * value;
            above = l.n_axes == 1 ? deviation : above + deviation * deviation;
            doubt = l.n_axes == 1 ? spread : doubt + spread * spread;
            touched |= axis->touched[i];
            usable &= !(chain->status[axis->index[i]] & UNUSABLE);
            seen &= axis->usable[i];
            clipped |= axis->given[i] >= most;
        }
        l.load[i] = l.n_axes == 1 ? load : sqrtf(load);
        l.above[i] = l.n_axes == 1 ? above : sqrtf(above);
        l.doubt[i] = (l.n_axes == 1 ? doubt : sqrtf(doubt)) / parts;
        l.touched[i] = touched & usable;
        l.known[i] = usable & seen;
        l.clipped[i] = clipped;
        l.sigmas[i] = l.known[i] && last.noise[i] > 0 ? (last.given[i] - last.baseline[i]) / last.noise[i] : NAN;
        is_above = l.known[i] & (l.above[i] > highest(ABOVE_SIGMA * l.doubt[i], least)) & (l.doubt[i] == l.doubt[i]);
        l.onset[i] = is_above & (l.was[i] | l.was_before[i]);
        l.was_before[i] = l.was[i];
        l.was[i] = is_above;
    }
}

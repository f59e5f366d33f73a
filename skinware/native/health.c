/* Gather the evidence of taxels' health that every frame gives: tests/specification/health.py. */

#include "health.h"

#include "baseline.h"

enum { MOVED = 1, BEGUN = 2, HARD_TOUCH = 4, PLAIN_TOUCH = 8 };

SKINWARE_EXPORT int64_t skinware_health_compare(struct health *h);
SKINWARE_EXPORT int64_t skinware_health_use(struct health *h, double now_s, double passed_s);

/* Compares a frame with the values before it; returns MOVED where a taxel has jumped. */
int64_t skinware_health_compare(struct health *h) {
    const struct health a = *h; /* no store can change it */
    const float least = (float)h->least, most = (float)h->most, clear = (float)h->clear;
    int64_t i, found = 0;
    for (i = 0; i < a.n; i++) {
        const float far = fmaxf(CLEAR * a.noise[i], clear), given = a.given[i];
        const uint8_t free = a.usable[i] & !a.calm_touched[i] & (given <= a.baseline[i] + far);
        const uint8_t both = free & a.was_free[i];
        const float difference = both ? given - a.value[i] : 0;
        const float jump = fabsf(given - a.value[i]);
        a.at_end[i] = (given <= least) | (given >= most);
        a.was_free[i] = free;
        a.sums[i] += difference * difference;
        a.sums[a.n + i] += both;
        a.sums[2 * a.n + i] += both & a.at_end[i];
        a.far[i] = far;
        a.jump[i] = jump;
        a.was_still[i] = a.still[i] >= STILL_FRAMES;
        a.still[i] = jump <= far ? a.still[i] + 1 : 0;
        a.moved[i] = a.usable[i] & (jump > 2 * far);
        found |= a.moved[i] ? MOVED : 0;
    }
    return found;
}

/* Takes the frame in; returns BEGUN, HARD_TOUCH and PLAIN_TOUCH where there are such touches. */
int64_t skinware_health_use(struct health *h, double now_s, double passed_s) {
    const struct health a = *h; /* no store can change it */
    const float clear = (float)h->clear, plain = (float)(PLAIN * (h->clear / (double)CLEAR));
    int64_t i, found = 0;
    for (i = 0; i < a.n; i++) {
        const uint8_t touched = a.calm_touched[i] & a.usable[i];
        const float given = a.given[i], load = a.load[i];
        a.begun[i] = touched & !a.touched[i];
        if (a.usable[i] && given != a.value[i]) {
            a.changed_s[i] = now_s;
            a.value[i] = given;
        } else if (!a.usable[i]) {
            a.changed_s[i] += passed_s;
        }
        a.seen[i] |= a.usable[i];
        a.touched[i] = touched;
        a.total[i] += a.usable[i] ? given : NAN;
        a.above[i] = given - a.baseline[i];
        a.plain[i] = a.calm_touched[i] & (a.above[i] > plain);
        if (a.begun[i])
            a.usual[i] *= KEPT;
        if (touched) {
            a.peak[i] = highest(load, a.peak[i]);
            a.usual[i] = highest(load, a.usual[i]);
        }
        a.hard[i] = touched & (load > highest(clear, HARD * a.usual[i])) & !a.misled[i];
        found |= (a.begun[i] ? BEGUN : 0) | (a.hard[i] ? HARD_TOUCH : 0) | (a.plain[i] ? PLAIN_TOUCH : 0);
    }
    return found;
}

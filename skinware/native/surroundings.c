/* Follow what contacts do to the taxels around them: they are held, they sag, and some were covered before. */

#include "baseline.h"

enum { BELOW, RESTS };

static int is_busy(const struct baseline *b, int64_t patch) {
    return b->patches[patch].since_s <= b->settle_s;
}

/* Finds the taxels that are near a touch, or were in the last settle_s. */
void hold_near(struct baseline *b, double passed_s) {
    const float settle_s = (float)fmax(b->settle_s, 1e-6);
    int64_t i, k, is_touched = 0;
    for (k = 0; k < b->n_touched; k++)
        is_touched |= b->touched[b->list[k]] & b->live[b->list[k]];
    if (!is_touched && !b->is_near)
        return;
    for (i = 0; i < b->n; i++)
        b->settling_s[i] = highest(b->settling_s[i] - (float)passed_s, 0);
    for (k = 0; k < b->n_patches; k++) {
        struct patch *p = &b->patches[k];
        p->since_s += passed_s;
        p->largest = p->since_s > fmax(b->settle_s, 1e-9) ? 0 : p->largest;
        p->present = 0;
    }
    for (k = 0; k < b->n_modules; k++)
        b->modules[k].near = 0;
    for (k = 0; k < b->n_touched; k++) {
        struct patch *p = &b->patches[b->patch[i = b->list[k]]];
        if (!b->touched[i] || !b->live[i])
            continue;
        p->since_s = 0;
        p->present = fmax(p->present, (double)b->smooth[i]);
        p->largest = fmax(p->largest, p->present);
        b->modules[b->module[i]].near = 1;
    }
    for (i = 0, b->is_near = 0; i < b->n; i++) {
        if (b->modules[b->module[i]].near > 0)
            b->settling_s[i] = settle_s;
        b->held[i] = b->settling_s[i] > 0;
        b->is_near |= b->held[i];
    }
    for (k = 0; k < b->n_patches; k++)
        b->is_near |= is_busy(b, k);
}

/*
 * Finds the taxels at rest that are below their offsets by more than noise. Where most of a patch is, that is its mode; but
 * while it is touched only if its mode moves that much by itself: a cover can pull a whole patch down.
 */
static void find_low(struct baseline *b, float rustle_share, double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    int64_t i, k, is_any = 0;
    INDEPENDENT
    for (i = 0; i < b->n; i++) {
        const float low = -(rustle_share * a.off[i]), least = a.below[i] ? 0.0f : low;
        a.flag[i] = a.live[i] & !a.touched[i];
        a.below[i] = a.flag[i] & (a.smooth[i] < least);
    }
    for (i = 0; i < b->n; i++)
        is_any |= a.below[i];
    if (!is_any)
        return;
    for (k = 0; k < b->n_patches; k++)
        b->patches[k].sums[BELOW] = b->patches[k].sums[RESTS] = 0;
    for (k = 0; k < b->n_runs; k++) {
        int64_t below = 0, rests = 0;
        for (i = b->runs[k].first; i < b->runs[k].last; i++)
            below += a.below[i], rests += a.flag[i];
        b->patches[b->runs[k].patch].sums[BELOW] += (double)below;
        b->patches[b->runs[k].patch].sums[RESTS] += (double)rests;
    }
    for (k = 0; k < b->n_runs; k++) {
        const struct patch *p = &b->patches[b->runs[k].patch];
        const int may_be = !is_busy(b, b->runs[k].patch) || p->agility * passed_s > p->noise2;
        const int is_mode = may_be && p->sums[BELOW] > 0.5 * p->sums[RESTS];
        for (i = b->runs[k].first; is_mode && i < b->runs[k].last; i++)
            a.below[i] = 0;
    }
}

/*
 * Finds the taxels that are below their offsets since something touches their patch: the cover pulls them down, and they
 * come back. A cover would be back soon after the touch; those that are as low then were so before.
 */
static void find_sagging(struct baseline *b, float passed) {
    const struct baseline a = *b; /* no store can change it */
    int64_t i, k;
    for (k = 0; k < b->n_runs; k++) {
        const int64_t first = b->runs[k].first, last = b->runs[k].last;
        const int busy = is_busy(b, b->runs[k].patch);
        const int is_back = (float)b->patches[b->runs[k].patch].since_s > SAG_RETURNS_S;
        INDEPENDENT
        for (i = first; i < last; i++) {
            const float depth = -a.smooth[i], longer_s = a.down_s[i] + passed;
            const float down_s = depth > a.off[i] ? longer_s : 0.0f, before = a.below[i] ? a.lowered[i] : 0.0f;
            const float lowered = (is_back & (down_s > SAG_RETURNS_S)) ? depth : before;
            const int sags = busy & a.below[i] & !((lowered > 0) & (depth <= lowered + a.off[i]));
            a.down_s[i] = down_s;
            a.lowered[i] = lowered;
            a.sagging[i] = (uint8_t)sags;
            a.sunk[i] = is_back ? 0.0f : highest(a.sunk[i], sags ? depth : 0.0f);
        }
    }
}

/* Gives new offsets to taxels whose old ones were learned under a load that is gone now; a sag is no such load. */
static void recover(struct baseline *b, int64_t i, float passed) {
    const float depth = -b->smooth[i];
    b->below_s[i] += passed;
    if (b->lowered[i] <= 0 && (b->below_s[i] < (float)fmax(b->recover_s, 1e-9) ||
                               depth <= SAG_SHARE * (float)b->patches[b->patch[i]].largest))
        return;
    b->below_s[i] = b->dip_s[i] = b->lowered[i] = 0;
    b->dip[i] = depth;
    if (!b->is_held)
        put(b, i, b->smooth[i]);
}

/* The same for axes within the skin, as friction needs a load along the normal; near one the skin is pulled. */
static void follow_normal(struct baseline *b, float passed) {
    const struct baseline *normal = b->normal;
    int64_t i;
    for (i = 0; i < b->n; i++) {
        const float pull = SAG_SHARE * (float)normal->patches[normal->patch[i]].largest;
        const int rests = normal->live[i] & (normal->touched[i] ^ 1) & (normal->smooth[i] < normal->off[i]);
        b->low[i] = b->live[i] & b->touched[i] & rests & (fabsf(b->smooth[i]) > highest(normal->off[i], pull));
        b->below_s[i] = b->low[i] ? b->below_s[i] + passed : 0.0f;
        if (b->below_s[i] < (float)fmax(b->recover_s, 1e-9) || b->is_held)
            continue;
        put(b, i, b->smooth[i]);
        end_touch(b, i);
    }
}

void follow_falls(struct baseline *b, float rustle_share, double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    int64_t i;
    if (a.normal)
        follow_normal(b, (float)passed_s);
    if (a.is_signed)
        return;
    find_low(b, rustle_share, passed_s);
    find_sagging(b, (float)passed_s);
    for (i = 0; i < b->n; i++) {
        a.low[i] = a.live[i] & (a.smooth[i] < -a.on[i]);
        if (a.low[i] || a.lowered[i] > 0)
            recover(b, i, (float)passed_s);
        else
            a.below_s[i] = 0;
    }
}

/* Returns whether a new touch is none: the taxel returns to where it fell from, or sagged from. */
static int is_return(struct baseline *b, int64_t i) {
    const float smooth = b->smooth[i], on = b->on[i], old_s = (float)b->modules[b->module[i]].old_s;
    if (!b->felt[i] && b->dip[i] > 0 && fabsf(smooth - b->dip[i]) < on) {
        b->returned[i] = (uint8_t)(b->returned[i] + (b->returned[i] < 255));
        b->dip[i] = 0;
        return 1;
    }
    return old_s > 0 && old_s < SAG_RETURNS_S && b->sunk[i] > 0 && smooth < SAG_RETURNS_BY * b->sunk[i] + on &&
           b->since_end_s[i] > 2 * SAG_RETURNS_S; /* else its own touch flickers */
}

/* Ends new touches that are none, and notes which taxels and modules have touches that are. */
void return_from_falls(struct baseline *b, double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    int64_t i, k;
    for (k = 0; k < b->n_modules; k++)
        b->modules[k].old_s += passed_s;
    for (i = 0; i < b->n; i++) {
        a.dip_s[i] += (float)passed_s;
        a.dip[i] = a.dip_s[i] > DIP_S ? 0.0f : a.dip[i];
    }
    for (k = 0; k < b->n_touched; k++)
        if (is_looked_at(b, i = b->list[k], passed_s) == 2) {
            b->modules[a.module[i]].old_s = 0;
            a.felt[i] = 1;
        }
    for (k = 0; k < b->n_touched; k++)
        if (is_looked_at(b, i = b->list[k], passed_s) == 1 && is_return(b, i)) {
            put(b, i, a.smooth[i]);
            end_touch(b, i);
        }
}

/*
 * Compare deviations with what drift could be: which taxels are touched, when a touch is over, and what covers keep of
 * loads that are over.
 */

#include "baseline.h"

enum { POWER, KEPT }; /* of a patch: sums of squares of loads, and of loads times what was left of them */

void end_touch(struct baseline *b, int64_t taxel) {
    b->touched[taxel] = 0;
    if (!b->is_signed)
        b->since_end_s[taxel] = 0;
    b->peak[taxel] = b->contact_s[taxel] = 0;
}

void forget_touch(struct baseline *b, int64_t taxel) {
    end_touch(b, taxel);
    b->smooth[taxel] = b->used[taxel] = b->left[taxel] = 0;
    b->since_end_s[taxel] = INFINITY;
}

/* 1: the touch is looked at again in this frame; 2: it was before; 0: there is none, or it is too new. */
int64_t is_looked_at(const struct baseline *b, int64_t taxel, double passed_s) {
    if (!b->touched[taxel] || b->contact_s[taxel] < LOOK_AT_S)
        return 0;
    return b->contact_s[taxel] - (float)passed_s >= LOOK_AT_S ? 2 : 1;
}

static void begin_learning(struct baseline *b) {
    int64_t i;
    for (i = 0; i < b->n_patches; i++)
        b->patches[i].sums[POWER] = b->patches[i].sums[KEPT] = 0;
}

static void note_remainder(struct baseline *b, int64_t taxel, float left, float used) {
    struct patch *p = &b->patches[b->patch[taxel]];
    p->sums[POWER] += (double)(used * used);
    p->sums[KEPT] += (double)(left * used);
}

/* Learns the share of loads that each cover keeps. */
static void end_learning(struct baseline *b, float weight) {
    int64_t i;
    for (i = 0; i < b->n_patches; i++) {
        struct patch *p = &b->patches[i];
        float share = (float)p->share;
        if (p->sums[POWER] > 0)
            share += weight * ((float)(p->sums[KEPT] / fmax(p->sums[POWER], 1e-12)) - share);
        p->share = (double)lowest(highest(share, 0), MOST_REMAINDER);
    }
}

/* Returns whether the rest after a sudden fall faded by itself: then it was no load. Where a touch began on the module since
 * the fall, the load may have moved there. */
static int fades(struct baseline *b, int64_t i, float load, float passed, float follows) {
    const float off = b->off[i], before = b->steady[i], noted = b->noted[i];
    const int fell = load < FALLEN * before && before > 2 * off, moved = fell || fabsf(load - before) > off;
    const float steady = fell ? load : before + (load - before) * follows;
    const double begun_s = b->modules[b->module[i]].begun_s;
    const float since = (fell ? 0.0f : moved && isfinite(noted) ? INFINITY : b->since_fall_s[i]) + passed;
    float left = moved ? NAN : noted;
    if (isnan(left) && since >= LEFT_AT_S && since < 2 * LEFT_AT_S) {
        left = steady;
        b->used_then[i] = b->used[i];
    }
    b->steady[i] = steady, b->noted[i] = left, b->since_fall_s[i] = since;
    return isfinite(left) && steady < lowest(FADED * left, left - 0.5f * off) &&
           left < MOST_REMAINDER * b->used_then[i] && since < 2 * (float)USED_S && begun_s >= (double)since;
}

static void begin_touch(struct baseline *b, int64_t i, float load) {
    b->touched[i] = 1;
    b->peak[i] = b->steady[i] = load;
    b->since_fall_s[i] = INFINITY;
    b->noted[i] = NAN;
    b->contact_s[i] = 0;
    b->modules[b->module[i]].begun_s = 0;
}

/* Finds touches and their ends; b->flag says which are over, b->list which there are. */
static int64_t judge(struct baseline *b, double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    const float passed = (float)passed_s, most_s = (float)b->maximum_hold_s;
    const float follows = (float)passed_share(passed_s, 1), rises = (float)passed_share(passed_s, PEAK_S);
    const float eases = (float)passed_share(passed_s, USED_S); /* what falls more slowly was not let go */
    int64_t i, k, n_over = 0;
    b->n_touched = 0;
    for (k = 0; k < b->n_modules; k++)
        b->modules[k].begun_s += passed_s;
    for (i = 0; i < b->n; i++) {
        const int high = (load_of(&a, a.deviation[i]) > a.off[i]) & a.live[i], was_high = a.high[i];
        a.high[i] = a.live[i] ? (uint8_t)high : a.high[i];
        if (high && !was_high)
            a.onset[i] = a.deviation[i];
        if (high && !a.touched[i] && (was_high || passed_s >= QUICK_S) &&
            load_of(&a, a.smooth[i]) > (a.bears[i] ? a.off[i] : a.on[i]))
            begin_touch(b, i, load_of(&a, a.smooth[i]));
        if (a.touched[i])
            b->list[b->n_touched++] = i;
    }
    if (b->n_touched)
        begin_learning(b);
    for (k = 0; k < b->n_touched; k++) {
        const float load = load_of(&a, b->smooth[i = b->list[k]]);
        float variance = a.variance[i] + a.noise2[i] + 0.3f * a.left[i] * (0.3f * a.left[i]);
        int is_faded;
        a.flag[i] = 0;
        if (!a.live[i])
            continue;
        a.contact_s[i] += passed;
        a.peak[i] += (load - a.peak[i]) * (load > a.peak[i] ? rises : eases);
        variance += a.gain[i] * a.gain[i] * (float)b->patches[a.patch[i]].variance;
        is_faded = fades(b, i, load, passed, follows);
        if (is_faded)
            note_remainder(b, i, a.noted[i], a.used_then[i]);
        a.flag[i] = !a.bears[i] &&
                    (is_faded || load < a.off[i] || a.contact_s[i] > most_s ||
                     (load < FALLEN * a.peak[i] && load * load < DRIFT_SIGMA * DRIFT_SIGMA * variance));
        n_over += a.flag[i];
    }
    if (b->n_touched)
        end_learning(b, 1.0f);
    return n_over;
}

/* Ends touches: the rest of the load is what the prediction was wrong by, unless the touch was too light to say so. What
 * is below 0 then needs no higher threshold, under which the next press would be taken for drift. */
static void let_go(struct baseline *b) {
    int64_t i, k;
    for (k = 0; k < b->n_touched; k++) {
        const float smooth = b->smooth[i = b->list[k]], now = b->deviation[i];
        const float left = fabsf(now) < fabsf(smooth) ? now : smooth; /* the smoothed one may still fall */
        const int is_too_long = b->contact_s[i] > (float)b->maximum_hold_s;
        if (!b->flag[i])
            continue;
        if (b->peak[i] > 2 * b->on[i] && load_of(b, left) > 0)
            b->variance[i] += left * left;
        end_touch(b, i);
        if (is_too_long)
            put(b, i, left);
    }
}

enum { NOW = 1, LATER = 2 }; /* when a module is looked at: as a touch begins, or a moment after that */

static int64_t find_new_modules(struct baseline *b, double passed_s) {
    int64_t k, found = 0;
    for (k = 0; k < b->n_modules; k++)
        b->modules[k].looked = b->modules[k].number = b->modules[k].alike = 0;
    for (k = 0; k < b->n_touched; k++) {
        const int64_t i = b->list[k];
        struct module *m = &b->modules[b->module[i]];
        if (is_looked_at(b, i, passed_s) == 1)
            m->looked = LATER, found++;
        else if (b->touched[i] && b->contact_s[i] <= (float)passed_s)
            m->looked = fmax(m->looked, NOW), found++; /* LATER stays */
    }
    return found;
}

/* Whether the values of a taxel moved like the typical ones of its module. */
static int is_alike(const struct baseline *b, int64_t i) {
    const float median = (float)b->modules[b->module[i]].median;
    return b->flag[i] && fabsf(b->deviation[i] - median) < highest(ALIKE * median, 0.5f * b->on[i]);
}

/* Moves the offsets of modules whose taxels rose alike, at once and by little: their board moved its own baseline. */
static void follow_steps(struct baseline *b, double passed_s) {
    const int64_t stride = sizeof(struct module) / sizeof(double);
    int64_t i, k;
    if (b->is_signed || !find_new_modules(b, passed_s))
        return;
    for (i = 0; i < b->n; i++)
        b->flag[i] = b->live[i] && b->modules[b->module[i]].looked > 0 &&
                     (!b->touched[i] || b->contact_s[i] < 2 * LOOK_AT_S); /* older touches say nothing of it */
    medians(b, b->module, b->n_modules, b->deviation, b->flag, &b->modules->median, stride);
    medians(b, b->module, b->n_modules, b->slow, b->flag, &b->modules->slow, stride);
    medians(b, b->module, b->n_modules, b->on, b->flag, &b->modules->on, stride);
    medians(b, b->module, b->n_modules, b->off, b->flag, &b->modules->off, stride);
    for (i = 0; i < b->n; i++) {
        b->modules[b->module[i]].number += b->flag[i];
        b->modules[b->module[i]].alike += is_alike(b, i);
        b->flag[i] &= b->high[i];
    }
    medians(b, b->module, b->n_modules, b->onset, b->flag, &b->modules->onset, stride);
    for (k = 0; k < b->n_modules; k++) {
        struct module *m = &b->modules[k];
        const float median = (float)m->median, on = (float)m->on;
        const int is_at_once = fabs(m->onset - m->median) < AT_ONCE * m->median;
        const int is_step = is_at_once && (m->looked == LATER || m->onset > m->on); /* else a slow rise begins like one */
        m->looked = m->number >= 4 && m->alike >= MOST_ALIKE * m->number && (float)m->slow < 0.3f * median &&
                    is_step && median > OFF_TO_ON * on && median < STEP_OVER_ON / OFF_TO_ON * (float)m->off;
    }
    for (i = 0; i < b->n; i++) {
        const struct module *m = &b->modules[b->module[i]];
        if (!b->live[i] || !m->looked || b->deviation[i] < 0.5f * (float)m->median)
            continue;
        put(b, i, (float)m->median);
        b->variance[i] += ALIKE * ALIKE * (float)(m->median * m->median);
        b->smooth[i] = b->deviation[i];
        if (b->smooth[i] < b->on[i])
            end_touch(b, i);
    }
}

/* Smooths the deviations, and finds touches. A rise above the threshold begins at 0, however far the taxel had sunk. */
void follow_touches(struct baseline *b, double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    const float share = b->smooth_s > 0 ? (float)passed_share(passed_s, b->smooth_s) : 1.0f;
    int64_t i, n_over;
    INDEPENDENT
    for (i = 0; i < b->n; i++) {
        const float deviation = a.deviation[i], before = a.smooth[i], on = a.on[i];
        const float from = !a.is_signed & (deviation > on) ? highest(before, 0) : before;
        const float smooth = from + (deviation - from) * share;
        a.smooth[i] = !a.live[i] ? before : a.is_signed ? smooth : lowest(smooth, deviation + on);
    }
    n_over = judge(b, passed_s);
    if (b->is_held)
        return;
    if (n_over)
        let_go(b);
    return_from_falls(b, passed_s);
    follow_steps(b, passed_s);
}

/* Follows what the material is used to, and predicts what is left of it: it fades by itself, and is no load. */
void follow_remainders(struct baseline *b, double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    const float passed = (float)passed_s, share = (float)passed_share(passed_s, USED_S);
    int64_t i, k, n = 0;
    for (i = 0; i < b->n; i++)
        if (a.touched[i] | (a.used[i] > 0) | (a.since_end_s[i] < SETTLED_S))
            b->list[n++] = i;
    if (!n)
        return;
    begin_learning(b);
    for (k = 0; k < b->n_modules; k++)
        b->modules[k].touched = 0;
    for (k = 0; k < n; k++)
        b->modules[b->module[b->list[k]]].touched += b->touched[b->list[k]];
    for (k = 0; k < n; k++) {
        const float now = b->touched[i = b->list[k]] ? highest(a.deviation[i], 0) : 0.0f, after = a.since_end_s[i];
        float used = a.used[i];
        used += (now - used) * share;
        if (!a.touched[i] && used < 0.5f * a.on[i])
            used = 0;
        a.used[i] = used;
        if (after < SETTLED_S && after + passed >= SETTLED_S && !a.touched[i] && used > 5 * a.on[i] &&
            b->modules[a.module[i]].touched == 0) /* else a weaker grip may be left */
            note_remainder(b, i, a.smooth[i] + a.left[i], used);
    }
    end_learning(b, 0.5f);
    for (k = 0; k < n; k++) {
        const float now = b->touched[i = b->list[k]] ? highest(a.deviation[i], 0) : 0.0f;
        a.left[i] = (float)b->patches[a.patch[i]].share * highest(a.used[i] - now, 0);
    }
    INDEPENDENT
    for (i = 0; i < b->n; i++)
        a.since_end_s[i] += passed;
}

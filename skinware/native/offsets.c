/*
 * Predict what each taxel reads at rest, and how uncertain that is: a Kalman filter for each taxel, one common mode for
 * each patch. A value is offset + noise + load. Between two frames the offset moves by the gain of the taxel times the
 * move of the mode, and by a drift of its own.
 */

#include "baseline.h"

#define MEDIAN2 0.455 /* median of the square of a standard normal deviate */
#define LEAST 1e-30   /* keeps divisors above 0 */

enum { WEIGHT, REACH, FOUND, FREE };

static void step_mode(struct patch *p, double passed_s) {
    const double weights = fmax(p->sums[WEIGHT], LEAST);
    const double reach = fmax(p->sums[REACH], (double)LEAST_GAIN * weights);
    const double precision = fmax(reach * reach / weights, LEAST);
    const int is_known = p->sums[FREE] > FEW_TAXELS;
    const double ahead = is_known ? p->rate * passed_s : 0;
    const double found = p->sums[FOUND] / reach - ahead;
    const double trust = is_known ? 1 - FEW_TAXELS / p->sums[FREE] : 0;
    double total, most, share, news;
    if (is_known) {
        p->unknown_s = 0;
    } else {
        p->variance += p->rate2 * (2 * p->unknown_s + passed_s) * passed_s;
        p->unknown_s += passed_s;
    }
    total = p->variance + 1 / precision;
    most = (double)DRIFT_SIGMA * sqrt(total);
    share = trust * p->variance / total;
    news = share * fmin(fmax(found, -most), most);
    p->move = ahead + news;
    p->sure = ahead + share * news;
    p->variance = (1 - share) * (1 - share) * p->variance + share * share / precision;
    if (!is_known)
        return;
    if (found * found != MEDIAN2 * total)
        p->agility *= exp(fmin(passed_s / MATCH_S, 1) * (found * found > MEDIAN2 * total ? 1 : -1));
    p->agility = fmax(p->agility, 1e-5 / precision);
    p->known_s += passed_s;
    p->rate += (p->move / passed_s - p->rate) * passed_share(passed_s, RATE_S);
    p->rate2 += (p->rate * p->rate - p->rate2) * (passed_s / fmin(fmax(p->known_s, RATE_S), 10 * RATE_S));
}

/* Which taxels are at rest, and what they say of the mode: a taxel near a contact may bear a load that is no touch; the
 * fall of one whose own offset was wrong says nothing. */
static void sum_run(struct baseline *b, const struct run *run, struct patch *p) {
    const struct baseline a = *b; /* no store can change it */
    const float common = (float)p->variance, typical = (float)p->noise2, low = -(float)b->off_sigma;
    double weights = p->sums[WEIGHT], reach = p->sums[REACH], found = p->sums[FOUND], number = p->sums[FREE];
    const int64_t first = run->first, last = run->last;
    int64_t i;
    INDEPENDENT
    for (i = first; i < last; i++) {
        const float lowest_rest = low * sqrtf(a.noise2[i]), since_s = a.since_end_s[i];
        const float least = a.below[i] ? lowest_rest : -INFINITY;
        a.flag[i] = ((a.smooth[i] >= least ? since_s : 0.0f) >= SETTLED_S) & (a.noise2[i] >= QUIET * typical);
    }
    INDEPENDENT
    for (i = first; i < last; i++)
        a.flag[i] &= a.live[i] & (a.touched[i] ^ 1) & (a.at_end[i] ^ 1) & (a.sagging[i] ^ 1) & !(a.lowered[i] > 0);
    INDEPENDENT
    for (i = first; i < last; i++) {
        const float on = a.on[i], hidden2 = a.held[i] ? on * on : 0.0f;
        const float own = highest(a.noise2[i], typical) + a.variance[i]; /* a quiet taxel does not count for more */
        const float limit = 2.0f * sqrtf(own + a.gain[i] * a.gain[i] * common);
        const float weight = 1.0f / (own + hidden2), clipped = within(a.deviation[i], limit) * weight;
        a.scratch[i] = a.flag[i] ? weight : 0.0f;
        a.scratch[a.n + i] = a.flag[i] ? clipped : 0.0f;
    }
    for (i = first; i < last; i++) {
        weights += (double)a.scratch[i];
        reach += (double)(a.scratch[i] * a.gain[i]);
        found += (double)a.scratch[a.n + i];
        number += a.flag[i];
    }
    p->sums[WEIGHT] = weights, p->sums[REACH] = reach, p->sums[FOUND] = found, p->sums[FREE] = number;
}

/* Whether a taxel moved as far as the typical free one of its patch. */
static int moved_along(const struct baseline *b, int64_t i) {
    const float jump = (float)b->patches[b->patch[i]].jump;
    return b->flag[i] && fabsf(b->deviation[i] - jump) < highest(ALIKE * fabsf(jump), b->off[i]);
}

enum { NUMBER, DOWN, UP, ALONG };

/* Finds patches that may jump; b->flag says which taxels are free: a touch that has just begun may be the jump itself. */
static int64_t find_jumps(struct baseline *b, double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    int64_t i, k, found = 0;
    for (k = 0; k < b->n_patches; k++)
        for (i = 0; i < 4; i++)
            b->patches[k].sums[i] = 0;
    INDEPENDENT
    for (i = 0; i < b->n; i++)
        a.flag[i] = a.live[i] & (a.at_end[i] ^ 1) & ((a.touched[i] ^ 1) | (a.contact_s[i] < 2 * LOOK_AT_S));
    for (k = 0; k < b->n_runs; k++) {
        double *sums = b->patches[b->runs[k].patch].sums;
        int64_t number = 0, down = 0, up = 0;
        for (i = b->runs[k].first; i < b->runs[k].last; i++) {
            number += a.flag[i];
            down += a.flag[i] & (a.deviation[i] < -a.off[i]);
            up += a.flag[i] & (a.deviation[i] > a.off[i]);
        }
        sums[NUMBER] += (double)number, sums[DOWN] += (double)down, sums[UP] += (double)up;
    }
    for (k = 0; k < b->n_patches; k++) {
        struct patch *p = &b->patches[k];
        const int may_rise = p->fall > 0 || passed_s > GAP_S;
        const double most = NEARLY_ALL * p->sums[NUMBER];
        p->fell_s += passed_s;
        p->fall = p->fell_s > DIP_S ? 0 : p->fall;
        p->jump = p->sums[NUMBER] > MANY_TAXELS && (p->sums[DOWN] >= most || (may_rise && p->sums[UP] >= most));
        found += p->jump != 0;
    }
    return found;
}

/*
 * Moves all offsets of a patch at once where nearly all of its free taxels moved alike and at once, as where its supply
 * sags: down, as no load does; up, back to where it fell from, or while no data came. A hand that slams shut moves them
 * alike, too, but from the rest.
 */
void follow_jumps(struct baseline *b, double passed_s) {
    const int64_t stride = sizeof(struct patch) / sizeof(double);
    int64_t i, k;
    if (b->is_signed || b->has_no_common || !find_jumps(b, passed_s))
        return;
    for (i = 0; i < b->n; i++)
        b->flag[i] &= b->patches[b->patch[i]].jump != 0;
    medians(b, b->patch, b->n_patches, b->deviation, b->flag, &b->patches->jump, stride);
    medians(b, b->patch, b->n_patches, b->smooth, b->flag, &b->patches->before, stride);
    for (i = 0; i < b->n; i++)
        b->patches[b->patch[i]].sums[ALONG] += moved_along(b, i);
    for (k = 0; k < b->n_patches; k++) {
        struct patch *p = &b->patches[k];
        const int returns = fabs(p->jump - p->fall) < (double)ALIKE * p->fall;
        const double hum2 = b->on_sigma * b->on_sigma * (p->variance + p->agility * passed_s); /* is followed as it comes */
        const int is_alike = p->sums[ALONG] >= NEARLY_ALL * p->sums[NUMBER] && p->jump * p->jump > hum2;
        const int is_sudden = p->jump < 0 ? fabs(p->before) < -0.3 * p->jump : returns || passed_s > GAP_S;
        p->jump = is_alike && is_sudden ? p->jump : 0;
        p->fall = p->jump != 0 ? fmax(-p->jump, 0) : p->fall;
        p->fell_s = p->jump < 0 ? 0 : p->fell_s;
    }
    for (i = 0; i < b->n; i++) {
        const float jump = (float)b->patches[b->patch[i]].jump;
        if (jump == 0 || !b->live[i])
            continue;
        if (moved_along(b, i)) {
            put(b, i, b->deviation[i]);
            b->smooth[i] = 0;
            if (b->touched[i])
                end_touch(b, i);
        } else {
            b->level[i] += jump;
            b->deviation[i] -= jump;
            b->variance[i] += (ALIKE / 3) * (ALIKE / 3) * jump * jump;
        }
    }
}

/* Moves the offsets by the common mode, and takes that off the deviations. */
void follow_common(struct baseline *b, double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    int64_t number, i;
    if (passed_s <= 0 || b->has_no_common)
        return;
    for (number = 0; number < b->n_patches; number++) {
        struct patch *p = &b->patches[number];
        p->variance = p->taxels > FEW_TAXELS ? p->variance + p->agility * passed_s : 0;
        for (i = 0; i < 4; i++)
            p->sums[i] = 0;
    }
    for (number = 0; number < b->n_runs; number++)
        sum_run(b, &b->runs[number], &b->patches[b->runs[number].patch]);
    for (number = 0; number < b->n_patches; number++)
        step_mode(&b->patches[number], passed_s);
    for (number = 0; number < b->n_runs; number++) {
        const struct run *run = &b->runs[number];
        const float move = (float)b->patches[run->patch].move, sure = (float)b->patches[run->patch].sure;
        INDEPENDENT
        for (i = run->first; i < run->last; i++) {
            const float change = a.gain[i] * move, doubt = sure * a.gain_variance[i];
            a.level[i] += change;
            a.deviation[i] -= change;
            a.variance[i] += sure * (2.0f * a.cross[i] + doubt);
            a.cross[i] += doubt;
        }
    }
}

enum { BEYOND = 1, TYPICAL, AWAY, SPEED2 = 1 }; /* beside NUMBER */

/* Learns how quickly the taxels of each module drift by themselves, as they did when they were last seen at rest. */
static void follow_speeds(struct baseline *b) {
    const double share = passed_share(b->tick_s, WANDER_S);
    int64_t i;
    for (i = 0; i < b->n_modules; i++)
        b->modules[i].living = b->modules[i].speed2 = 0;
    for (i = 0; i < b->n_patches; i++)
        b->patches[i].sums[NUMBER] = b->patches[i].sums[SPEED2] = 0;
    for (i = 0; i < b->n; i++) {
        struct module *m = &b->modules[b->module[i]];
        struct patch *p = &b->patches[b->patch[i]];
        const double speed2 = (double)(b->speed[i] * b->speed[i]);
        if (!b->live[i])
            continue;
        m->living += 1, m->speed2 += speed2;
        p->sums[NUMBER] += 1, p->sums[SPEED2] += speed2;
    }
    for (i = 0; i < b->n_patches; i++) {
        struct patch *p = &b->patches[i];
        if (p->sums[NUMBER] > FEW_TAXELS)
            p->own_rate2 = p->sums[SPEED2] / p->sums[NUMBER];
    }
    for (i = 0; i < b->n; i++)
        if (b->modules[b->module[i]].living <= FEW_TAXELS)
            b->modules[b->module[i]].speed2 = b->patches[b->patch[i]].own_rate2;
    for (i = 0; i < b->n_modules; i++) {
        struct module *m = &b->modules[i];
        const double rate2 = m->living > FEW_TAXELS ? m->speed2 / m->living : m->speed2;
        m->rate2 += (rate2 - m->rate2) * share;
    }
    for (i = 0; i < b->n; i++)
        b->own_rate2[i] = (float)b->modules[b->module[i]].rate2;
}

/* Adjusts what changes slowly: the drift of taxels by themselves, and the typical gain of a patch, which is 1. */
static void tick(struct baseline *b, double passed_s) {
    const double slowly = passed_share(passed_s, SLOW_S);
    const float share = (float)(slowly / (2 - slowly));
    const float forgets = (float)passed_share(b->tick_s, GAIN_LASTS_S);
    const int64_t stride = sizeof(struct patch) / sizeof(double);
    int64_t number, i;
    for (number = 0; number < b->n_patches; number++)
        for (i = 0; i < 4; i++)
            b->patches[number].sums[i] = 0;
    for (i = 0; i < b->n; i++) {
        struct patch *p = &b->patches[b->patch[i]];
        const float deviation2 = b->variance[i] + b->gain[i] * b->gain[i] * (float)p->variance;
        const float expected = (float)(1.5 * MEDIAN2) * (b->noise2[i] * share + deviation2);
        if (!b->flag[i])
            continue;
        p->sums[NUMBER] += 1;
        p->sums[BEYOND] += b->slow[i] * b->slow[i] > expected;
    }
    medians(b, b->patch, b->n_patches, b->noise2, b->flag, &b->patches->sums[TYPICAL], stride);
    for (i = 0; i < b->n; i++)
        b->scratch[b->n + i] = fabsf(b->slow[i]);
    medians(b, b->patch, b->n_patches, b->scratch + b->n, b->flag, &b->patches->sums[AWAY], stride);
    for (number = 0; number < b->n_patches; number++) {
        struct patch *p = &b->patches[number];
        const double beyond = p->sums[BEYOND] / fmax(p->sums[NUMBER], 1);
        if (p->sums[NUMBER] > 0) {
            const double away2 = p->sums[AWAY] * p->sums[AWAY] / MEDIAN2 - p->sums[TYPICAL] * (double)share;
            p->noise2 = p->sums[TYPICAL];
            p->wander += (fmax(away2, 0) - p->wander) * passed_share(b->tick_s, WANDER_S);
            p->drift = p->drift > 0 ? p->drift * exp(b->tick_s / 10 * (2 * beyond - 1)) : FIRST_DRIFT * p->noise2;
            p->drift = fmin(fmax(p->drift, LEAST_DRIFT * p->noise2), MOST_DRIFT * p->noise2);
        }
        p->sums[0] = p->sums[1] = 0;
    }
    for (i = 0; i < b->n; i++) {
        struct patch *p = &b->patches[b->patch[i]];
        const float forgotten = b->flag[i] ? forgets : 0.0f;
        b->gain[i] += (1 - b->gain[i]) * forgotten;
        b->gain_variance[i] += (GAIN_SPREAD2 - b->gain_variance[i]) * (2 * forgotten);
        p->sums[0] += b->flag[i] ? (double)b->gain_before[i] : 0;
        p->sums[1] += b->flag[i] ? (double)b->gain[i] : 0;
    }
    for (i = 0; i < b->n; i++) { /* the gains and the mode must not float apart */
        const struct patch *p = &b->patches[b->patch[i]];
        const float ratio = (float)(p->sums[1] > 0 ? p->sums[0] / fmax(p->sums[1], 1e-9) : 1);
        const float least = b->noise2[i] < QUIET * (float)p->noise2 ? 0.0f : LEAST_GAIN;
        b->gain[i] *= b->flag[i] ? ratio : 1.0f;
        b->gain[i] = lowest(highest(b->gain[i], least), MOST_GAIN);
        b->gain_before[i] = b->gain[i];
    }
    follow_speeds(b);
}

/*
 * Corrects offsets and gains by the deviations of taxels at rest; the others become less certain. Only taxels far from a
 * touch say something of gains and noise.
 */
void learn(struct baseline *b, float rustle_share, double passed_s) {
    const struct baseline a = *b; /* no store can change it */
    const double slowly_ = passed_share(passed_s, SLOW_S);
    const float slowly = (float)slowly_, of_noise = (float)(slowly_ / (2 - slowly_));
    const float floor = (float)fmin(passed_s / b->tau_s, 0.5), quick = (float)fmin(passed_s / RESETTLE_S, 0.5);
    const float averages = (float)passed_share(passed_s, WANDER_S);
    const float passed = (float)passed_s, other_side = b->is_signed ? -1.0f : 1.0f;
    const float beside_s = (float)fmax(b->settle_s, 1e-6);
    int64_t number, i;
    for (number = 0; passed_s > 0 && number < b->n_runs; number++) {
        const struct run *run = &b->runs[number];
        const float grows = (float)b->patches[run->patch].drift * (float)passed_s;
        const float load_now = (float)b->patches[run->patch].present, common = (float)b->patches[run->patch].variance;
        const int64_t first = run->first, last = run->last;
        INDEPENDENT
        for (i = first; i < last; i++) {
            const float load = highest(a.deviation[i], a.deviation[i] * other_side);
            const int is_low = !a.is_signed & (a.smooth[i] < -a.off[i]); /* no touch leaves less than 0 */
            const float since_s = is_low ? SETTLED_S : a.since_end_s[i];
            a.flag[i] = (load < a.on[i] ? since_s : 0.0f) >= SETTLED_S;
        }
        INDEPENDENT
        for (i = first; i < last; i++)
            a.flag[i] &= a.live[i] & (a.touched[i] ^ 1) & (a.at_end[i] ^ 1) & (a.sagging[i] ^ 1) & (a.bears[i] ^ 1);
        INDEPENDENT
        for (i = first; i < last; i++) { /* beside a touch a rise may be its load, also one that is not smoothed yet; falls alone would be noise */
            const int rustles = (fabsf(a.smooth[i]) < rustle_share * a.off[i]) & (fabsf(a.deviation[i]) < a.off[i]);
            const int is_measured = (a.settling_s[i] < beside_s) | rustles;
            const float unsure2 = a.gain[i] * a.gain[i] * common, on = a.on[i];
            const int rises = !a.is_signed & (a.smooth[i] > 0.5f * on) & (on < HEATS_ON * load_now) & (unsure2 < a.noise2[i]);
            a.scratch[i] = a.flag[i] & rises ? HEATS * load_now * passed : 0.0f;
            a.flag[i] &= is_measured;
        }
        INDEPENDENT
        for (i = first; i < last; i++) {
            const int is_measured = a.flag[i], is_calm = is_measured & (fabsf(a.smooth[i]) < rustle_share * a.off[i]);
            const float noise2 = a.noise2[i], cross = a.cross[i], variance = a.variance[i] + grows;
            const float total = variance + noise2;
            const float clipped = within(a.deviation[i], DRIFT_SIGMA * sqrtf(total));
            const float innovation = is_measured ? clipped : 0.0f;
            const float slow = a.slow[i], unlike = slow * slow / (noise2 * of_noise + variance);
            const float least = a.used[i] > 0 ? quick : floor, kalman = variance / total;
            const float faster = unlike > DRIFT_SIGMA * DRIFT_SIGMA ? highest(kalman, least) : kalman;
            const float share = is_measured ? faster : 0.0f, keep = 1.0f - share;
            const float of_cross = unlike < 4 * DRIFT_SIGMA * DRIFT_SIGMA ? cross / total : 0.0f;
            const float of_gain = is_calm ? of_cross : 0.0f;
            const float known_s = lowest(a.noise_s[i] + (is_calm ? passed : 0.0f), NOISE_S);
            const float of_square = lowest(passed / known_s, FEWEST);
            const float away = innovation - slow, slower = slow + away * (is_measured ? slowly : 0.0f);
            a.level[i] += share * innovation + lowest(highest(a.deviation[i], 0.0f), a.scratch[i]);
            a.gain[i] += of_gain * innovation;
            a.gain_variance[i] -= of_gain * cross;
            a.cross[i] = cross * keep;
            a.variance[i] = keep * keep * variance + share * share * (is_measured ? noise2 : 0.0f);
            a.slow[i] = slower;
            const float unseen_s = is_measured ? 0.0f : a.unseen_s[i] + passed;
            const float strays = is_measured ? 0.0f : a.own_rate2[i] * passed * (2 * a.unseen_s[i] + passed);
            a.strayed2[i] = keep * keep * a.strayed2[i] + strays;
            a.unseen_s[i] = unseen_s;
            a.speed[i] += (share * innovation / passed - a.speed[i]) * (is_measured & (a.used[i] <= 0) ? averages : 0.0f);
            a.noise2[i] = noise2 + (away * (innovation - slower) - noise2) * (is_calm ? of_square : 0.0f);
            a.noise_s[i] = known_s;
        }
    }
    if (passed_s > 0) {
        b->tick_s += passed_s;
        if (b->tick_s >= TICK_S) {
            tick(b, passed_s);
            b->tick_s = 0;
        }
    }
    if (b->resolution > 0) {
        const float least = least_noise2(b, 0.0f);
        INDEPENDENT
        for (i = 0; i < b->n; i++)
            a.noise2[i] = highest(least, a.noise2[i]);
    } else {
        INDEPENDENT
        for (i = 0; i < b->n; i++)
            a.noise2[i] = highest(least_noise2(b, a.level[i]), a.noise2[i]);
    }
}

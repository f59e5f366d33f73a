/*
 * Find the moment in which a contact begins to slip: its pattern moves by more than noise and load explain. All is in units
 * of the noise. With s, the number of standard deviations by which each taxel of a contact is above its baseline, the
 * centre of the pattern is the mean of the places, weighted by s * s. So weighted, it moves as far as the pattern does, and
 * its standard deviation along an axis is r * sqrt(2 / sum(s * s)) for a pattern of radius r.
 */

#include "contacts.h"

#include <math.h>

#include <string.h>

/* Time constants of two pairs of smoothed centres: a pattern has moved where the two of a pair are apart. */
static const double QUICK_S[2] = {0.003, 0.006}, SLOW_S[2] = {0.02, 0.04};

/* The maximum, or NaN where one is not known. */
static double largest_of(double one, double other) {
    return one != one ? one : other > one || other != other ? other : one;
}

/* Marks contacts that begin again: they merged or split, or taxels of theirs came or went. */
static void mark_others(struct slips *s, const struct contacts *c, int64_t m, const int64_t *identity, uint8_t *is_other) {
    int64_t i, k;
    memset(is_other, 0, (size_t)m);
    for (i = 0; i < s->n; i++) {
        const uint8_t known = isfinite(c->sigmas[i]) != 0;
        const int64_t was = s->was[i], now = s->id_of[i];
        if ((was > 0 && now > 0 && was != now) || ((was > 0 || now > 0) && s->is_known[i] != known))
            for (k = 0; k < m; k++)
                is_other[k] |= identity[k] == was || identity[k] == now;
        s->is_known[i] = known;
    }
}

static int slips_now(const struct pattern *p, double per_load_m, int slipped) {
    int64_t pair, axis;
    for (pair = 0; pair < 2; pair++) {
        const double *spread = &p->spread[3 * pair];
        const double sigma_m = sqrt(largest_of(spread[0] + spread[1] - 2 * spread[2], 0));
        const double creep_m = CREEP_M_S * (SLOW_S[pair] - QUICK_S[pair]);
        const double explained_m = largest_of(creep_m, per_load_m * p->swing);
        double squares = 0;
        for (axis = 0; axis < 3; axis++) {
            const double way = p->quick[3 * pair + axis] - p->slow[3 * pair + axis];
            squares += way * way;
        }
        if (sqrt(squares) > (SLIP_SIGMA * sigma_m + explained_m) * (slipped ? STOPS : 1.0))
            return 1;
    }
    return 0;
}

static void go_on(struct pattern *now, const struct pattern *was, double passed_s, double radius_m) {
    const double load = now->load;
    double slow[2];
    int64_t pair, axis;
    for (pair = 0; pair < 2; pair++) {
        const double q = -expm1(-passed_s / QUICK_S[pair]), w = slow[pair] = -expm1(-passed_s / SLOW_S[pair]);
        const double own[3] = {q * q, w * w, q * w}, kept[3] = {(1 - q) * (1 - q), (1 - w) * (1 - w), (1 - q) * (1 - w)};
        for (axis = 0; axis < 3; axis++) {
            const int64_t at = 3 * pair + axis;
            now->quick[at] = was->quick[at] + q * (now->quick[at] - was->quick[at]);
            now->slow[at] = was->slow[at] + w * (now->slow[at] - was->slow[at]);
            now->spread[at] = kept[axis] * was->spread[at] + own[axis] * now->spread[at];
        }
    }
    now->load = was->load + slow[0] * (load - was->load);
    now->swing = largest_of(was->swing * exp(-passed_s / SETTLES_S), largest_of(fabs(load - now->load) - LOAD_SIGMA, 0));
    now->slips = slips_now(now, radius_m / load, was->slips != 0);
}

/* Watches the patterns of the contacts that are listed, of which each has its row; -1: none. */
void find_slips(struct slips *s, int64_t time_ns, const struct contacts *c, const int64_t *row) {
    const double passed_s = time_ns > s->time_ns ? (double)(time_ns - s->time_ns) / 1e9 : 0;
    double total[MOST], centre[3 * MOST], squares[MOST];
    int64_t identity[MOST], frame[MOST], m = 0, k, axis, *was = s->was;
    struct pattern *before = s->patterns;
    uint8_t is_other[MOST];
    s->time_ns = time_ns;
    for (k = 0; k < c->count; k++) {
        if (row[k] < 0)
            continue;
        identity[row[k]] = c->found->id[k];
        frame[row[k]] = c->found->frame[k];
        m++;
    }
    memset(total, 0, sizeof total);
    memset(centre, 0, sizeof centre);
    memset(squares, 0, sizeof squares);
    s->was = s->id_of;
    s->id_of = was;
    memset(s->id_of, 0, (size_t)s->n * sizeof *s->id_of);
    for (k = 0; k < c->n_touched; k++) {
        const int64_t taxel = c->taxels[k], at = row[c->contact[k]];
        const double sigmas = c->sigmas[taxel];
        if (at < 0 || frame[at] < 0 || frame[at] != c->frame_of[taxel] || !isfinite(sigmas))
            continue;
        s->id_of[taxel] = identity[at];
        total[at] += sigmas * sigmas;
        for (axis = 0; axis < 3; axis++)
            centre[3 * at + axis] += sigmas * sigmas * c->of_taxel[8 * taxel + axis];
    }
    for (k = 0; k < m; k++) {
        total[k] = total[k] > 0 ? total[k] : NAN;
        for (axis = 0; axis < 3; axis++)
            centre[3 * k + axis] /= total[k];
    }
    for (k = 0; k < c->n_touched; k++) {
        const int64_t taxel = c->taxels[k], at = row[c->contact[k]];
        double away = 0;
        if (at < 0 || s->id_of[taxel] == 0)
            continue;
        for (axis = 0; axis < 3; axis++) {
            const double way = c->of_taxel[8 * taxel + axis] - centre[3 * at + axis];
            away += way * way;
        }
        squares[at] += c->sigmas[taxel] * c->sigmas[taxel] * away;
    }
    mark_others(s, c, m, identity, is_other);
    s->patterns = s->before;
    s->before = before;
    for (k = 0; k < m; k++) {
        const double load = sqrt(total[k]), radius_m = largest_of(sqrt(squares[k] / total[k]), s->least_radius_m);
        const double variance = 2 * (radius_m / load) * (radius_m / load);
        struct pattern *p = &s->patterns[k];
        int64_t old = 0;
        p->id = identity[k];
        p->slips = 0;
        for (axis = 0; axis < 6; axis++) {
            p->quick[axis] = p->slow[axis] = centre[3 * k + axis % 3];
            p->spread[axis] = variance;
        }
        p->load = p->swing = load;
        while (old < s->n_patterns && before[old].id != identity[k])
            old++;
        if (old < s->n_patterns && !is_other[k])
            go_on(p, &before[old], passed_s, radius_m);
    }
    s->n_patterns = m;
}

/*
 * Take a uniform field off the values of arrays of three-axis taxels: tests/specification/field.py.
 * A value is level + response * field + load + noise. The field is where most taxels of an array agree: those at rest,
 * or else those whose loads stay as they are.
 */

#include "field.h"

#include "baseline.h"

#include <string.h>

#define FAR 16.0          /* square of the standard deviations of a vector: beyond it, something else moves the taxel */
#define LOADED 4.0        /* the same, by which a load has to explain a value better than rest does */
#define SURE 4.0          /* variances of the noise: a taxel at rest says nothing where its response is known less well */
#define ENOUGH 0.4        /* share of the taxels that have to agree on a field that was searched, and three of them */
#define ROUNDS 4          /* of a fit */
#define MOST_STARTS 8     /* taxels from which a field is searched in a frame */
#define BEGIN_FRAMES 20.0 /* frames in which the noise of a taxel is measured from frame to frame */
#define BEGIN_S 5.0       /* seconds in which a steady load becomes the level: the taxel was covered when it began */
#define MOVED 25.0        /* variances of the noise by which a field has to move to teach; noise would teach wrong responses */
#define LOAD_S 1.0        /* seconds over which a steady load is averaged */
#define SPEED_S 0.1       /* seconds over which the speed of the field is averaged */
#define MEAN_S 10.0       /* seconds over which mean squares are averaged */
#define COAST_S 0.3       /* seconds in which an unseen field slows down, and becomes less expected */
#define LASTS_S 3600.0    /* seconds in which a known response becomes as uncertain as it was */
#define DRIFTS 5e-5       /* variances of the noise that a level gains in a second: its time constant is 20 s at 50 Hz */

enum { NONE, REST, STEADY, ELSE };

SKINWARE_EXPORT void skinware_field_update(struct field *f, const float *values, uint8_t *usable, double passed_s,
                                           float *to);

static double square(const double *v) {
    return v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
}

/* Finds what is left of a value without level and field, and how uncertain that is beside the noise. */
static void compare(struct field *f, int64_t i, const float *values, const double *field) {
    const double *response = f->response + 12 * i, *p = f->covariance + 16 * i, u[4] = {field[0], field[1], field[2], 1};
    double *rest = f->rest + 3 * i, variance = 0;
    int j, k;
    for (k = 0; k < 3; k++) {
        rest[k] = (double)values[k * f->n + i];
        for (j = 0; j < 4; j++)
            rest[k] -= u[j] * response[3 * j + k];
    }
    for (j = 0; j < 4; j++)
        for (k = 0; k < 4; k++)
            variance += u[j] * p[4 * j + k] * u[k];
    f->variance[i] = variance;
}

/* Takes the present value for the level. What the response may be wrong by, the level is wrong by as well. */
static void set_level(struct field *f, int64_t i, const float *values, const double *field) {
    double *p = f->covariance + 16 * i;
    int j, k;
    compare(f, i, values, field);
    p[15] = f->noise2[i];
    for (j = 0; j < 3; j++) {
        f->response[12 * i + 9 + j] += f->rest[3 * i + j];
        p[4 * j + 3] = 0;
        for (k = 0; k < 3; k++)
            p[4 * j + 3] -= p[4 * j + k] * field[k];
        p[12 + j] = p[4 * j + 3];
    }
    for (k = 0; k < 3; k++)
        p[15] -= p[12 + k] * field[k];
}

static void begin_taxel(struct field *f, int64_t i, const float *values, const double *field) {
    int j;
    memset(f->response + 12 * i, 0, 12 * sizeof(double));
    memset(f->covariance + 16 * i, 0, 16 * sizeof(double));
    memset(f->load + 3 * i, 0, 3 * sizeof(double));
    for (j = 0; j < 3; j++) {
        f->response[12 * i + 4 * j] = 1;
        f->covariance[16 * i + 5 * j] = f->spread2;
    }
    f->noise2[i] = (double)TINY * (double)TINY;
    f->frames[i] = f->age_s[i] = f->load_frames[i] = 0;
    set_level(f, i, values, field);
}

/* Compares all taxels of an array with a field, and returns how badly it explains them. */
static double judge(struct field *f, struct array *a, const float *values, const double *field) {
    double total = 0;
    int64_t i;
    int k;
    a->agree = a->at_rest = 0;
    for (i = a->first; i < a->last; i++) {
        double steady[3], known2, of_rest, of_steady = INFINITY;
        if (f->state[i] == NONE)
            continue;
        compare(f, i, values, field);
        known2 = f->known2[i] + f->variance[i];
        of_rest = f->frames[i] < BEGIN_FRAMES ? 0 : square(f->rest + 3 * i) / known2;
        for (k = 0; k < 3; k++)
            steady[k] = f->rest[3 * i + k] - f->load[3 * i + k];
        if (f->load_frames[i] > 0)
            of_steady = LOADED + square(steady) / (known2 + f->known2[i] / (f->load_frames[i] + 1));
        f->cost[i] = fmin(of_rest, of_steady);
        f->state[i] = f->cost[i] >= FAR ? ELSE : of_rest <= of_steady ? REST : STEADY;
        total += fmin(f->cost[i], FAR);
        a->agree += f->state[i] != ELSE;
        a->at_rest += f->state[i] == REST;
    }
    return total;
}

/* Improves a field by the taxels that it explains. */
static void fit(struct field *f, struct array *a, const float *values, double *field) {
    int64_t i;
    int round, k;
    judge(f, a, values, field);
    for (round = 0; round < ROUNDS; round++) {
        double sums[3] = {0, 0, 0}, weights = 0;
        for (i = a->first; i < a->last; i++) {
            const double near = 1 - f->cost[i] / FAR, weight = near * near / (f->known2[i] + f->variance[i]);
            if (f->state[i] == NONE || f->state[i] == ELSE)
                continue;
            for (k = 0; k < 3; k++)
                sums[k] += weight * (f->rest[3 * i + k] - (f->state[i] == STEADY ? f->load[3 * i + k] : 0));
            weights += weight;
        }
        for (k = 0; weights > 0 && k < 3; k++)
            field[k] += sums[k] / weights;
        judge(f, a, values, field);
    }
}

/* Searches a field that explains more taxels than one nearby does: one of those that explain a single taxel. */
static void search(struct field *f, struct array *a, const float *values, double *field) {
    const int64_t step = 1 + (a->last - a->first - 1) / MOST_STARTS;
    double best[3], least = judge(f, a, values, field);
    int64_t i;
    int k, round, steady;
    memcpy(best, field, sizeof best);
    for (i = a->first + a->frames % step; i < a->last; i += step)
        for (steady = 0; steady < 2 && f->state[i] != NONE; steady++) {
            double start[3], total;
            memcpy(start, field, sizeof start);
            for (round = 0; round < 2; round++) {
                compare(f, i, values, start);
                for (k = 0; k < 3; k++)
                    start[k] += f->rest[3 * i + k] - (steady ? f->load[3 * i + k] : 0);
            }
            total = judge(f, a, values, start);
            if (total < least) {
                least = total;
                memcpy(best, start, sizeof best);
            }
        }
    memcpy(field, best, sizeof best);
    fit(f, a, values, field);
}

/* Finds the field of this frame; where too few taxels agree, it goes on as before. Returns whether they do. */
static int find(struct field *f, struct array *a, const float *values, double passed_s, double *field) {
    double expected[3], jump[3], late = 1 + a->lost_s / COAST_S;
    int64_t i;
    int k, found;
    for (k = 0; k < 3; k++)
        field[k] = expected[k] = a->field[k] + a->speed[k] * passed_s;
    fit(f, a, values, field);
    found = a->agree >= 2 && 2 * a->agree >= a->live;
    if ((!found || 2 * a->at_rest < a->live) && a->live > 2) {
        search(f, a, values, field);
        found = a->agree >= 3 && (double)a->agree >= ENOUGH * (double)a->live;
    }
    for (k = 0; k < 3; k++)
        jump[k] = field[k] - expected[k];
    if (found && 2 * a->at_rest < a->live) /* loads that grow alike look like a field, but for its inertia */
        found = square(jump) < FAR * a->jump2 * late * late;
    else if (found)
        a->jump2 += (fmin(square(jump), FAR * a->jump2 + a->noise2) - a->jump2) * passed_share(passed_s, MEAN_S);
    if (found)
        return 1;
    memcpy(field, expected, sizeof expected);
    judge(f, a, values, field);
    for (i = a->first; i < a->last; i++)
        f->state[i] = f->state[i] == NONE ? NONE : ELSE;
    a->at_rest = 0;
    return 0;
}

/* Goes on to the field of this frame; returns whether it is far enough from where responses were learned last. */
static int follow_field(struct array *a, const double *field, int found, double passed_s) {
    const double share = found ? passed_share(passed_s, SPEED_S) : 0, keep = found ? 1 : exp(-passed_s / COAST_S);
    double moved[3];
    int k;
    for (k = 0; k < 3; k++) {
        const double speed = passed_s > 0 ? (field[k] - a->field[k]) / passed_s : 0;
        a->speed[k] = keep * (a->speed[k] + share * (speed - a->speed[k]));
        a->field[k] = field[k];
        moved[k] = field[k] - a->taught_at[k];
    }
    if (found)
        a->speed2 += (square(a->speed) / 3 - a->speed2) * passed_share(passed_s, MEAN_S);
    else
        a->doubt2 += a->speed2 * (2 * a->lost_s + passed_s) * passed_s;
    a->lost_s = found ? 0 : a->lost_s + passed_s;
    if (a->at_rest >= 2 && 2 * a->at_rest >= a->live)
        a->doubt2 = 0;
    if (!found || square(moved) < MOVED * a->noise2)
        return 0;
    memcpy(a->taught_at, field, sizeof a->taught_at);
    return 1;
}

/* Learns the level of a taxel at rest, and while the field moves also its response, by recursive least squares. */
static void teach(struct field *f, int64_t i, const double *field, double doubt2, int moved) {
    const double u[4] = {field[0], field[1], field[2], 1}, total = f->known2[i] + f->variance[i] + doubt2;
    const int first = moved ? 0 : 3;
    double *response = f->response + 12 * i, *p = f->covariance + 16 * i, towards[4] = {0, 0, 0, 0};
    int j, k;
    for (j = 0; j < 4; j++)
        for (k = 0; k < 4; k++)
            towards[j] += p[4 * j + k] * u[k];
    for (j = first; j < 4; j++)
        for (k = 0; k < 3; k++)
            response[3 * j + k] += towards[j] / total * f->rest[3 * i + k];
    for (j = 0; j < 4; j++)
        for (k = 0; k < 4; k++)
            p[4 * j + k] -= j >= first || k >= first ? towards[j] * towards[k] / total : 0;
}

static void follow_noise(struct field *f, const struct array *a, int64_t i, double square_of_all, double share) {
    const double others = (double)(a->live > 1 ? a->live - 1 : 1) / (double)(a->live > 1 ? a->live : 1);
    f->noise2[i] += (square_of_all / 3 / others - f->noise2[i]) * share; /* a taxel pulls the field to itself */
}

/* Follows what else is in a value: steady loads are averaged, others are new in each frame. */
static void follow_load(struct field *f, int64_t i, double passed_s) {
    const double share = fmax(1 / (f->load_frames[i] + 1), fmin(passed_s / LOAD_S, 1));
    int k;
    for (k = 0; k < 3; k++) {
        double *load = f->load + 3 * i + k;
        *load += (f->rest[3 * i + k] - *load) * (f->state[i] == STEADY ? share : 1);
    }
    f->load_frames[i] = f->state[i] == STEADY ? f->load_frames[i] + 1 : f->state[i] == ELSE;
}

static void follow_taxel(struct field *f, struct array *a, int64_t i, const float *values, int moved, double doubt2,
                         double passed_s) {
    const int most_rest = 2 * a->at_rest >= a->live;
    double *p = f->covariance + 16 * i, change[3];
    int k;
    for (k = 0; k < 3; k++)
        change[k] = f->rest[3 * i + k] - f->load[3 * i + k];
    f->age_s[i] += passed_s;
    f->frames[i] += 1;
    if (f->frames[i] <= BEGIN_FRAMES) {
        if (f->frames[i] > 1)
            follow_noise(f, a, i, square(change) / 2, 1 / (f->frames[i] - 1));
        if (f->frames[i] == BEGIN_FRAMES)
            set_level(f, i, values, a->field);
    } else if (f->state[i] == REST && most_rest) {
        const double of_noise = f->known2[i] / (f->known2[i] + f->variance[i]);
        follow_noise(f, a, i, square(f->rest + 3 * i) * of_noise, fmin(passed_s / NOISE_S, 1));
        teach(f, i, a->field, doubt2, moved);
    }
    if (f->state[i] == STEADY && most_rest && f->age_s[i] < BEGIN_S)
        set_level(f, i, values, a->field);
    else
        follow_load(f, i, passed_s);
    for (k = 0; k < 3; k++)
        p[5 * k] += fmax(f->spread2 - p[5 * k], 0) * passed_s / LASTS_S;
    p[15] += DRIFTS * f->noise2[i] * passed_s;
}

static void step_array(struct field *f, struct array *a, const float *values, double passed_s) {
    double field[3], doubt2 = 0;
    int64_t i;
    int moved;
    a->live = 0;
    a->noise2 = 0;
    a->frames++;
    for (i = a->first; i < a->last; i++) {
        a->live += f->state[i] != NONE;
        a->noise2 += f->noise2[i] / (double)(a->last - a->first);
    }
    for (i = a->first; i < a->last; i++) /* else the quietest taxel alone would be right */
        f->known2[i] = fmax(f->noise2[i], a->noise2);
    if (!a->live)
        return;
    moved = find(f, a, values, passed_s, field);
    moved = follow_field(a, field, moved, passed_s);
    for (i = a->first; i < a->last; i++)
        doubt2 += f->state[i] != NONE ? f->variance[i] / (double)a->live : 0;
    for (i = a->first; i < a->last; i++)
        if (f->state[i] != NONE)
            follow_taxel(f, a, i, values, moved, doubt2, passed_s);
}

/*
 * Takes the field off (3, n) values, and writes (3, n) the rest. Clears those of the (n,) usable ones that are too uncertain
 * to say whether something touches their taxel.
 */
void skinware_field_update(struct field *f, const float *values, uint8_t *usable, double passed_s, float *to) {
    int64_t number, i;
    int k;
    for (number = 0; number < f->n_arrays; number++) {
        struct array *a = &f->arrays[number];
        for (k = 0; k < 3; k++)
            a->speed[k] = passed_s < 1 ? a->speed[k] : 0;
        for (i = a->first; i < a->last; i++) {
            f->away_s[i] += passed_s;
            f->state[i] = usable[i] ? ELSE : NONE;
            if (usable[i] && !(f->away_s[i] < f->forget_after_s))
                begin_taxel(f, i, values, a->field);
            f->away_s[i] = usable[i] ? 0 : f->away_s[i];
        }
        step_array(f, a, values, passed_s);
        for (i = a->first; i < a->last; i++) {
            const double doubt2 = f->variance[i] + a->doubt2, far2 = FAR * (doubt2 + f->known2[i]);
            const int bears = f->age_s[i] > BEGIN_S && square(f->rest + 3 * i) > far2;
            f->bears[i] = square(f->rest + 3 * i) > far2 && f->frames[i] > BEGIN_FRAMES && f->state[i] != NONE;
            usable[i] &= f->frames[i] > BEGIN_FRAMES && (bears || doubt2 < SURE * f->known2[i]);
            for (k = 0; k < 3; k++)
                to[k * f->n + i] = f->state[i] == NONE ? 0 : (float)f->rest[3 * i + k];
        }
    }
}

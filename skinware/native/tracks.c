/* Follow the tracks of contacts, each by itself: tests/specification/tracks.py. */

#include "baseline.h"

#define LONGEST_GUESS_S 0.1     /* for which a velocity is extrapolated */
#define ACCELERATION_M_S2 0.5   /* spread of the acceleration of a slow contact */
#define MANOEUVRE_S 0.1         /* time in which a fast one changes its velocity */
#define SURPRISE 3.0            /* standard deviations of a miss that is a change of the velocity */
#define SHORTEST_S 1e-3
#define CALM 3.0                /* time constant of the motion that is judged as sliding, in multiples of velocity_s */
#define NARROWEST_PITCHES 0.35  /* width of a contact that only one taxel feels */
#define TWO_PI 6.283185307179586

enum { TOUCH, HOLD, SLIDING }; /* skinware/tactile/tracking.py: ContactKind */

struct track { /* skinware/tactile/tracks.py: TRACK */
    int64_t key, id, born_ns, gone_ns, seen_ns, frames, steps, size, frame, home, kind;
    double place[3], pace[3], spread[3], found[3], velocity[3], motion[3];
    double now, height, load, peak, width, noise;
    uint8_t sure, shared, jumps;
};

SKINWARE_EXPORT void skinware_tracks_expect(struct track *tracks, int64_t n, int64_t time_ns);
SKINWARE_EXPORT void skinware_tracks_correct(struct track *tracks, int64_t m, const int64_t *rows, int64_t time_ns);
SKINWARE_EXPORT void skinware_tracks_move(struct track *tracks, int64_t n, const struct track *before, double velocity_s);
SKINWARE_EXPORT void skinware_tracks_judge(struct track *tracks, int64_t n, const struct track *before, int64_t n_before,
                                           int64_t time_ns, const double *settings);

static double squares_of(const double *vector) {
    return vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2];
}

/* Moves tracks to where they are expected at a time: places and spreads go on with the velocities. */
void skinware_tracks_expect(struct track *tracks, int64_t n, int64_t time_ns) {
    int64_t i, axis;
    for (i = 0; i < n; i++) {
        struct track *t = &tracks[i];
        const double passed_s = fmin(fmax((double)(time_ns - t->seen_ns) / 1e9, 0), LONGEST_GUESS_S);
        const double change = (ACCELERATION_M_S2 + sqrt(squares_of(t->pace)) / MANOEUVRE_S) * passed_s;
        const double both = t->spread[1], variance = t->spread[2];
        for (axis = 0; axis < 3; axis++)
            t->place[axis] += passed_s * t->pace[axis];
        t->spread[0] += passed_s * (2 * both + passed_s * (variance + change * change / 4));
        t->spread[1] += passed_s * (variance + change * change / 2);
        t->spread[2] += change * change;
    }
}

/* Takes in where m tracks were found, instead of where they were expected. */
void skinware_tracks_correct(struct track *tracks, int64_t m, const int64_t *rows, int64_t time_ns) {
    int64_t k, axis;
    for (k = 0; k < m; k++) {
        struct track *t = &tracks[rows[k]];
        const double passed_s = fmax((double)(time_ns - t->seen_ns) / 1e9, SHORTEST_S);
        const double miss[3] = {t->found[0] - t->place[0], t->found[1] - t->place[1], t->found[2] - t->place[2]};
        const double squares = squares_of(miss);
        double variance = isinf(t->spread[0]) ? 1.0 : t->spread[0]; /* m2: nothing is known */
        double both = t->spread[1], pace = t->spread[2], surprise, gain, pull;
        surprise = squares > SURPRISE * SURPRISE * (variance + t->noise) && !t->jumps ? squares : 0;
        variance += surprise;
        both += surprise / passed_s;
        pace += surprise / (passed_s * passed_s);
        gain = variance / (variance + t->noise);
        pull = t->jumps ? 0 : both / (variance + t->noise);
        for (axis = 0; axis < 3; axis++) {
            t->place[axis] += gain * miss[axis];
            t->pace[axis] += pull * (isnan(miss[axis]) ? 0 : miss[axis]);
        }
        t->spread[0] = gain * t->noise;
        t->spread[1] = both * (1 - gain);
        t->spread[2] = pace + (surprise / (passed_s * passed_s) - pull * both); /* what changed once changes again */
    }
}

/* Updates velocities that are published; they stay where contacts merge or split, as their centres jump. */
void skinware_tracks_move(struct track *tracks, int64_t n, const struct track *before, double velocity_s) {
    int64_t i, axis;
    for (i = 0; i < n; i++) {
        struct track *t = &tracks[i];
        const struct track *was = &before[i];
        const double passed_s = (double)(t->seen_ns - was->seen_ns) / 1e9;
        double weight;
        if (t->home < 0 || passed_s <= 0 || t->frame != was->frame || t->shared != was->shared || t->jumps)
            continue;
        t->steps++;
        weight = fmax(passed_share(passed_s, velocity_s), 1 / (double)t->steps);
        for (axis = 0; axis < 3; axis++) {
            const double velocity = isnan(t->velocity[axis]) ? 0 : t->velocity[axis];
            t->velocity[axis] = velocity + weight * ((t->found[axis] - was->found[axis]) / passed_s - velocity);
        }
    }
}

/* Updates what is smoothed, and the kinds. Settings: velocity_s, touch_s, sliding_m_s, steady, and the pitch, m. */
void skinware_tracks_judge(struct track *tracks, int64_t n, const struct track *before, int64_t n_before, int64_t time_ns,
                           const double *settings) {
    const double velocity_s = settings[0], touch_s = settings[1], sliding_m_s = settings[2], steady = settings[3];
    const double pitch_m = settings[4];
    int64_t i, axis;
    for (i = 0; i < n; i++) {
        struct track *t = &tracks[i];
        const int is_new = i >= n_before;
        const double passed_s = !is_new && time_ns > before[i].seen_ns ? (double)(time_ns - before[i].seen_ns) / 1e9 : 0;
        const double weight = is_new ? 1 : passed_share(passed_s, velocity_s);
        const double alone = t->shared ? 0 : fmax(weight, 1 / fmax((double)t->frames, 1));
        const double calm = passed_share(passed_s, CALM * velocity_s);
        const double measured = pitch_m * sqrt(t->now / (TWO_PI * fmax(t->height, 1e-9)));
        int is_sliding;
        if (t->home < 0)
            continue;
        t->load += weight * (t->now - t->load);
        t->peak += alone * (t->height - t->peak);
        t->width += alone * (fmax(measured, NARROWEST_PITCHES * pitch_m) - t->width);
        for (axis = 0; axis < 3; axis++)
            t->motion[axis] += calm * ((isnan(t->velocity[axis]) ? 0 : t->velocity[axis]) - t->motion[axis]);
        is_sliding = fabs(t->now - t->load) <= steady * t->load;
        is_sliding &= sqrt(squares_of(t->motion)) >= (t->kind == SLIDING ? sliding_m_s / 2 : sliding_m_s);
        t->kind = (double)(time_ns - t->born_ns) < touch_s * 1e9 ? TOUCH : is_sliding ? SLIDING : HOLD;
    }
}

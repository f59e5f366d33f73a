/*
 * A uniform field that rigid arrays of three-axis taxels feel: what is known of arrays and taxels. docs/tactile/turning.md
 * has the formulas. Python makes its structs from this header (structs.py), so every field has 8 bytes.
 */

#ifndef SKINWARE_NATIVE_FIELD_H
#define SKINWARE_NATIVE_FIELD_H

#include <stdint.h>

struct array { /* taxels that turn together */
    int64_t first, last;
    double field[3], speed[3]; /* since the beginning, and its change in a second */
    double speed2;             /* mean square of that, along an axis */
    double jump2;              /* mean square of the difference between field and expected field */
    double doubt2;             /* variance of the field by the time in which no taxels agreed on it */
    double lost_s;             /* how long they have not */
    double taught_at[3];       /* the field in which responses were learned last */
    double noise2;             /* typical for its taxels */
    int64_t live, agree, at_rest; /* taxels of this frame: with values, that agree on the field, and those at rest */
    int64_t frames;
};

struct field {
    int64_t n, n_arrays;
    double spread2;        /* variance of the responses of taxels, around 1 */
    double forget_after_s; /* without data: then a taxel begins again */
    struct array *arrays;
    double *response;           /* (n, 4, 3): to the field along each axis, and the value without it */
    double *covariance;         /* (n, 4, 4) of these, alike for the three axes */
    double *noise2, *frames;
    double *age_s, *away_s;     /* since a taxel began, and since its last value */
    double *load, *load_frames; /* (n, 3) what else is in a value, and for how many frames it has been there */

    /* of this frame: (n, 3) value without level and field, how uncertain that is, the noise, and how far it is from both */
    double *rest, *variance, *known2, *cost;
    int64_t *state;
    uint8_t *bears; /* (n,) which bear a load */
};

#endif

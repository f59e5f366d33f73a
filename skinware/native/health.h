/* Evidence of the health of taxels that every frame gives. Python makes its struct from this header (structs.py). */

#ifndef SKINWARE_NATIVE_HEALTH_H
#define SKINWARE_NATIVE_HEALTH_H

#include <stdint.h>

#define CLEAR 8.0f       /* times the noise: a touch this high is no flicker */
#define HARD 0.25f       /* share of what a taxel usually shows at most: less is the rest of a touch, and no other touch */
#define PLAIN 24.0       /* times the noise: weaker touches do not show whether two taxels are the same */
#define KEPT 0.95f       /* weight that older touches keep with each new one */
#define STILL_FRAMES 5   /* frames without a large change before a value is lost: noise is large in each */

struct health {
    int64_t n;
    double least, most; /* ends of the range */
    double clear;       /* a touch above it is clear, whatever the noise of its taxel */

    float *given;       /* of this frame, and what the baseline made of it */
    float *load, *baseline, *noise;
    uint8_t *calm_touched, *usable;

    float *value, *peak, *usual; /* the newest value; the most that a touch showed, and less of it with each touch */
    double *changed_s;           /* when the value changed; time without data does not count */
    uint8_t *seen, *touched, *misled;
    float *sums;                 /* (3, n): of squared differences, frames, and frames at an end, of taxels at rest */
    float *total;                /* of values, NaN where one was missing */
    uint8_t *was_free;
    int64_t *still;              /* frames since the last large change */

    float *far, *jump, *above;   /* from far on, a difference is no noise; jump: from the value before */
    uint8_t *at_end, *was_still, *moved, *begun, *hard, *plain;
};

#endif

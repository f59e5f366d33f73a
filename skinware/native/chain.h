/*
 * Signals of a chain, and the loads in which contacts are found. Python makes its structs from this header (structs.py), so
 * every field has 8 bytes.
 */

#ifndef SKINWARE_NATIVE_CHAIN_H
#define SKINWARE_NATIVE_CHAIN_H

#include <stdint.h>

#define ABOVE_SIGMA 5.0f /* standard deviations of its noise by which a taxel must be above its baseline for an onset */
#define ONSET_STEPS 2.0f /* steps of the values: the least height of an onset */

struct signal { /* one frame of n taxels of a type on its way through the stages */
    int64_t n;
    int64_t *index; /* where they stand in a snapshot */
    float *values, *deviation;
    uint8_t *usable, *jumped, *forced, *unknown, *bears;
    uint8_t *suspect; /* in the frame before */
};

struct chain {
    int64_t n, n_signals, has_before;
    struct signal **signals;
    float *values;   /* (n,) of a snapshot: those of the driver, then those behind the chain */
    uint8_t *status; /* the same */
};

struct axis { /* what a baseline made of n taxels; of a vector there are three */
    int64_t *index;
    float *given, *baseline, *uncertainty, *noise;
    uint8_t *touched, *usable;
};

struct loads {
    int64_t n, n_axes;
    struct axis *axes;
    double resolution, maximum;
    float *load, *doubt, *sigmas, *above;
    uint8_t *touched, *onset, *clipped, *known;
    uint8_t *was, *was_before; /* above, in the two frames before */
};

#endif

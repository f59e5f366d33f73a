/*
 * Contacts of the taxels of one sensor type, as they are found, measured and listed. Python makes its structs from this
 * header (structs.py), so every field has 8 bytes.
 */

#ifndef SKINWARE_NATIVE_CONTACTS_H
#define SKINWARE_NATIVE_CONTACTS_H

#include <stdint.h>

#define MOST 64            /* contacts of a frame; of more, those with the largest loads are kept */
#define CLEARLY 1.5        /* a contact must have so many times the load of one that is in the list to take its place */
#define LEAST_SHARE 0.1    /* share of the newest frame in the value of a taxel that is just touched */
#define LEAST_SEEN 0.5     /* least share of a load that must be above the threshold, for an estimate */
#define MOST_CUT 0.6       /* largest share of clipped taxels, for the same */
#define CLEAR 4.0          /* uncertainties of a value that speaks for a contact: between those of a touch's begin and end */

#define SLIP_SIGMA 5.0     /* standard deviations of its noise by which a pattern must have moved: by chance once an hour */
#define CREEP_M_S 0.0005   /* speed of a pattern whose object creeps or whose elastomer settles */
#define SETTLES_S 0.15     /* time constant for which a change of the load may move the pattern */
#define LOAD_SIGMA 3.0     /* standard deviations by which a load must differ to have changed */
#define STOPS 0.5          /* share of the limit below which a contact no longer slips */

struct components {
    int64_t n, width, n_modules;
    int32_t *forward;  /* (n, width): neighbours with higher numbers; -1: none */
    int64_t *module;   /* of a taxel without neighbours, from 0; -1: it hangs together with no other */
    int64_t *first;    /* of each module, in a frame */
    int64_t *root, *number;
};

struct pattern { /* of a contact that may slip */
    int64_t id, slips;
    double quick[6], slow[6];  /* two pairs of smoothed centres */
    double spread[6];          /* variances of quick, of slow, and of both together, along an axis */
    double load, swing;        /* smoothed; by how much the load has changed of late */
};

struct slips {
    int64_t n, n_patterns, time_ns;
    double least_radius_m;
    struct pattern *patterns, *before; /* (MOST,) each */
    int64_t *id_of, *was;              /* of the contact of each taxel; 0: none */
    uint8_t *is_known;
};

struct found { /* the contacts of a frame, before they are listed */
    double *load, *peak, *area_m2, *force_n, *load_whole, *uncertainty, *clipped;
    double *cop_m, *normal;
    int64_t *n, *frame, *frames; /* frames: how many frames speak for it; 0: its values are not clear */
    uint8_t *is_sure;
    int64_t *id, *kind; /* from here on as the tracks say */
    double *age_s, *velocity_m_s;
    uint8_t *provisional;
};

struct listed { /* the same, as they are published */
    uint32_t *id, *n, *clipped;
    float *age_s, *load, *peak, *area_m2, *force_n, *load_whole, *uncertainty, *cop_m, *normal, *velocity_m_s;
    int16_t *frame;
    uint8_t *kind, *slips, *provisional;
};

struct contacts {
    int64_t n, is_newtons, is_pascals;
    double least; /* value of a taxel that is just touched; 0: none was seen yet */
    struct components *components;
    struct slips *slipping;
    struct found *found;
    struct listed *listed;
    double *of_taxel;   /* (n, 8): place, normal, area, and whether that is known */
    int64_t *frame_of;  /* coordinate frame of each taxel; -1: not known */
    int64_t *track_of;  /* the track that each was last in; -1: none */

    int64_t has_onset, has_clipped, has_uncertainty, has_sigmas; /* of this frame */
    double *value, *uncertainty, *sigmas;
    uint8_t *touched, *onset, *clipped;

    int64_t n_touched, count, beyond;
    int64_t *taxels, *contact; /* the touched ones, and the contact of each */
    double *load_of;
    double *sums;              /* of contacts, while there may be more than MOST */
    uint8_t *was_listed;
};

int64_t find_components(struct components *c, int64_t m, const int64_t *taxels, int64_t *component);
void find_slips(struct slips *s, int64_t time_ns, const struct contacts *c, const int64_t *row);

#endif

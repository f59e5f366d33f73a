/* The contacts of a simulated scene, and the forces that taxels feel by them: touching.c. */
#ifndef SKINWARE_DRIVERS_TOUCHING_H
#define SKINWARE_DRIVERS_TOUCHING_H

#include "../../skinware/native/ring.h" /* before any system header */

struct touching {
    int64_t n_modules, n_geoms, n_taxels, n_sensors;
    uint8_t *feels;                       /* (n_modules, n_geoms) */
    int64_t *first;                       /* (n_modules + 1,): taxels of each module */
    int64_t *body, *root;                 /* of each geom; of each body */
    int64_t *sensor_module, *sensor_at;   /* of each sensor; where its depths are in the data of sensors */
    double *reach_m, *position_m, *axes;  /* of modules; (n_taxels, 3), (n_taxels, 3, 3) in the frame of their body */
    double *xpos, *xmat, *cvel, *com, *sensordata; /* MuJoCo's */
    int64_t *geom;                        /* (n, 2) of each contact */
    double *place, *frame, *force;        /* (n, 3), (n, 9), (n, 6) of each contact */
    int64_t *module;                      /* of each touch: a contact that a module feels; from here on found */
    double *point_m, *normal, *normal_n, *shear_n, *slip_m_s;
    double *distance_m, *weight, *depth_m; /* of taxels, for a while */
    int64_t *touch;
    double *felt_n;                       /* (n_taxels, 3): shear along x and y, normal force */
};

SKINWARE_EXPORT int64_t skinware_touching_find(struct touching *t, int64_t n);
SKINWARE_EXPORT void skinware_touching_spread(struct touching *t, int64_t n);

#endif

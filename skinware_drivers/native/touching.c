/* Contacts of a simulated scene that taxels feel, and how their forces are spread: tests/specification/touching.py. */
#include "touching.h"

#include <math.h>
#include <string.h>

#define SAME_WAY (0.5 + 1e-9) /* cosine of the largest angle between a contact's normal and that of a taxel that feels it */
enum { NEAREST = 4 };         /* taxels that share the force of a contact which none of them reaches into */

static double dot(const double *one, const double *other)
{
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2];
}

/* Brings a vector of the world into the frame of a body. */
static void into(double *to, const double *rotation, const double *vector, double sign)
{
    int64_t k;
    for (k = 0; k < 3; k++)
        to[k] = sign * (vector[0] * rotation[k] + vector[1] * rotation[3 + k] + vector[2] * rotation[6 + k]);
}

static double distance_m(const struct touching *t, int64_t taxel, const double *point_m, const double *normal)
{
    const double *at = t->position_m + 3 * taxel;
    const double x = at[0] - point_m[0], y = at[1] - point_m[1], z = at[2] - point_m[2];
    return dot(normal, t->axes + 9 * taxel + 6) < SAME_WAY ? INFINITY : sqrt(x * x + y * y + z * z);
}

static void velocity(const struct touching *t, int64_t body, const double *place, double *to)
{
    const double *turning = t->cvel + 6 * body, *moving = turning + 3, *com = t->com + 3 * t->root[body];
    const double x = place[0] - com[0], y = place[1] - com[1], z = place[2] - com[2];
    to[0] = moving[0] + (turning[1] * z - turning[2] * y);
    to[1] = moving[1] + (turning[2] * x - turning[0] * z);
    to[2] = moving[2] + (turning[0] * y - turning[1] * x);
}

/* Returns the module with the nearest taxel within its reach; -1: none feels it. */
static int64_t module_of(const struct touching *t, int64_t geom, const double *point_m, const double *normal)
{
    double nearest_m = INFINITY;
    int64_t found = -1, module, taxel;
    for (module = 0; module < t->n_modules; module++) {
        double reach_m = INFINITY;
        if (!t->feels[module * t->n_geoms + geom])
            continue;
        for (taxel = t->first[module]; taxel < t->first[module + 1]; taxel++)
            reach_m = fmin(reach_m, distance_m(t, taxel, point_m, normal));
        if (reach_m <= t->reach_m[module] && reach_m < nearest_m) {
            nearest_m = reach_m;
            found = module;
        }
    }
    return found;
}

/* Finds the touches among n contacts, each felt at either of its sides, in the frame of the body that feels it. */
int64_t skinware_touching_find(struct touching *t, int64_t n)
{
    int64_t found = 0, i, side, k;
    for (i = 0; i < n; i++) {
        const double *place = t->place + 3 * i, *frame = t->frame + 9 * i, *force = t->force + 6 * i;
        for (side = 0; side < 2; side++) {
            const int64_t geom = t->geom[2 * i + side], body = geom < 0 ? 0 : t->body[geom];
            const double *rotation = t->xmat + 9 * body, *from = t->xpos + 3 * body, sign = side ? 1.0 : -1.0;
            double *point_m = t->point_m + 3 * found, *normal = t->normal + 3 * found, one[3], other[3], way[3], shear[3];
            if (geom < 0)
                continue;
            for (k = 0; k < 3; k++) {
                way[k] = place[k] - from[k];
                shear[k] = force[1] * frame[3 + k] + force[2] * frame[6 + k];
            }
            into(point_m, rotation, way, 1.0);
            into(normal, rotation, frame, -sign);
            t->module[found] = module_of(t, geom, point_m, normal);
            if (t->module[found] < 0)
                continue;
            into(t->shear_n + 3 * found, rotation, shear, sign);
            t->normal_n[found] = force[0];
            velocity(t, t->body[t->geom[2 * i]], place, one);
            velocity(t, t->geom[2 * i + 1] < 0 ? 0 : t->body[t->geom[2 * i + 1]], place, other);
            for (k = 0; k < 3; k++)
                way[k] = one[k] - other[k];
            t->slip_m_s[found++] = hypot(dot(frame + 3, way), dot(frame + 6, way));
        }
    }
    return found;
}

/* Gives the nearest few taxels of a module a share in a touch that none of them reaches into; returns their sum. */
static double share_out(struct touching *t, int64_t touch, int64_t first, int64_t end)
{
    double total = 0;
    int64_t left, taxel;
    for (left = NEAREST; left; left--) {
        double least_m = INFINITY;
        int64_t nearest = -1;
        for (taxel = first; taxel < end; taxel++) {
            const double away_m = distance_m(t, taxel, t->point_m + 3 * touch, t->normal + 3 * touch);
            if (away_m < least_m && t->weight[taxel] == 0) {
                least_m = away_m;
                nearest = taxel;
            }
        }
        if (nearest < 0)
            break;
        total += t->weight[nearest] = 1 / (least_m + 1e-6);
    }
    return total;
}

static void spread_touch(struct touching *t, int64_t touch)
{
    const int64_t first = t->first[t->module[touch]], end = t->first[t->module[touch] + 1];
    double total = 0;
    int64_t taxel, k;
    for (taxel = first; taxel < end; taxel++)
        total += t->weight[taxel] = t->touch[taxel] == touch ? fmax(0, t->depth_m[taxel]) : 0;
    if (total == 0)
        total = share_out(t, touch, first, end);
    for (taxel = first; taxel < end; taxel++) {
        const double share = t->weight[taxel] / total;
        if (share > 0) {
            for (k = 0; k < 2; k++)
                t->felt_n[3 * taxel + k] += share * dot(t->axes + 9 * taxel + 3 * k, t->shear_n + 3 * touch);
            t->felt_n[3 * taxel + 2] += share * t->normal_n[touch];
        }
    }
}

/* Spreads the force of each of n touches over the taxels that are nearest to it, in proportion to their depth. */
void skinware_touching_spread(struct touching *t, int64_t n)
{
    int64_t touch, taxel, sensor;
    memset(t->felt_n, 0, (size_t)(3 * t->n_taxels) * sizeof *t->felt_n);
    if (n == 0)
        return;
    memset(t->depth_m, 0, (size_t)t->n_taxels * sizeof *t->depth_m);
    for (sensor = 0; sensor < t->n_sensors; sensor++) {
        const int64_t first = t->first[t->sensor_module[sensor]], end = t->first[t->sensor_module[sensor] + 1];
        for (taxel = first; taxel < end; taxel++)
            t->depth_m[taxel] += t->sensordata[t->sensor_at[sensor] + taxel - first];
    }
    for (taxel = 0; taxel < t->n_taxels; taxel++) {
        t->distance_m[taxel] = INFINITY;
        t->touch[taxel] = -1;
    }
    for (touch = 0; touch < n; touch++)
        for (taxel = t->first[t->module[touch]]; taxel < t->first[t->module[touch] + 1]; taxel++) {
            const double away_m = distance_m(t, taxel, t->point_m + 3 * touch, t->normal + 3 * touch);
            if (away_m < t->distance_m[taxel]) {
                t->distance_m[taxel] = away_m;
                t->touch[taxel] = touch;
            }
        }
    for (touch = 0; touch < n; touch++)
        spread_touch(t, touch);
}

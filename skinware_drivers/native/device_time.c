/* A device's stamps on CLOCK_MONOTONIC, when a sample was taken: tests/specification/device_time.py.
 *
 * The device may also be the controller of a CAN interface, whose frames are received when the kernel stamps them. A
 * frame is received some time after it was stamped, never before. The shortest delay varies little, while USB and busy
 * computers add milliseconds to many frames and half a second to a few. So the line that lies under all points (stamp,
 * time of receipt), and as close to them as possible, gives the rate of the device's clock, and its offset up to the
 * shortest delay (S. B. Moon, P. Skelly, D. Towsley, "Estimation and Removal of Clock Skew from Network Delay
 * Measurements", 1999). Late frames do not move it.
 */
#include "inside.h"

#include <math.h>

/* A shorter window follows changes of temperature faster, a longer one is steadier. The offset is the least delay of the
 * recent parts in which frames came, so that delayed frames are known as late, also after a pause. Before points span
 * the least span, the device's clock is assumed to run like CLOCK_MONOTONIC. */
enum { RECENT_PARTS = 10, LEAST_SPAN_PARTS = 2 };
#define MOST_DRIFT 500e-6 /* of a device's clock */
/* If all stamps of a part lie further in the past, the device's clock stands still: after a delay of the line or of this
 * machine, frames without delay follow at once. */
#define FAR_BEHIND_NS 1e9

static double line_ns(const struct device_clock *clock, double device_ns)
{
    return clock->offset_ns + clock->drift * device_ns;
}

static double above_ns(const struct device_clock *clock, const struct clock_point *point)
{
    return point->delay_ns - clock->drift * point->device_ns;
}

static void begin(struct device_clock *clock, int64_t stamp, int64_t received_ns)
{
    clock->n_points = clock->ticks = 0;
    clock->origin_ns = clock->received_ns = received_ns;
    clock->stamp = stamp;
    clock->drift = clock->offset_ns = 0;
}

/* The corners of the line under all whole parts, from left to right; how many. */
static int64_t find_hull(const struct clock_point *points, int64_t n, const struct clock_point **hull)
{
    int64_t n_hull = 0;
    for (const struct clock_point *point = points; point < points + n; point++) {
        while (n_hull > 1) {
            const struct clock_point *one = hull[n_hull - 2], *other = hull[n_hull - 1];
            if ((other->delay_ns - one->delay_ns) * (point->device_ns - one->device_ns) <
                (other->device_ns - one->device_ns) * (point->delay_ns - one->delay_ns))
                break;
            n_hull--; /* it lies on or above the line from the one before to this one */
        }
        hull[n_hull++] = point;
    }
    return n_hull;
}

static void fit_slope(struct device_clock *clock)
{
    const struct clock_point *points = clock->points, *hull[CLOCK_PARTS];
    int64_t n = clock->n_points - 1, right = 1; /* the best point of the newest part may be yet to come */
    double sum = 0;
    if (n < 2 || points[n - 1].device_ns - points[0].device_ns < (double)(LEAST_SPAN_PARTS * clock->part_ns))
        return;
    int64_t n_hull = find_hull(points, n, hull);
    for (int64_t i = 0; i < n; i++)
        sum += points[i].device_ns;
    while (right < n_hull - 1 && hull[right]->device_ns < sum / (double)n)
        right++;
    const struct clock_point *one = hull[right - 1], *other = hull[right];
    double slope = (other->delay_ns - one->delay_ns) / (other->device_ns - one->device_ns);
    clock->drift = slope < -MOST_DRIFT ? -MOST_DRIFT : slope > MOST_DRIFT ? MOST_DRIFT : slope;
}

static void find_offset(struct device_clock *clock)
{
    const struct clock_point *newest = &clock->points[clock->n_points - 1];
    int64_t n = clock->n_points < RECENT_PARTS ? clock->n_points : RECENT_PARTS;
    clock->offset_ns = above_ns(clock, newest);
    for (const struct clock_point *point = newest; point > newest - n; point--)
        if (point->part > newest->part - CLOCK_PARTS && above_ns(clock, point) < clock->offset_ns)
            clock->offset_ns = above_ns(clock, point);
}

/* Keep the point of least delay of each part, and the line under them. */
static void learn(struct device_clock *clock, const struct clock_point *point)
{
    struct clock_point *points = clock->points;
    if (!clock->n_points || points[clock->n_points - 1].part != point->part) {
        if (clock->n_points == CLOCK_PARTS)
            memmove(points, points + 1, (size_t)--clock->n_points * sizeof *points);
        points[clock->n_points++] = *point;
        fit_slope(clock);
    } else if (above_ns(clock, point) < above_ns(clock, &points[clock->n_points - 1]))
        points[clock->n_points - 1] = *point;
    else
        return;
    find_offset(clock);
}

/* Counts since the stamp before, with as many turns as fit the time that has passed. */
static int64_t step_to(const struct device_clock *clock, int64_t stamp, int64_t received_ns)
{
    int64_t difference = stamp - clock->stamp;
    double passed = (double)(received_ns - clock->received_ns) / clock->unit_ns;
    return difference + (int64_t)rint((passed - (double)difference) / (double)clock->modulo) * clock->modulo;
}

/* Whether the newest whole part shows that the clock stands still, or is far too slow. */
static bool stands_still(const struct device_clock *clock)
{
    return clock->n_points > 1 &&
           above_ns(clock, &clock->points[clock->n_points - 2]) - clock->offset_ns > FAR_BEHIND_NS;
}

/* Whether a clock that stood still has gone at half its speed, at least, for a part. */
static bool goes_again(struct device_clock *clock, int64_t stamp, int64_t received_ns)
{
    double gone_ns = (double)step_to(clock, stamp, received_ns) * clock->unit_ns;
    if (received_ns - clock->received_ns < clock->part_ns)
        return false;
    clock->is_still = 2 * gone_ns < (double)(received_ns - clock->received_ns);
    clock->received_ns = received_ns;
    clock->stamp = clock->is_still ? stamp : -1;
    return !clock->is_still;
}

/* When a frame was stamped, CLOCK_MONOTONIC ns: never after its receipt, and never before the frame before.
 *
 * A gap in the stream, or the delay of a frame, may be as long as half the time in which the stamps wrap around. After a
 * restart (a stamp that goes back, or that lies in the future) or a stop, all that is known of the clock is discarded;
 * while it stands still, frames get the time of their receipt.
 */
static int64_t convert(struct device_clock *clock, int64_t stamp, int64_t received_ns)
{
    if (clock->is_still && !goes_again(clock, stamp, received_ns))
        return clock->last_ns = received_ns;
    if (clock->stamp < 0)
        begin(clock, stamp, received_ns);
    int64_t step = step_to(clock, stamp, received_ns);
    double device_ns = (double)(clock->ticks + step) * clock->unit_ns;
    double delay_ns = (double)(received_ns - clock->origin_ns) - device_ns;
    if (step < 0 || delay_ns - line_ns(clock, device_ns) < (double)-clock->jump_ns) {
        clock->restarts++;
        begin(clock, stamp, received_ns);
        device_ns = delay_ns = 0;
        step = 0;
    }
    int64_t part = (received_ns - floor_mod(received_ns, clock->part_ns)) / clock->part_ns;
    learn(clock, &(struct clock_point){part, device_ns, delay_ns});
    int64_t time_ns = clock->origin_ns + (int64_t)rint(device_ns + line_ns(clock, device_ns));
    clock->ticks += step;
    clock->stamp = stamp;
    clock->received_ns = received_ns;
    if (time_ns < clock->last_ns)
        time_ns = clock->last_ns;
    if (time_ns > received_ns)
        time_ns = received_ns;
    if (stands_still(clock)) {
        clock->stops++;
        clock->is_still = 1;
        time_ns = received_ns;
    }
    clock->last_ns = time_ns;
    return time_ns;
}

/* Replace n times of receipt, not descending, by those at which the frames were stamped. */
SKINWARE_EXPORT void skinware_clock_convert(struct device_clock *clock, const int64_t *stamps, int64_t *times_ns,
                                            int64_t n)
{
    for (int64_t i = 0; i < n; i++)
        times_ns[i] = convert(clock, stamps[i], times_ns[i]);
}

/* Rows that have a stamp get its time; a patch has one clock. */
void tell_times(struct path *path)
{
    const struct plan *plan = path->plan;
    struct batch *batch = path->batch;
    int64_t row = batch->start > batch->headroom ? batch->start : batch->headroom; /* those before have theirs */
    for (; row < batch->stop; row++) {
        if (path->kind[row] == NO_KIND || path->entry[row] >= plan->n_modules)
            continue;
        const struct kind *kind = &plan->kinds[path->kind[row]];
        if (!kind->stamp.is_there)
            continue;
        int64_t patch = plan->module_patch[path->entry[row]];
        struct device_clock *clock = &path->clocks[patch];
        if (!plan->knows_clock[patch]) {
            plan->knows_clock[patch] = 1;
            *clock = (struct device_clock){.unit_ns = kind->stamp_unit_ns,
                                           .modulo = kind->stamp.turn,
                                           .part_ns = 1000000000,
                                           .jump_ns = 50000000,
                                           .points = path->clock_points + patch * CLOCK_PARTS,
                                           .stamp = -1,
                                           .last_ns = INT64_MIN};
        }
        int64_t stops = clock->stops, stamp = read_number(payload_of(batch, row), &kind->stamp) % kind->stamp.turn;
        batch->time_ns[row] = convert(clock, stamp, batch->time_ns[row]);
        plan->clock_stops[patch] += clock->stops - stops;
        path->words->warns |= clock->stops > stops;
    }
}

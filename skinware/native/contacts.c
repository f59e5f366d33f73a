/* Find, measure and list contacts, touched taxels that hang together: tests/specification/contacts.py. */

#include "contacts.h"

#include "baseline.h"

enum { NO_CONTACT = -1, BEYOND = -2 }; /* of a taxel: it is not touched; it is in a contact without a row */

SKINWARE_EXPORT int64_t skinware_components(struct components *c, int64_t m, const int64_t *taxels, int64_t *component);
SKINWARE_EXPORT void skinware_contacts_find(struct contacts *c, int16_t *contact_of);
SKINWARE_EXPORT int64_t skinware_contacts_list(struct contacts *c, int64_t time_ns, int16_t *contact_of);

static int64_t root_of(int64_t *root, int64_t taxel) {
    while (root[taxel] != taxel)
        taxel = root[taxel] = root[root[taxel]];
    return taxel;
}

static void join(int64_t *root, int64_t one, int64_t other) {
    const int64_t first = root_of(root, one), second = root_of(root, other);
    root[first < second ? second : first] = first < second ? first : second;
}

/* Numbers the components of m taxels, which rise, from 0 in their order; returns how many there are. */
int64_t find_components(struct components *c, int64_t m, const int64_t *taxels, int64_t *component) {
    int64_t k, j, count = 0;
    for (k = 0; k < m; k++)
        c->root[taxels[k]] = taxels[k];
    for (k = 0; k < m; k++) {
        const int32_t *beside = &c->forward[taxels[k] * c->width];
        const int64_t module = c->module[taxels[k]];
        for (j = 0; j < c->width && beside[j] >= 0; j++)
            if (c->root[beside[j]] >= 0)
                join(c->root, taxels[k], beside[j]);
        if (module >= 0 && c->first[module] >= 0)
            join(c->root, c->first[module], taxels[k]);
        else if (module >= 0)
            c->first[module] = taxels[k];
    }
    for (k = 0; k < m; k++) {
        const int64_t root = root_of(c->root, taxels[k]);
        if (root == taxels[k])
            c->number[root] = count++;
        component[k] = c->number[root];
    }
    for (k = 0; k < m; k++) {
        c->root[taxels[k]] = -1;
        if (c->module[taxels[k]] >= 0)
            c->first[c->module[taxels[k]]] = -1;
    }
    return count;
}

int64_t skinware_components(struct components *c, int64_t m, const int64_t *taxels, int64_t *component) {
    return find_components(c, m, taxels, component);
}

/* Keeps the largest contacts; one that was listed stays unless another is clearly larger. */
static void keep_largest(struct contacts *c) {
    int64_t k, kept, m = 0;
    for (k = 0; k < c->count; k++) {
        c->sums[k] = 0;
        c->was_listed[k] = 0;
    }
    for (k = 0; k < c->n_touched; k++) {
        c->sums[c->contact[k]] += c->load_of[k];
        c->was_listed[c->contact[k]] |= c->track_of[c->taxels[k]] >= 0;
    }
    for (k = 0; k < c->count; k++)
        c->sums[k] *= c->was_listed[k] ? CLEARLY : 1.0;
    for (kept = 0; kept < MOST; kept++) {
        int64_t largest = -1;
        for (k = 0; k < c->count; k++)
            if (c->sums[k] >= 0 && (largest < 0 || c->sums[k] > c->sums[largest]))
                largest = k;
        c->sums[largest] = -1;
    }
    for (k = 0, kept = 0; k < c->count; k++)
        c->sums[k] = c->sums[k] < 0 ? (double)kept++ : -1;
    for (k = 0; k < c->n_touched; k++) {
        const double number = c->sums[c->contact[k]];
        if (number < 0)
            continue;
        c->taxels[m] = c->taxels[k];
        c->load_of[m] = c->load_of[k];
        c->contact[m++] = (int64_t)number;
    }
    c->n_touched = m;
    c->count = MOST;
}

/* The coordinate frame in which each contact has its largest value at a known place; -1: none is known. */
static void find_frames(struct contacts *c) {
    const struct found *f = c->found;
    double most[MOST];
    int64_t k;
    for (k = 0; k < c->count; k++) {
        most[k] = -1;
        f->frame[k] = -1;
    }
    for (k = 0; k < c->n_touched; k++) {
        const int64_t frame = c->frame_of[c->taxels[k]], contact = c->contact[k];
        if (frame >= 0 && c->load_of[k] >= most[contact]) {
            most[contact] = c->load_of[k];
            f->frame[contact] = frame;
        }
    }
}

static int is_placed(const struct contacts *c, int64_t k) {
    const int64_t frame = c->found->frame[c->contact[k]];
    return frame >= 0 && frame == c->frame_of[c->taxels[k]];
}

static void measure_contacts(struct contacts *c) {
    const struct found *f = c->found;
    double weights[MOST], total[MOST], forces[MOST], with_area[MOST];
    int64_t k, axis;
    find_frames(c);
    for (k = 0; k < c->count; k++) {
        f->load[k] = f->peak[k] = weights[k] = total[k] = forces[k] = with_area[k] = f->area_m2[k] = 0;
        f->uncertainty[k] = c->has_uncertainty ? 0 : NAN;
        f->clipped[k] = 0;
        f->n[k] = 0;
        f->frames[k] = !c->has_uncertainty;
        f->is_sure[k] = !c->has_onset;
        for (axis = 0; axis < 3; axis++)
            f->cop_m[3 * k + axis] = f->normal[3 * k + axis] = -0.0;
    }
    for (k = 0; k < c->n_touched; k++)
        total[c->contact[k]] += is_placed(c, k) ? c->load_of[k] : 0;
    for (k = 0; k < c->n_touched; k++) {
        const int64_t contact = c->contact[k], taxel = c->taxels[k];
        const double load = c->load_of[k], *of_taxel = &c->of_taxel[8 * taxel];
        double weight = is_placed(c, k) ? load : 0;
        if (total[contact] == 0) /* without any load, each taxel weighs the same */
            weight += is_placed(c, k);
        f->load[contact] += load;
        f->peak[contact] = fmax(f->peak[contact], load);
        forces[contact] += load * of_taxel[6];
        weights[contact] += weight;
        f->area_m2[contact] += of_taxel[6];
        with_area[contact] += of_taxel[7];
        for (axis = 0; axis < 3; axis++) {
            f->cop_m[3 * contact + axis] += weight * of_taxel[axis];
            f->normal[3 * contact + axis] += weight * of_taxel[3 + axis];
        }
        f->n[contact]++;
        if (c->has_uncertainty && load >= CLEAR * c->uncertainty[taxel] && f->frames[contact] < 1)
            f->frames[contact] = 1;
        if (c->has_onset) {
            f->is_sure[contact] |= c->touched[taxel];
            if (c->onset[taxel])
                f->frames[contact] = 2;
        }
        if (c->has_clipped)
            f->clipped[contact] += c->clipped[taxel];
        if (c->has_uncertainty)
            f->uncertainty[contact] += c->uncertainty[taxel];
    }
    for (k = 0; k < c->count; k++) {
        double *normal = &f->normal[3 * k];
        const double length = sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]);
        const int has_area = with_area[k] > 0;
        f->area_m2[k] = has_area ? f->area_m2[k] : NAN;
        f->force_n[k] = c->is_newtons ? f->load[k] : c->is_pascals && has_area ? forces[k] : NAN;
        for (axis = 0; axis < 3; axis++) {
            f->cop_m[3 * k + axis] /= weights[k] > 0 ? weights[k] : NAN;
            normal[axis] /= length > 0 ? length : NAN;
        }
    }
}

/* Estimates the loads of bells of which only the part above the threshold and below the clipping was seen. */
static void estimate_whole(struct contacts *c) {
    const struct found *f = c->found;
    double least = INFINITY;
    int64_t k;
    for (k = 0; k < c->n_touched; k++)
        if (c->load_of[k] > 0)
            least = fmin(least, c->load_of[k]);
    if (least < INFINITY)
        c->least = c->least != 0 ? c->least + LEAST_SHARE * (least - c->least) : least;
    for (k = 0; k < c->count; k++) {
        const double peak = fmax(f->peak[k], c->least), seen = 1 - c->least / peak;
        const double share = f->clipped[k] / (double)f->n[k];
        const double top = pow(peak / pow(c->least, share), 1 / (1 - share));
        if (f->clipped[k] > 0)
            f->load_whole[k] = share <= MOST_CUT ? (double)f->n[k] * top / log(top / c->least) : NAN;
        else
            f->load_whole[k] = seen >= LEAST_SEEN ? f->load[k] / seen : NAN;
    }
}

/* Finds the contacts of a frame, and writes the (n,) contact_of of taxels that are in none. */
void skinware_contacts_find(struct contacts *c, int16_t *contact_of) {
    int64_t i;
    c->n_touched = c->beyond = 0;
    for (i = 0; i < c->n; i++) {
        contact_of[i] = NO_CONTACT;
        if (c->touched[i] | (c->has_onset & c->onset[i]))
            c->taxels[c->n_touched++] = i;
    }
    c->count = find_components(c->components, c->n_touched, c->taxels, c->contact);
    for (i = 0; i < c->n_touched; i++) {
        const double value = c->value[c->taxels[i]];
        c->load_of[i] = value > 0 && value < INFINITY ? value : 0;
    }
    if (c->count > MOST) {
        c->beyond = c->count - MOST;
        for (i = 0; i < c->n_touched; i++)
            contact_of[c->taxels[i]] = BEYOND;
        keep_largest(c);
    }
    measure_contacts(c);
    estimate_whole(c);
}

/* Lists those that have an identity, the oldest first; returns how many these are. */
int64_t skinware_contacts_list(struct contacts *c, int64_t time_ns, int16_t *contact_of) {
    const struct found *f = c->found;
    const struct listed *to = c->listed;
    int64_t order[MOST], row[MOST], m = 0, k, at, axis;
    for (k = 0; k < c->count; k++) {
        row[k] = -1;
        if (f->id[k] == 0)
            continue;
        for (at = m++; at > 0; at--) {
            const int64_t other = order[at - 1];
            if (f->age_s[other] > f->age_s[k] || (f->age_s[other] == f->age_s[k] && f->id[other] < f->id[k]))
                break;
            order[at] = other;
        }
        order[at] = k;
    }
    for (at = 0; at < m; at++) {
        k = order[at];
        row[k] = at;
        to->id[at] = (uint32_t)f->id[k];
        to->n[at] = (uint32_t)f->n[k];
        to->clipped[at] = (uint32_t)f->clipped[k];
        to->age_s[at] = (float)f->age_s[k];
        to->load[at] = (float)f->load[k];
        to->peak[at] = (float)f->peak[k];
        to->area_m2[at] = (float)f->area_m2[k];
        to->force_n[at] = (float)f->force_n[k];
        to->load_whole[at] = (float)f->load_whole[k];
        to->uncertainty[at] = (float)f->uncertainty[k];
        for (axis = 0; axis < 3; axis++) {
            to->cop_m[3 * at + axis] = (float)f->cop_m[3 * k + axis];
            to->normal[3 * at + axis] = (float)f->normal[3 * k + axis];
            to->velocity_m_s[3 * at + axis] = (float)f->velocity_m_s[3 * k + axis];
        }
        to->frame[at] = (int16_t)f->frame[k];
        to->kind[at] = (uint8_t)f->kind[k];
        to->provisional[at] = f->provisional[k];
        to->slips[at] = 0;
    }
    for (k = 0; k < c->n_touched; k++)
        contact_of[c->taxels[k]] = (int16_t)row[c->contact[k]];
    if (c->has_sigmas) {
        find_slips(c->slipping, time_ns, c, row);
        for (at = 0; at < c->slipping->n_patterns; at++)
            to->slips[at] = (uint8_t)c->slipping->patterns[at].slips;
    }
    return m;
}

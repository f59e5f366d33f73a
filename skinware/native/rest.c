/*
 * Measure what taxels read at rest over the last seconds, in a tenth of them at a time, beside what their patch has in
 * common. Level and noise are medians over the tenths: a touch of a third of the time moves neither, and medians of means
 * are finer than the steps of the values.
 */

#include "baseline.h"

#include <string.h>

enum { COUNT, D, C, DD, DC, CC, SUMS };

/* Median of chi-square with m - 1 degrees of freedom, divided by m - 1, for m of 4 to 10; beyond, it is nearly 1. */
static const float median_of_variance[] = {0.789f, 0.839f, 0.870f, 0.891f, 0.907f, 0.918f, 0.927f};

typedef struct measured {
    float level, noise2, gain, gain_variance, moves;
} measured;

/* Puts the value of a rank in its place, with all lower ones before it. */
static float select_rank(float *values, int64_t number, int64_t rank) {
    int64_t low = 0, high = number - 1;
    while (low < high) {
        const float pivot = values[(low + high) / 2];
        int64_t i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot)
                i++;
            while (values[j] > pivot)
                j--;
            if (i <= j) {
                const float swapped = values[i];
                values[i++] = values[j];
                values[j--] = swapped;
            }
        }
        if (rank <= j)
            high = j;
        else if (rank >= i)
            low = i;
        else
            break;
    }
    return values[rank];
}

static float median(float *values, int64_t number) {
    const float high = select_rank(values, number, number / 2);
    return number % 2 ? high : (select_rank(values, number / 2, number / 2 - 1) + high) / 2;
}

/* Finds the medians of those values of each group that count; 0 where none does. */
void medians(struct baseline *b, const int64_t *group, int64_t n_groups, const float *values, const uint8_t *counts,
             double *first_of_result, int64_t stride) {
    int64_t *ends = b->list + b->n, i, begin = 0; /* b->list has room for them */
    memset(ends, 0, (size_t)(n_groups + 1) * sizeof *ends);
    for (i = 0; i < b->n; i++)
        ends[group[i] + 1] += counts[i];
    for (i = 0; i < n_groups; i++)
        ends[i + 1] += ends[i];
    for (i = 0; i < b->n; i++)
        if (counts[i])
            b->scratch[ends[group[i]]++] = values[i];
    for (i = 0; i < n_groups; i++) {
        first_of_result[i * stride] = ends[i] > begin ? (double)median(b->scratch + begin, ends[i] - begin) : 0;
        begin = ends[i];
    }
}

static void clear(struct baseline *b) {
    int64_t i;
    for (i = 0; i < b->n; i++)
        b->first[i] = NAN;
    for (i = 0; i < b->n_patches; i++)
        b->patches[i].common = 0;
    b->block_frames = b->n_blocks = b->block_ns = 0;
}

static float *block_at(const struct baseline *b, int64_t number) {
    return b->blocks + number % BLOCKS * SUMS * b->n;
}

/* Takes a frame in; b->flag says which taxels wait. Returns whether a tenth ended, and there are ten of them. */
static int add(struct baseline *b, int64_t time_ns) {
    const int64_t n = b->n, block_ns = llrint(b->calibrate_s * 1e9 / BLOCKS);
    float *sums = block_at(b, b->n_blocks), *difference = b->scratch + n;
    int64_t i, n_values = 0, with_values = 0;
    if (b->n_blocks == 0 && b->block_frames == 0)
        b->block_ns = time_ns;
    if (b->block_frames == 0)
        memset(sums, 0, (size_t)(SUMS * n) * sizeof *sums);
    for (i = 0; i < n; i++) {
        if (b->flag[i] && isnan(b->first[i]))
            b->first[i] = b->last[i];
        difference[i] = b->flag[i] ? b->last[i] - b->first[i] : 0.0f; /* small, so that its squares are exact */
    }
    for (i = 0; i < b->n_patches; i++)
        b->patches[i].move = b->patches[i].common;
    medians(b, b->patch, b->n_patches, difference, b->flag, &b->patches->common,
            sizeof(struct patch) / sizeof(double));
    for (i = 0; i < b->n_patches; i++) {
        struct patch *p = &b->patches[i];
        const float common = p->taxels > FEW_TAXELS ? (float)p->common : 0.0f, moved = common - (float)p->move;
        p->common = (double)common;
        p->moves2 += b->block_frames > 0 ? ((double)(moved * moved) - p->moves2) / 20 : 0;
    }
    for (i = 0; i < n; i++) {
        const float d = difference[i], c = b->flag[i] ? (float)b->patches[b->patch[i]].common : 0.0f;
        sums[COUNT * n + i] += b->flag[i];
        sums[D * n + i] += d;
        sums[C * n + i] += c;
        sums[DD * n + i] += d * d;
        sums[DC * n + i] += d * c;
        sums[CC * n + i] += c * c;
        n_values += (int64_t)sums[COUNT * n + i];
        with_values += sums[COUNT * n + i] > 0;
    }
    b->block_frames++;
    if (time_ns - b->block_ns < block_ns || n_values < BLOCK_FRAMES * with_values)
        return 0;
    b->n_blocks++;
    b->block_ns = time_ns;
    b->block_frames = 0;
    return b->n_blocks >= BLOCKS;
}

/* What a taxel reads now, over the newest part with enough values of it, and its noise; returns whether there is one. */
int measure_now(const struct baseline *b, int64_t taxel, float *level, float *noise2) {
    const int64_t n = b->n, newest = b->n_blocks - (b->block_frames == 0);
    const int64_t oldest = newest >= BLOCKS ? newest - BLOCKS + 1 : 0;
    const float at_last = (float)b->patches[b->patch[taxel]].common;
    float parts[BLOCKS], typical = 1;
    int64_t block, k = 0;
    for (block = newest; block >= oldest; block--) {
        const float *of = block_at(b, block) + taxel;
        const float count = of[COUNT * n], rest = of[D * n] - of[C * n];
        if (count < BLOCK_FRAMES)
            continue;
        if (k == 0) {
            *level = b->first[taxel] + at_last + rest / count;
            typical = count <= BLOCK_FRAMES + 6 ? median_of_variance[(int)count - BLOCK_FRAMES] : 1;
        }
        parts[k++] = (of[DD * n] - 2 * of[DC * n] + of[CC * n] - rest * rest / count) / (count - 1);
    }
    if (k > 0)
        *noise2 = highest(median(parts, k) / typical, 0);
    return k > 0;
}

/* The share of a variance that the median over the tenths shows: it depends on the frames of a tenth. */
static float typical_share(const struct baseline *b) {
    int64_t with[BLOCK_FRAMES + 8] = {0}, number = 0, i, block;
    for (block = 0; block < BLOCKS; block++)
        for (i = 0; i < b->n; i++) {
            const float count = block_at(b, block)[COUNT * b->n + i];
            if (isnan(b->first[i]) || count < BLOCK_FRAMES)
                continue;
            with[count > BLOCK_FRAMES + 7 ? BLOCK_FRAMES + 7 : (int)count]++;
            number++;
        }
    for (i = 0, number = (number + 1) / 2; i < BLOCK_FRAMES + 7; i++)
        if ((number -= with[i]) <= 0)
            break;
    return i >= BLOCK_FRAMES && i < BLOCK_FRAMES + 7 ? median_of_variance[i - BLOCK_FRAMES] : 1.0f;
}

/* The result for a taxel; its level is NaN without enough data. */
static measured result_of(const struct baseline *b, int64_t taxel, float typical) {
    const int64_t n = b->n;
    const float at_last = (float)b->patches[b->patch[taxel]].common;
    float sums[SUMS] = {0}, parts[BLOCKS], own[BLOCKS], both[BLOCKS], mode[BLOCKS], count[BLOCKS], d[BLOCKS], c[BLOCKS];
    float mean, power, prior, lowest_level = INFINITY, highest_level = -INFINITY;
    float lowest_noise2 = INFINITY;
    measured found = {NAN, 0, 1, 0, 0};
    int64_t block, k = 0, i;
    for (block = b->n_blocks - BLOCKS; block < b->n_blocks; block++) {
        const float *of = block_at(b, block) + taxel;
        if (of[COUNT * n] < BLOCK_FRAMES)
            continue;
        count[k] = of[COUNT * n], d[k] = of[D * n], c[k] = of[C * n];
        own[k] = of[DD * n] - d[k] * d[k] / count[k];
        mode[k] = of[CC * n] - c[k] * c[k] / count[k];
        both[k] = of[DC * n] - d[k] * c[k] / count[k];
        for (i = 0; i < SUMS; i++)
            sums[i] += of[i * n];
        k++;
    }
    if (k < ENOUGH_BLOCKS)
        return found;
    for (i = 0; i < k; i++)
        parts[i] = (own[i] - 2 * both[i] + mode[i]) / (count[i] - 1);
    mean = sums[C] / highest(sums[COUNT], 1);
    power = sums[CC] - mean * sums[C];
    prior = median(parts, k) / typical / GAIN_SPREAD2 + 1e-12f;
    found.gain = 1 + (sums[DC] - mean * sums[D] - power) / (power + prior);
    for (i = 0; i < k; i++) {
        parts[i] = (own[i] - 2 * found.gain * both[i] + found.gain * found.gain * mode[i]) / (count[i] - 1);
        lowest_noise2 = lowest(lowest_noise2, parts[i]);
    }
    found.noise2 = median(parts, k) / typical;
    found.gain_variance = highest(found.noise2, 1e-12f) / (power + prior);
    found.noise2 = highest(found.noise2, 0);
    for (i = 0; i < k; i++) {
        parts[i] = (d[i] - found.gain * c[i]) / count[i];
        lowest_level = lowest(lowest_level, parts[i]);
        highest_level = highest(highest_level, parts[i]);
    }
    found.level = median(parts, k) + b->first[taxel] + found.gain * at_last;
    lowest_noise2 = highest(lowest_noise2, least_noise2(b, found.level));
    found.moves = found.noise2 > RESTLESS * lowest_noise2 ? INFINITY : highest_level - lowest_level;
    return found;
}

static void begin(struct baseline *b, int64_t taxel, const measured *found) {
    const float noise2 = highest(found->noise2, least_noise2(b, found->level));
    int64_t block;
    for (block = 0; block < BLOCKS; block++)
        block_at(b, block)[COUNT * b->n + taxel] = 0; /* else it would begin again while others wait */
    b->level[taxel] = found->level;
    b->noise2[taxel] = noise2;
    b->gain[taxel] = b->gain_before[taxel] = lowest(highest(found->gain, 0), MOST_GAIN);
    b->gain_variance[taxel] = found->gain_variance;
    b->variance[taxel] = noise2 / 20;
    b->cross[taxel] = b->slow[taxel] = 0;
    b->ready[taxel] = 1;
}

/* Begins with how far the modes moved while the first taxels were measured, without the part that is noise. */
static void begin_modes(struct baseline *b, double passed_s) {
    int64_t i;
    for (i = 0; i < b->n_patches; i++)
        b->patches[i].sums[0] = b->patches[i].sums[1] = 0;
    for (i = 0; i < b->n; i++) {
        struct patch *p = &b->patches[b->patch[i]];
        p->sums[0] += b->ready[i];
        p->sums[1] += b->ready[i] ? (double)b->noise2[i] : 0;
    }
    for (i = 0; i < b->n_patches; i++) {
        struct patch *p = &b->patches[i];
        const double number = fmax(p->sums[0], 1), rounding = 3 * p->sums[1] / (number * number);
        p->agility = fmax(p->moves2 - rounding, 0.01 * rounding) / fmax(passed_s, 1e-3);
    }
}

/* Measures the taxels that wait for a baseline. Where many of them move, those that move go on waiting until they rest. */
void measure(struct baseline *b, int64_t time_ns, double passed_s) {
    const float on = (float)least_on(b), on_sigma = (float)b->on_sigma;
    int64_t i, waiting = 0, measured_ones = 0, moving = 0, seen = 0, were_ready = 0, begun = 0;
    float typical;
    int is_refused;
    for (i = 0; i < b->n; i++)
        waiting += b->flag[i];
    if (!waiting || !add(b, time_ns))
        return;
    typical = typical_share(b);
    for (i = 0; i < b->n; i++) {
        measured found = {NAN, 0, 1, 0, 0};
        if (!isnan(b->first[i]))
            found = result_of(b, i, typical);
        b->flag[i] = isfinite(found.level) ? 1 : 0;
        if (b->flag[i] && found.moves > highest(on, on_sigma * sqrtf(found.noise2)))
            b->flag[i] = 2;
        measured_ones += b->flag[i] > 0;
        moving += b->flag[i] == 2;
        seen += b->seen[i];
        were_ready += b->ready[i];
    }
    is_refused = (double)moving > fmax(1, MOVED_SHARE * (double)measured_ones);
    b->refused_share = is_refused ? (double)moving / (double)seen : 0;
    for (i = 0; i < b->n; i++) {
        if (b->flag[i] == 1 || (b->flag[i] == 2 && !is_refused)) {
            const measured found = result_of(b, i, typical);
            begin(b, i, &found);
            begun++;
        }
    }
    if (begun && !were_ready)
        begin_modes(b, passed_s);
    if (!is_refused)
        clear(b); /* a taxel that sends later starts a new measurement */
}

/*
 * A reader of skinware.h for tools/bench core: core_reader NAMESPACE SERVICE. It sleeps, copies each frame and looks at its
 * first and last value, as the readers in Python do. Prints "ready", and at the end the CPU time a second, how many
 * frames were torn, and the age of each in ns, a number a line.
 */

#define SKINWARE_IMPLEMENTATION
#include <skinware.h>

#include <stdio.h>
#include <sys/resource.h>

enum { MEASURED = 1, OVER = 2, MOST = 1 << 20 };

static double cpu_s(void) {
    struct rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    return (double)(usage.ru_utime.tv_sec + usage.ru_stime.tv_sec) +
           (double)(usage.ru_utime.tv_usec + usage.ru_stime.tv_usec) / 1e6;
}

int main(int count, char **arguments) {
    static int64_t ages_ns[MOST];
    skinware_reader *reader;
    skinware_frame frame = SKINWARE_FRAME_INIT;
    const skinware_column *values;
    double began_cpu_s = 0, share = 0;
    int64_t began_ns = 0;
    long torn = 0;
    int i, frames = 0;
    if (count != 3 || skinware_attach(&reader, arguments[1], arguments[2]) != SKINWARE_OK)
        return 1;
    values = skinware_find_column(reader, "values");
    puts("ready");
    fflush(stdout);
    while (frames < MOST) {
        int64_t age_ns;
        const uint16_t *seen;
        if (skinware_wait(reader, &frame, skinware_now_ns() + 2000000000) != SKINWARE_OK)
            break;
        if (skinware_read(reader, &frame) != SKINWARE_OK)
            continue;
        age_ns = skinware_now_ns() - frame.acquired_ns;
        if (frame.flags == OVER)
            break;
        if (frame.flags != MEASURED)
            continue;
        if (frames == 0) {
            began_ns = skinware_now_ns();
            began_cpu_s = cpu_s();
        }
        seen = (const uint16_t *)skinware_data(&frame, values);
        torn += seen[0] != (frame.sequence & 0xFFFF) || seen[values->count - 1] != (frame.sequence & 0xFFFF);
        ages_ns[frames++] = age_ns;
    }
    if (frames > 0)
        share = (cpu_s() - began_cpu_s) / ((double)(skinware_now_ns() - began_ns) / 1e9);
    printf("%f\n%ld\n", share, torn);
    for (i = 0; i < frames; i++)
        printf("%lld\n", (long long)ages_ns[i]);
    return 0;
}

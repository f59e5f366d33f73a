/* fingers.c: a stand-in for the vendor's library */
#include <stddef.h>
#include <stdint.h>
#include <time.h>

/* Waits for the hardware and stores count raw values. Returns when they were acquired (CLOCK_MONOTONIC ns), below 0 at the end. */
int64_t acquire(uint16_t *values, size_t count) {
    static uint16_t cycle = 0;
    const struct timespec period = {0, 1000000};
    struct timespec now;
    size_t i;
    nanosleep(&period, NULL);
    for (i = 0; i < count; i++)
        values[i] = (uint16_t)(cycle + i);
    clock_gettime(CLOCK_MONOTONIC, &now);
    return ++cycle > 3000 ? -1 : (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

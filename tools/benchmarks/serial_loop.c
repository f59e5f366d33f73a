/* The least that a receiver of a serial line can do, in C: wait, rest, read, take the stuffing out, look up, copy.
 *
 * serial_loop PATH LATENCY_MS SECONDS: what serial_rest.py is with "driver" in its place, in the same form. It prints a
 * line when it listens, then, after a second without a byte, or SECONDS after the first one, what it received.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { CHUNK = 1 << 16, LONGEST = 256, MODULES = 100, FRAME = 27, QUIET_MS = 1000 };

static uint8_t stream[CHUNK + LONGEST], values[MODULES][24];
static int64_t module_time_ns[MODULES];
static long received;

static int64_t now_ns(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static void take(const uint8_t *segment, size_t size, int64_t time_ns)
{
    uint8_t content[LONGEST];
    size_t n = 0, place = 0;
    if (size > LONGEST)
        return;
    while (place < size && place + segment[place] <= size) {
        size_t code = segment[place];
        memcpy(content + n, segment + place + 1, code - 1);
        n += code - 1;
        place += code;
        if (code < 255 && place < size)
            content[n++] = 0;
    }
    if (place != size || n != FRAME || content[0] >= MODULES)
        return;
    memcpy(values[content[0]], content + 1, sizeof values[0]);
    module_time_ns[content[0]] = time_ns;
    received++;
}

int main(int argc, char **argv)
{
    if (argc != 4)
        return 2;
    int fd = open(argv[1], O_RDONLY | O_NOCTTY | O_NONBLOCK);
    int64_t longest_ns = (int64_t)(1e9 * atof(argv[3])), began_ns = 0, began_cpu_ns = 0, ended_ns = 0, ended_cpu_ns = 0;
    struct timespec rest = {.tv_nsec = (long)(1e6 * atof(argv[2]))};
    struct pollfd line = {.fd = fd, .events = POLLIN};
    size_t kept = 0;
    if (fd < 0) {
        perror("serial_loop");
        return 1;
    }
    printf("ready\n");
    fflush(stdout);
    while (poll(&line, 1, began_ns ? QUIET_MS : -1) > 0 && ended_ns - began_ns <= longest_ns) {
        ssize_t n;
        while ((n = read(fd, stream + kept, CHUNK)) > 0) {
            uint8_t *begin = stream, *end = stream + kept + n, *delimiter;
            int64_t time_ns = now_ns(CLOCK_MONOTONIC);
            while ((delimiter = memchr(begin, 0, (size_t)(end - begin)))) {
                take(begin, (size_t)(delimiter - begin), time_ns);
                begin = delimiter + 1;
            }
            kept = (size_t)(end - begin) < LONGEST ? (size_t)(end - begin) : 0;
            memmove(stream, begin, kept);
            if (n < 2048)
                break;
        }
        ended_ns = now_ns(CLOCK_MONOTONIC);
        ended_cpu_ns = now_ns(CLOCK_PROCESS_CPUTIME_ID);
        if (!began_ns) {
            began_ns = ended_ns;
            began_cpu_ns = ended_cpu_ns;
        }
        nanosleep(&rest, NULL);
    }
    printf("{\"frames\": [%ld], \"lost\": 0, \"wall_s\": %.6f, \"cpu_s\": %.6f}\n", received,
           1e-9 * (double)(ended_ns - began_ns), 1e-9 * (double)(ended_cpu_ns - began_cpu_ns));
    return 0;
}

/* As much of Arduino as a sketch needs, on a pseudo terminal that is descriptor 0. Input i reads 100 * (i + 1). */
#include <poll.h>
#include <stdint.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

static inline uint32_t micros() {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint32_t)((uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u);
}

static inline int analogRead(uint8_t input) { return 100 * (input + 1); }

struct HardwareSerial {
    void begin(unsigned long) {}
    int read() {
        uint8_t byte;
        struct pollfd wait = {0, POLLIN, 0};
        const bool has_come = poll(&wait, 1, 1) == 1 && (wait.revents & POLLIN);
        return has_come && ::read(0, &byte, 1) == 1 ? byte : -1;
    }
    size_t write(const uint8_t *bytes, size_t n) {
        for (size_t done = 0; done < n;) {
            const ssize_t written = ::write(0, bytes + done, n - done);
            if (written < 0) exit(1);
            done += (size_t)written;
        }
        return n;
    }
};
static HardwareSerial Serial;

void setup();
void loop();

int main() {
    setup();
    for (;;) loop();
}

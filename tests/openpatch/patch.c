/*
 * A patch on the other end of a pseudo terminal, which is its descriptor 0: openpatch.h as a microcontroller runs it.
 *
 *     patch MODEL SERIAL_NUMBER RESET_REASON [FIRST_MICROSECOND]
 *
 * Models: finger, hand, wide. In sample s of module m, value i is 5 * m + 3 * i + s, modulo what the model says, and 0
 * after a tare. SIGUSR1: sampling hangs from here on. SIGUSR2: says something.
 */
#define _POSIX_C_SOURCE 200809L
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

#define OPENPATCH_IMPLEMENTATION
#include "openpatch.h"

#define MAX_MODULES 16
#define MAX_VALUES 1016

static const openpatch_type types[] = {
    {1, 0.5f, -10.0f, 0.0f, 100.0f, "pressure", "kPa"},
    {2, 0.01f, 0.0f, 0.0f, 0.0f, "shear_x", "N"},
    {3, 0.01f, 0.0f, 0.0f, 0.0f, "shear_y", "N"},
    {5, 0.1f, -20.0f, -20.0f, 80.0f, "temperature", "degC"},
    {77u << 12 | 9u, 1.0f, 0.0f, 0.0f, 0.0f, "strain", "\xC2\xB5m/m"},
};

static const openpatch_run finger_runs[] = {{4, 3, {1, 2, 0}}, {1, 1, {3}}};
static const openpatch_kind finger_kinds[] = {{OPENPATCH_U16, OPENPATCH_TABLE(finger_runs), "fingertip"}};
static openpatch_module finger_modules[1];

static const openpatch_run triangle_runs[] = {
    {6, 1, {0}}, {1, 1, {OPENPATCH_PADDING}}, {3, 1, {0}}, {1, 1, {3}}, {1, 1, {0}}};
static const openpatch_run palm_runs[] = {{16, 1, {0}}};
static const openpatch_run bones_runs[] = {{2, 2, {4, OPENPATCH_PADDING}}};
static const openpatch_kind hand_kinds[] = {{OPENPATCH_U8, OPENPATCH_TABLE(triangle_runs), "triangle"},
                                            {OPENPATCH_I16, OPENPATCH_TABLE(palm_runs), "palm"},
                                            {OPENPATCH_F32, OPENPATCH_TABLE(bones_runs), "bones"}};
static openpatch_module hand_modules[] = {OPENPATCH_MODULE(0), OPENPATCH_MODULE(0), OPENPATCH_MODULE(0),
                                          OPENPATCH_MODULE(1), OPENPATCH_MODULE(0), OPENPATCH_MODULE(2),
                                          OPENPATCH_MODULE(2)};

static const openpatch_run wide_runs[] = {{1016, 1, {0}}};
static const openpatch_run deep_runs[] = {{60, 1, {4}}};
static const openpatch_kind wide_kinds[] = {{OPENPATCH_U8, OPENPATCH_TABLE(wide_runs), "wide"},
                                            {OPENPATCH_I32, OPENPATCH_TABLE(deep_runs), "deep"}};
static openpatch_module wide_modules[] = {OPENPATCH_MODULE(0), OPENPATCH_MODULE(1), OPENPATCH_MODULE(1)};

static volatile sig_atomic_t hangs, speaks;
static uint32_t first_us;
static uint8_t tared[MAX_MODULES];

static void on_signal(int number) {
    if (number == SIGUSR1) hangs = 1; else speaks = 1;
}

static int read_byte(void) {
    uint8_t byte;
    struct pollfd wait = {0, POLLIN, 0};
    if (poll(&wait, 1, 0) != 1 || !(wait.revents & POLLIN)) return -1;
    if (read(0, &byte, 1) == 1) return byte;
    if (errno == EINTR) return -1;
    exit(0);
}

static void write_bytes(const uint8_t *bytes, size_t n) {
    while (n > 0) {
        ssize_t written = write(0, bytes, n);
        if (written < 0 && errno != EINTR) exit(1);
        if (written > 0) { bytes += written; n -= (size_t)written; }
    }
}

static uint32_t now_us(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint32_t)((uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u) + first_us;
}

static uint32_t set_period(uint32_t us) { /* whole milliseconds only */
    return us < 2000 ? 1000 : us / 1000 * 1000;
}

static uint8_t tare(uint8_t module) {
    uint8_t i;
    if (module == 2) return OPENPATCH_FAILED;
    for (i = 0; i < MAX_MODULES; i++) if (module == OPENPATCH_ALL || module == i) tared[i] = 1;
    return OPENPATCH_OK;
}

#define MODEL(name) {20000, 1000, 1000000, "test patch", "", "1.0", OPENPATCH_TABLE(types), \
                     OPENPATCH_TABLE(name##_kinds), OPENPATCH_TABLE(name##_modules), \
                     read_byte, write_bytes, now_us, NULL, set_period, tare}
static const openpatch_description models[] = {MODEL(finger), MODEL(hand), MODEL(wide)};

static void sample(openpatch *op, uint8_t module, uint32_t us, const char *model) {
    static union { uint8_t u8[MAX_VALUES]; int16_t i16[MAX_VALUES]; uint16_t u16[MAX_VALUES];
                   int32_t i32[MAX_VALUES]; float f32[MAX_VALUES]; } values;
    static uint8_t each[MAX_VALUES];
    const openpatch_description *d = op->description;
    const openpatch_kind *kind = &d->kinds[d->modules[module].kind];
    uint8_t any_bad = 0;
    unsigned i, n = 0;
    for (i = 0; i < kind->n_runs; i++) n += (unsigned)kind->runs[i].count * kind->runs[i].n_axes;
    for (i = 0; i < n; i++) {
        unsigned value = tared[module] ? 0 : 5u * module + 3u * i + d->modules[module].sequence;
        each[i] = 0;
        switch (kind->dtype) {
        case OPENPATCH_U8: values.u8[i] = (uint8_t)(value % 251); break;
        case OPENPATCH_I16: values.i16[i] = (int16_t)((int)(value % 60000) - 30000); break;
        case OPENPATCH_U16: values.u16[i] = (uint16_t)value; break;
        case OPENPATCH_I32: values.i32[i] = (int32_t)value * 100000 - 1000000000; break;
        default: values.f32[i] = (float)value / 4;
        }
        if (model[0] == 'h' && module == 1 && i == 2) each[i] = OPENPATCH_NO_ACK, any_bad = 1;
    }
    openpatch_send(op, module, us, &values, model[0] == 'h' && module == 3 ? OPENPATCH_OUT_OF_RANGE : 0,
                   any_bad ? each : NULL);
}

int main(int argc, char **argv) {
    static openpatch op;
    openpatch_description d;
    struct sigaction action;
    uint32_t due_us;
    if (argc < 4) return 2;
    const char *model = argv[1];
    d = models[model[0] == 'h' ? 1 : model[0] == 'w' ? 2 : 0];
    d.serial_number = argv[2];
    if (argc > 4) first_us = (uint32_t)strtoul(argv[4], NULL, 0) - now_us();
    memset(&action, 0, sizeof action);
    action.sa_handler = on_signal;
    sigaction(SIGUSR1, &action, NULL);
    sigaction(SIGUSR2, &action, NULL);
    openpatch_init(&op, &d, (uint8_t)atoi(argv[3]));
    due_us = now_us();
    for (;;) {
        struct pollfd wait = {0, POLLIN, 0};
        const int32_t left_us = (int32_t)(due_us - now_us());
        poll(&wait, 1, left_us <= 0 ? 0 : left_us > 20000 ? 20 : left_us / 1000);
        if (wait.revents & (POLLERR | POLLNVAL)) {
            return 0;
        } else if ((wait.revents & (POLLHUP | POLLIN)) == POLLHUP) { /* nobody has the port open */
            struct timespec pause = {0, 1000000};
            nanosleep(&pause, NULL);
        }
        openpatch_poll(&op);
        if (speaks) { speaks = 0; openpatch_note(&op, 1, "supply at 4.1 V\x1b[31m"); }
        if ((int32_t)(now_us() - due_us) >= 0) {
            uint8_t module;
            const uint32_t us = now_us();
            due_us = op.period_us > us - due_us ? due_us + op.period_us : us + op.period_us;
            for (module = 0; module < d.n_modules && !hangs; module++) sample(&op, module, us, model);
        }
    }
}

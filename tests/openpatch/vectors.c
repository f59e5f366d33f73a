/*
 * openpatch.h without a line: takes commands on stdin, one a line, and prints what the patch sends, in hex.
 *
 *     time MICROSECONDS    what the clock shows
 *     receive HEX          bytes arrive
 *     send MODULE STATUS   a sample: values 0x100 * MODULE + 1, 0, 0xFFFF, 300; with STATUS 255: status 0, and NO_ACK
 *                          for the third value alone
 *     note TEXT
 */
#include <stdio.h>
#include <stdlib.h>

#define OPENPATCH_IMPLEMENTATION
#include "openpatch.h"

static const openpatch_type types[] = {{1, 0.5f, -10.0f, 0.0f, 100.0f, "pressure", "kPa"},
                                       {5, 0.25f, 0.0f, 0.0f, 0.0f, "temperature", "degC"}};
static const openpatch_run runs[] = {{3, 1, {0}}, {1, 1, {1}}};
static const openpatch_kind kinds[] = {{"tip", OPENPATCH_U16, 2, runs}};
static const openpatch_modules modules[] = {{0, 2}};
static const openpatch_description description = {"tip", "7", "1.0", 10000, 1000, 1000000, 2, 1, 1, types, kinds, modules};

static uint32_t clock_us;
static size_t room = 4096;

static void write_hex(void *context, const uint8_t *bytes, size_t n) {
    (void)context;
    for (; n > 0; n--) printf("%02x", *bytes++);
}

static uint32_t now_us(void *context) { (void)context; return clock_us; }
static size_t room_now(void *context) { (void)context; return room; }

int main(void) {
    static openpatch op;
    static openpatch_module states[2];
    static const openpatch_hardware hardware = {NULL, write_hex, now_us, room_now, NULL, NULL};
    static char line[8192];
    openpatch_init(&op, &description, &hardware, states, OPENPATCH_RESET_POWER);
    while (fgets(line, sizeof line, stdin) != NULL) {
        unsigned a, b;
        int used;
        line[strcspn(line, "\n")] = 0;
        if (sscanf(line, "time %u", &a) == 1) {
            clock_us = a;
        } else if (sscanf(line, "room %u", &a) == 1) {
            room = a;
        } else if (strncmp(line, "receive ", 8) == 0) {
            const char *hex = line + 8;
            for (; sscanf(hex, "%2x%n", &a, &used) == 1; hex += used) {
                openpatch_receive(&op, (uint8_t)a);
                openpatch_poll(&op);
            }
        } else if (sscanf(line, "send %u %u", &a, &b) == 2) {
            const uint8_t each[4] = {0, 0, OPENPATCH_NO_ACK, 0};
            const uint16_t values[4] = {(uint16_t)(0x100 * a + 1), 0, 0xFFFF, 300};
            openpatch_send(&op, (uint8_t)a, clock_us, values, (uint8_t)(b == 255 ? 0 : b), b == 255 ? each : NULL);
        } else if (strncmp(line, "note ", 5) == 0) {
            openpatch_note(&op, 1, line + 5);
        } else if (strcmp(line, "poll") != 0) {
            return 2;
        }
        openpatch_poll(&op);
        printf("\n");
        fflush(stdout);
    }
    return 0;
}

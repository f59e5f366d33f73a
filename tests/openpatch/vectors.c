/*
 * openpatch.h without a line: takes commands on stdin, one a line, and prints what the patch sends, in hex.
 *
 *     time MICROSECONDS    what the clock shows
 *     room BYTES           what the line takes
 *     receive HEX          bytes arrive
 *     send MODULE STATUS   a sample: values 0x100 * MODULE + 1, 0, 0xFFFF, 300; with STATUS 255: status 0, and NO_ACK
 *                          for the third value alone
 *     note TEXT
 *     poll                 nothing; a poll follows every command
 */
#include <stdio.h>
#include <stdlib.h>

#define OPENPATCH_IMPLEMENTATION
#include "openpatch.h"

static const openpatch_type types[] = {{1, 0.5f, -10.0f, 0.0f, 100.0f, "pressure", "kPa"},
                                       {5, 0.25f, 0.0f, 0.0f, 0.0f, "temperature", "degC"}};
static const openpatch_run runs[] = {{3, 1, {0}}, {1, 1, {1}}};
static const openpatch_kind kinds[] = {{OPENPATCH_U16, OPENPATCH_TABLE(runs), "tip"}};
static openpatch_module modules[2];
static uint32_t clock_us;
static size_t room = 4096;
static const char *received = ""; /* in hex */

static int read_hex(void) {
    unsigned byte;
    int used;
    if (sscanf(received, "%2x%n", &byte, &used) != 1) return -1;
    received += used;
    return (int)byte;
}

static void write_hex(const uint8_t *bytes, size_t n) {
    for (; n > 0; n--) printf("%02x", *bytes++);
}

static uint32_t now_us(void) { return clock_us; }
static size_t room_now(void) { return room; }

static const openpatch_description description = {
    10000, 1000, 1000000, "tip", "7", "1.0",
    OPENPATCH_TABLE(types), OPENPATCH_TABLE(kinds), OPENPATCH_TABLE(modules),
    read_hex, write_hex, now_us, room_now, NULL, NULL};

int main(void) {
    static openpatch op;
    static char line[8192];
    openpatch_init(&op, &description, OPENPATCH_RESET_POWER);
    while (fgets(line, sizeof line, stdin) != NULL) {
        unsigned a, b;
        line[strcspn(line, "\n")] = 0;
        if (sscanf(line, "time %u", &a) == 1) {
            clock_us = a;
        } else if (sscanf(line, "room %u", &a) == 1) {
            room = a;
        } else if (strncmp(line, "receive ", 8) == 0) {
            received = line + 8;
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

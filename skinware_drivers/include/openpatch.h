/*
 * openpatch.h - the open patch protocol for a skin patch's microcontroller, in C99 or C++11. Needs only memcpy, memmove.
 *
 * docs/protocols/patch-serial.md is the protocol, docs/how-to/openpatch.md leads from nothing to live data. In exactly
 * one source file (in all others without the #define):
 *
 *     #define OPENPATCH_IMPLEMENTATION
 *     #include "openpatch.h"
 *
 * You describe the patch in const tables, give functions for output and time, hand in received bytes (also from an
 * interrupt), call openpatch_poll in the main loop, and openpatch_send for each sample. All functions but
 * openpatch_receive are for one context, the main loop. Nothing is allocated; an openpatch takes about 0.5 KiB of RAM.
 *
 * Copyright: the Skinware authors. SPDX-License-Identifier: Apache-2.0
 */
#ifndef OPENPATCH_H
#define OPENPATCH_H
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#ifdef __cplusplus
extern "C" {
#endif

#define OPENPATCH_ALL 0xFF     /* as a module: every one */
#define OPENPATCH_PADDING 0xFF /* as an axis: a value that is sent and means nothing */
#ifndef OPENPATCH_RECEIVE_SIZE /* room for bytes received between two polls: a power of 2, at most 128 */
#define OPENPATCH_RECEIVE_SIZE 64
#endif
#ifndef OPENPATCH_COPY /* AVR: define it as memcpy_P, and the tables (not the description itself) can be PROGMEM */
#define OPENPATCH_COPY memcpy
#endif

enum { OPENPATCH_U8, OPENPATCH_I16, OPENPATCH_U16, OPENPATCH_I32, OPENPATCH_F32 }; /* dtype: how values are sent */
enum { /* status: what is wrong with a module or a sensor, as bits; 0 means fresh and good */
    OPENPATCH_OLD = 2,            /* the value is not of this sample */
    OPENPATCH_OUT_OF_RANGE = 4,   /* the true value lies beyond what the hardware can express */
    OPENPATCH_NO_ACK = 8,         /* the transducer does not answer */
    OPENPATCH_NOT_CONNECTED = 16, /* no transducer is connected */
    OPENPATCH_MASKED = 32,        /* switched off */
    OPENPATCH_SUSPECT = 64        /* doubtful: the baseline moved by itself, a self-test failed ... */
};
enum { OPENPATCH_RESET_UNKNOWN, OPENPATCH_RESET_POWER, OPENPATCH_RESET_PIN, OPENPATCH_RESET_WATCHDOG,
       OPENPATCH_RESET_BROWN_OUT, OPENPATCH_RESET_SOFTWARE, OPENPATCH_RESET_FAULT };
enum { OPENPATCH_OK, OPENPATCH_UNKNOWN_REQUEST, OPENPATCH_BAD_LENGTH, OPENPATCH_NO_SUCH, OPENPATCH_BAD_VALUE,
       OPENPATCH_BUSY, OPENPATCH_FAILED, OPENPATCH_NOT_SUPPORTED, OPENPATCH_OTHER_DESCRIPTION };

typedef struct { /* a type of sensor: physical value = offset + scale * raw, in unit */
    uint32_t id; /* vendor << 12 | number; vendor 0 is the shared catalogue: 1 pressure ... (see the protocol) */
    float scale, offset, minimum, maximum; /* the last two: what it can report, physical; equal: not known */
    const char *name, *unit;               /* at most 32 and 16 bytes */
} openpatch_type;

typedef struct { /* taxels that are alike: count times the axes x0 y0 z0 x1 y1 z1 ... */
    uint16_t count;
    uint8_t n_axes, axes[9]; /* places in the table of types, or OPENPATCH_PADDING */
} openpatch_run;

typedef struct { /* a kind of module */
    const char *name; /* at most 32 bytes */
    uint8_t dtype, n_runs;
    const openpatch_run *runs;
} openpatch_kind;

typedef struct { /* modules of one kind; they are numbered 0, 1, 2 ... through the whole table */
    uint8_t kind, count;
} openpatch_modules;

typedef struct {
    const char *product, *serial_number, *firmware;            /* at most 32 bytes each */
    uint32_t period_us, shortest_period_us, longest_period_us; /* of a cycle: at first, and what can be set */
    uint8_t n_types, n_kinds, n_modules;                       /* lengths of the tables */
    const openpatch_type *types;
    const openpatch_kind *kinds;
    const openpatch_modules *modules;
} openpatch_description;

typedef struct {
    void *context;                                                /* handed to each of these */
    void (*write)(void *context, const uint8_t *bytes, size_t n); /* send or queue all of them */
    uint32_t (*now_us)(void *context);                            /* microseconds; wraps at 2^32 */
    size_t (*room)(void *context); /* bytes that write takes without waiting: data that finds no room is dropped and
                                      counted, only replies wait. NULL: everything waits */
    uint32_t (*set_period)(void *context, uint32_t us); /* -> the period that it became; NULL: exactly that */
    uint8_t (*tare)(void *context, uint8_t module); /* when done -> OPENPATCH_OK, _FAILED ...; NULL: not supported */
} openpatch_hardware;

typedef struct { /* what is known of one module */
    uint16_t sequence;
    uint8_t enabled;
} openpatch_module;

typedef struct {
    uint32_t period_us; /* yours to read: sample every module that is wanted once in this time */
    uint8_t streaming;  /* yours to read: the host wants data. The rest belongs to this header. */
    uint8_t n_modules, reset_reason, greeted, dry, request_length, left, code, spoilt;
    uint16_t fill, block, n_items;
    uint32_t sampled_us, last_us, rest_us, uptime_ms, announced_ms, crc, description_crc, sent, dropped, bad_requests;
    const openpatch_description *description;
    const openpatch_hardware *hardware;
    openpatch_module *modules;
    uint8_t request[32], out[256];
    volatile uint8_t head, tail, received[OPENPATCH_RECEIVE_SIZE];
} openpatch;

/* Begin, once output works. modules: an array, one for each module. reset_reason: OPENPATCH_RESET_... */
void openpatch_init(openpatch *op, const openpatch_description *description, const openpatch_hardware *hardware,
                    openpatch_module *modules, uint8_t reset_reason);
/* A byte has arrived. May be called in an interrupt. */
void openpatch_receive(openpatch *op, uint8_t byte);
/* Answer what has arrived, and send what is due. Call it often: at least every 20 ms. */
void openpatch_poll(openpatch *op);
/* Whether the host wants a module's samples. */
int openpatch_wants(const openpatch *op, uint8_t module);
/* Send a new sample of a module, if it is wanted; never one twice. sampled_us: when it was taken. values: as many as
 * its kind has, of its dtype. status: bits for the whole module. each: bits for each value; NULL: all are good. */
void openpatch_send(openpatch *op, uint8_t module, uint32_t sampled_us, const void *values, uint8_t status,
                    const uint8_t *each);
/* Tell people something, in at most 200 bytes. severity: 0 information, 1 warning, 2 error. */
void openpatch_note(openpatch *op, uint8_t severity, const char *text);

#if defined(OPENPATCH_IMPLEMENTATION) && !defined(OPENPATCH_IMPLEMENTED)
#define OPENPATCH_IMPLEMENTED
enum { OP_HELLO = 1, OP_DESCRIBE, OP_START, OP_STOP, OP_PERIOD, OP_ENABLE, OP_TARE, OP_STATUS, OP_LAST_REQUEST = 0x1F, OP_REPLY = 0x40,
       OP_BOOT = 0x60, OP_REPORT, OP_NOTE, OP_DATA = 0x80 };

static uint32_t op_crc(uint32_t crc, uint8_t byte) { /* CRC-32 as of zlib and Ethernet, four bits at a time */
    static const uint32_t table[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
    crc = table[(crc ^ byte) & 15u] ^ (crc >> 4);
    return table[(crc ^ (uint32_t)(byte >> 4)) & 15u] ^ (crc >> 4);
}

/* Sending: a frame is stuffed (COBS) while it is made; what is before the block under way leaves when out is full. */
static void op_emit(openpatch *op, uint8_t byte) {
    if (op->fill == sizeof op->out) {
        op->hardware->write(op->hardware->context, op->out, op->block);
        op->fill = (uint16_t)(op->fill - op->block);
        memmove(op->out, op->out + op->block, op->fill);
        op->block = 0;
    }
    op->out[op->fill++] = byte;
}

static void op_end_block(openpatch *op, int go_on) {
    op->out[op->block] = (uint8_t)(op->fill - op->block);
    op_emit(op, 0); /* the next block's code, known when it ends; or the end of the frame */
    if (go_on) op->block = (uint16_t)(op->fill - 1);
}

static void op_stuff(openpatch *op, uint8_t byte) {
    if (op->fill - op->block == 255) op_end_block(op, 1); /* full: no zero is meant */
    if (byte != 0) op_emit(op, byte); else op_end_block(op, 1);
}

static void op_put(openpatch *op, uint32_t value, int bytes) {
    for (; bytes > 0; bytes--, value >>= 8) {
        op->crc = op_crc(op->crc, (uint8_t)value);
        if (!op->dry) op_stuff(op, (uint8_t)value);
    }
}

static void op_put_float(openpatch *op, float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    op_put(op, bits, 4);
}

static void op_put_text(openpatch *op, const char *text, int in_table) { /* with the NUL that ends it */
    char c;
    do {
        if (in_table) OPENPATCH_COPY(&c, text, 1); else c = *text;
        op_put(op, (uint8_t)c, 1);
        text++;
    } while (c != 0);
}

static int op_has_room(const openpatch *op, size_t payload) {
    const size_t framed = payload + 5 + (payload + 5) / 254 + 2;
    return op->hardware->room == NULL || op->hardware->room(op->hardware->context) >= framed;
}

static void op_begin(openpatch *op, uint8_t type) {
    op->fill = op->block = 0;
    op->crc = 0xFFFFFFFFu;
    op_emit(op, 0);
    op_put(op, type, 1);
}

static void op_end(openpatch *op) {
    op_put(op, ~op->crc, 4);
    op_end_block(op, 0);
    op->hardware->write(op->hardware->context, op->out, op->fill);
}

static void op_put_item(openpatch *op, uint16_t item) {
    const openpatch_description *d = op->description;
    const uint16_t first_kind = (uint16_t)(1 + d->n_types);
    uint8_t i, axis;
    if (item == 0) { /* the patch */
        op_put(op, 1, 1);
        op_put(op, d->period_us, 4);
        op_put(op, d->shortest_period_us, 4);
        op_put(op, d->longest_period_us, 4);
        op_put_text(op, d->product, 0);
        op_put_text(op, d->serial_number, 0);
        op_put_text(op, d->firmware, 0);
    } else if (item < first_kind) {
        openpatch_type type;
        OPENPATCH_COPY(&type, d->types + (item - 1), sizeof type);
        op_put(op, 2, 1);
        op_put(op, type.id, 4);
        op_put_float(op, type.scale);
        op_put_float(op, type.offset);
        op_put_float(op, type.minimum);
        op_put_float(op, type.maximum);
        op_put_text(op, type.name, 1);
        op_put_text(op, type.unit, 1);
    } else if (item < first_kind + d->n_kinds) {
        openpatch_kind kind;
        OPENPATCH_COPY(&kind, d->kinds + (item - first_kind), sizeof kind);
        op_put(op, 3, 1);
        op_put_text(op, kind.name, 1);
        op_put(op, kind.dtype, 1);
        op_put(op, kind.n_runs, 1);
        for (i = 0; i < kind.n_runs; i++) {
            openpatch_run run;
            OPENPATCH_COPY(&run, kind.runs + i, sizeof run);
            op_put(op, run.count, 2);
            op_put(op, run.n_axes, 1);
            for (axis = 0; axis < run.n_axes; axis++) op_put(op, run.axes[axis], 1);
        }
    } else { /* the modules */
        op_put(op, 4, 1);
        op_put(op, d->n_modules, 1);
        for (i = 0; i < d->n_modules; i++) {
            openpatch_modules modules;
            OPENPATCH_COPY(&modules, d->modules + i, sizeof modules);
            op_put(op, modules.kind, 1);
            op_put(op, modules.count, 1);
        }
    }
}

static void op_put_greeting(openpatch *op) {
    op_put(op, 1, 1); /* major version */
    op_put(op, 0, 1); /* minor version */
    op_put(op, op->reset_reason, 1);
    op_put(op, op->streaming, 1);
    op_put(op, op->uptime_ms, 4);
    op_put(op, op->description_crc, 4);
    op_put(op, op->n_items, 2);
}

static void op_put_report(openpatch *op) {
    op_put(op, op->uptime_ms, 4);
    op_put(op, op->sent, 4);
    op_put(op, op->dropped, 4);
    op_put(op, op->bad_requests, 4);
}

static uint8_t op_find_kind(const openpatch *op, uint8_t module, uint8_t *size, uint16_t *n_values) {
    openpatch_modules modules;
    openpatch_kind kind;
    openpatch_run run;
    uint8_t i;
    for (i = 0;; i++, module = (uint8_t)(module - modules.count)) {
        OPENPATCH_COPY(&modules, op->description->modules + i, sizeof modules);
        if (module < modules.count) break;
    }
    OPENPATCH_COPY(&kind, op->description->kinds + modules.kind, sizeof kind);
    *size = (uint8_t)(kind.dtype == OPENPATCH_U8 ? 1 : kind.dtype <= OPENPATCH_U16 ? 2 : 4);
    for (*n_values = 0, i = 0; i < kind.n_runs; i++) {
        OPENPATCH_COPY(&run, kind.runs + i, sizeof run);
        *n_values = (uint16_t)(*n_values + run.count * run.n_axes);
    }
    return modules.kind;
}

static void op_send(openpatch *op, uint8_t module, uint32_t us, const void *values, uint8_t status,
                    const uint8_t *each) { /* values NULL: zeros */
    const uint8_t *from = (const uint8_t *)values;
    uint8_t size, kind;
    uint16_t n, i, sequence = op->modules[module].sequence++;
    op->sampled_us = us;
    kind = op_find_kind(op, module, &size, &n);
    if (!op_has_room(op, 8u + (size_t)n * (size_t)(size + (each != NULL)))) {
        op->dropped++;
        return;
    }
    op_begin(op, (uint8_t)(OP_DATA + kind));
    op_put(op, module, 1);
    op_put(op, sequence, 2);
    op_put(op, us, 4);
    op_put(op, status, 1);
    for (i = 0; i < n; i++) {
        uint32_t value = 0;
        uint16_t two;
        if (from != NULL) {
            if (size == 1) value = *from; else if (size == 4) memcpy(&value, from, 4);
            else { memcpy(&two, from, 2); value = two; }
            from += size;
        }
        op_put(op, value, size);
    }
    for (i = 0; each != NULL && i < n; i++) op_put(op, each[i], 1);
    op_end(op);
    op->sent++;
}

static void op_switch(openpatch *op, uint8_t module, uint8_t enabled) { /* what is off says so once, and is silent */
    op->modules[module].enabled = enabled;
    if (op->streaming && !enabled) op_send(op, module, op->sampled_us, NULL, OPENPATCH_MASKED, NULL);
}

static uint32_t op_read32(const uint8_t *bytes) {
    return bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static void op_answer(openpatch *op, uint8_t type, const uint8_t *a, uint8_t length) { /* a: arguments */
    static const uint8_t needed[] = {0, 2, 2, 4, 0, 4, 2, 1, 0};
    const openpatch_description *d = op->description;
    uint8_t error = OPENPATCH_OK, i;
    uint16_t item = 0;
    if (type > OP_STATUS) error = OPENPATCH_UNKNOWN_REQUEST;
    else if (length < 1 + needed[type]) error = OPENPATCH_BAD_LENGTH;
    else switch (type) {
    case OP_HELLO: case OP_STATUS: break;
    case OP_DESCRIBE:
        item = (uint16_t)(a[1] | (unsigned)a[2] << 8);
        if (item >= op->n_items) error = OPENPATCH_NO_SUCH;
        break;
    case OP_START:
        if (op_read32(a + 1) != op->description_crc) { error = OPENPATCH_OTHER_DESCRIPTION; break; }
        op->streaming = 1;
        op->sampled_us = op->last_us;
        op->announced_ms = op->uptime_ms;
        break;
    case OP_STOP: op->streaming = 0; break;
    case OP_PERIOD:
        if (op_read32(a + 1) < d->shortest_period_us || op_read32(a + 1) > d->longest_period_us)
            error = OPENPATCH_BAD_VALUE;
        else if (op->hardware->set_period != NULL)
            op->period_us = op->hardware->set_period(op->hardware->context, op_read32(a + 1));
        else op->period_us = op_read32(a + 1);
        break;
    default: /* OP_ENABLE, OP_TARE */
        if (a[1] != OPENPATCH_ALL && a[1] >= op->n_modules) error = OPENPATCH_NO_SUCH;
        else if (type == OP_TARE)
            error = op->hardware->tare ? op->hardware->tare(op->hardware->context, a[1])
                                          : (uint8_t)OPENPATCH_NOT_SUPPORTED;
    }
    op_begin(op, (uint8_t)(OP_REPLY + type));
    op_put(op, a[0], 1);
    op_put(op, error, 1);
    if (error != OPENPATCH_OK) type = 0; /* nothing more to be said or done */
    if (type == OP_HELLO) op_put_greeting(op);
    if (type == OP_STATUS) op_put_report(op);
    if (type == OP_PERIOD) op_put(op, op->period_us, 4);
    if (type == OP_DESCRIBE) { op_put(op, item, 2); op_put_item(op, item); }
    op_end(op);
    for (i = 0; i < op->n_modules; i++) {
        if (type == OP_START) op_switch(op, i, op->modules[i].enabled);
        if (type == OP_ENABLE && (a[1] == i || a[1] == OPENPATCH_ALL)) op_switch(op, i, a[2] != 0);
    }
}

static void op_take_frame(openpatch *op) {
    const uint8_t n = op->request_length;
    uint32_t crc = 0xFFFFFFFFu;
    uint8_t i;
    for (i = 0; i + 4 < n; i++) crc = op_crc(crc, op->request[i]);
    if (op->left != 0 || op->spoilt || n < 6 || op_read32(op->request + n - 4) != ~crc) {
        op->bad_requests++;
        return;
    }
    if (op->request[0] == 0 || op->request[0] > OP_LAST_REQUEST) return; /* none: the line may have an echo */
    op->greeted = 1;
    op_answer(op, op->request[0], op->request + 1, (uint8_t)(n - 5));
}

static void op_keep(openpatch *op, uint8_t byte) {
    if (op->request_length < sizeof op->request) op->request[op->request_length++] = byte; else op->spoilt = 1;
}

static void op_take(openpatch *op, uint8_t byte) { /* unstuffs what arrives */
    if (byte == 0) {
        if (op->code != 0) op_take_frame(op); /* else: nothing between two zeros */
        op->code = op->left = op->request_length = op->spoilt = 0;
    } else if (op->left == 0) {
        if (op->code != 0 && op->code != 255) op_keep(op, 0);
        op->code = byte;
        op->left = (uint8_t)(byte - 1);
    } else {
        op_keep(op, byte);
        op->left--;
    }
}

void openpatch_init(openpatch *op, const openpatch_description *description, const openpatch_hardware *hardware,
                    openpatch_module *modules, uint8_t reset_reason) {
    openpatch_modules of_kind;
    uint16_t item;
    uint8_t i;
    memset(op, 0, sizeof *op);
    op->description = description;
    op->hardware = hardware;
    op->modules = modules;
    op->reset_reason = reset_reason;
    op->period_us = description->period_us;
    for (i = 0; i < description->n_modules; i++) {
        OPENPATCH_COPY(&of_kind, description->modules + i, sizeof of_kind);
        op->n_modules = (uint8_t)(op->n_modules + of_kind.count);
    }
    for (i = 0; i < op->n_modules; i++) { modules[i].sequence = 0; modules[i].enabled = 1; }
    op->n_items = (uint16_t)(2 + description->n_types + description->n_kinds);
    op->crc = 0xFFFFFFFFu;
    op->dry = 1; /* nothing is sent: only the CRC is of interest */
    for (item = 0; item < op->n_items; item++) op_put_item(op, item);
    op->dry = 0;
    op->description_crc = ~op->crc;
    op->last_us = hardware->now_us(hardware->context);
    op->announced_ms = (uint32_t)-1000; /* at once */
}

void openpatch_receive(openpatch *op, uint8_t byte) {
    const uint8_t next = (uint8_t)((op->head + 1) & (OPENPATCH_RECEIVE_SIZE - 1));
    if (next == op->tail) return; /* full: the frame will be refused by its CRC and asked for again */
    op->received[op->head] = byte;
    op->head = next;
}

void openpatch_poll(openpatch *op) {
    const uint32_t us = op->hardware->now_us(op->hardware->context);
    op->rest_us += us - op->last_us;
    op->last_us = us;
    op->uptime_ms += op->rest_us / 1000;
    op->rest_us %= 1000;
    while (op->tail != op->head) {
        op_take(op, op->received[op->tail]);
        op->tail = (uint8_t)((op->tail + 1) & (OPENPATCH_RECEIVE_SIZE - 1));
    }
    if (op->uptime_ms - op->announced_ms < 1000 || (op->greeted && !op->streaming)) return;
    op->announced_ms = op->uptime_ms;
    if (!op_has_room(op, 16)) return;
    op_begin(op, op->streaming ? OP_REPORT : OP_BOOT);
    if (op->streaming) op_put_report(op); else op_put_greeting(op);
    op_end(op);
}

int openpatch_wants(const openpatch *op, uint8_t module) {
    return op->streaming && module < op->n_modules && op->modules[module].enabled;
}

void openpatch_send(openpatch *op, uint8_t module, uint32_t sampled_us, const void *values, uint8_t status,
                    const uint8_t *each) {
    if (openpatch_wants(op, module)) op_send(op, module, sampled_us, values, status, each);
}

void openpatch_note(openpatch *op, uint8_t severity, const char *text) {
    size_t n = strlen(text);
    if (n > 200) n = 200;
    if (!op_has_room(op, 1 + n)) return;
    op_begin(op, OP_NOTE);
    op_put(op, severity, 1);
    for (; n > 0; n--) op_put(op, (uint8_t)*text++, 1);
    op_end(op);
}
#endif /* OPENPATCH_IMPLEMENTATION */
#ifdef __cplusplus
}
#endif
#endif /* OPENPATCH_H */

/* openpatch.h - the open patch protocol for the microcontroller of a skin patch, in C99 or C++11.
 *
 * docs/protocols/patch-serial.md is the protocol, docs/how-to/openpatch.md leads from nothing to live data. One source
 * file says #define OPENPATCH_IMPLEMENTATION before it includes this. You describe the patch in tables, and in the main
 * loop call openpatch_poll, and openpatch_send for each sample. Nothing is allocated.
 *
 * Copyright: the Skinware authors. SPDX-License-Identifier: Apache-2.0 */
#ifndef OPENPATCH_H
#define OPENPATCH_H
#include <stdint.h>
#include <string.h>
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "openpatch.h is for little-endian processors: numbers are sent as they lie in memory"
#endif
#ifdef __cplusplus
extern "C" {
#endif

#define OPENPATCH_ALL 0xFF     /* as a module: every one */
#define OPENPATCH_PADDING 0xFF /* as an axis: a value that is sent and means nothing */
#define OPENPATCH_TABLE(table) (uint8_t)(sizeof(table) / sizeof(table)[0]), table
#define OPENPATCH_MODULE(kind) {kind, 0, 0, 0}

enum { OPENPATCH_U8, OPENPATCH_I16, OPENPATCH_U16, OPENPATCH_I32, OPENPATCH_F32 }; /* dtypes */
enum { /* status: what is wrong with a module or a value, as bits; 0 means fresh and good */
    OPENPATCH_OLD = 2,            /* not of this sample */
    OPENPATCH_OUT_OF_RANGE = 4,   /* the truth lies beyond what the hardware can express */
    OPENPATCH_NO_ACK = 8,         /* the transducer does not answer */
    OPENPATCH_NOT_CONNECTED = 16, /* there is no transducer */
    OPENPATCH_MASKED = 32,        /* switched off */
    OPENPATCH_SUSPECT = 64        /* doubtful: a self-test failed, the baseline moved ... */
};
enum { OPENPATCH_RESET_UNKNOWN, OPENPATCH_RESET_POWER, OPENPATCH_RESET_PIN, OPENPATCH_RESET_WATCHDOG,
       OPENPATCH_RESET_BROWN_OUT, OPENPATCH_RESET_SOFTWARE, OPENPATCH_RESET_FAULT };
enum { OPENPATCH_OK, OPENPATCH_UNKNOWN_REQUEST, OPENPATCH_BAD_LENGTH, OPENPATCH_NO_SUCH, OPENPATCH_BAD_VALUE,
       OPENPATCH_BUSY, OPENPATCH_FAILED, OPENPATCH_NOT_SUPPORTED, OPENPATCH_OTHER_DESCRIPTION };

typedef struct { /* a type of sensor: physical value = offset + scale * raw, in unit */
    uint32_t id; /* vendor << 12 | number; vendor 0 is the shared catalogue: 1 pressure ... */
    float scale, offset, minimum, maximum; /* the last two: physical; equal if not known */
    const char *name, *unit;               /* at most 32 and 16 bytes */
} openpatch_type;

typedef struct { /* taxels that are alike: count times the axes x0 y0 z0 x1 y1 z1 ... */
    uint16_t count;
    uint8_t n_axes, axes[9]; /* places in the table of types, or OPENPATCH_PADDING */
} openpatch_run;

typedef struct { /* a kind of module */
    uint8_t dtype;                             /* of all its values: OPENPATCH_U8 ... */
    uint8_t n_runs; const openpatch_run *runs; /* OPENPATCH_TABLE(runs), in the order of the values */
    const char *name;                          /* at most 16 bytes */
} openpatch_kind;

typedef struct { /* a module: OPENPATCH_MODULE(its place in the table of kinds) */
    uint8_t kind, off, told; /* told: the host knows that it is off */
    uint16_t sequence;
} openpatch_module;

typedef struct { /* what the patch is, and what it needs of its hardware */
    uint32_t period_us, shortest_us, longest_us;    /* at first, and what can be set */
    const char *product, *serial_number, *firmware; /* at most 32 bytes each */
    uint8_t n_types; const openpatch_type *types;   /* each pair: OPENPATCH_TABLE(types) and so on */
    uint8_t n_kinds; const openpatch_kind *kinds;
    uint8_t n_modules; openpatch_module *modules;   /* not const: their state is kept here */
    int (*read)(void);                              /* the next byte received; -1: none */
    void (*write)(const uint8_t *bytes, size_t n);  /* send or queue all of them */
    uint32_t (*now_us)(void);                       /* a clock, in microseconds; wraps at 2^32 */
    size_t (*room)(void);                /* or NULL: bytes that write takes without waiting */
    uint32_t (*set_period)(uint32_t us); /* or NULL: -> the period that it became */
    uint8_t (*tare)(uint8_t module);     /* or NULL: when done -> OPENPATCH_OK, OPENPATCH_FAILED ... */
} openpatch_description;

typedef struct {
    uint32_t period_us; /* yours to read: sample every module once in this time */
    /* These two are as they are sent. greeting.streaming is yours to read, too: whether the host wants samples. */
    struct { uint8_t major, minor, reset_reason, streaming; uint32_t uptime_ms, crc; uint16_t n_items; } greeting;
    struct { uint32_t uptime_ms, sent, dropped, damaged; } report;
    const openpatch_description *description;
    uint32_t counted_us, due_ms, crc;
    uint16_t block, fill; /* of out: where the block began, and where it goes on; fill 0: no frame */
    uint8_t greeted, n_received, received[32], out[64 + 255];
} openpatch;

/* Begin, once output works. reset_reason: OPENPATCH_RESET_... */
void openpatch_init(openpatch *op, const openpatch_description *description, uint8_t reset_reason);
/* Answer what has arrived, and send what is due. Call it often: at least every 20 ms. */
void openpatch_poll(openpatch *op);
/* Take a new sample of a module, also of one that is off; never one twice. sampled_us: when it was taken. values: as
 * many as its kind has. status: bits for the whole module. each: bits for each value; NULL: all are good. */
void openpatch_send(openpatch *op, uint8_t module, uint32_t sampled_us, const void *values,
                    uint8_t status, const uint8_t *each);
/* Tell people something, in at most 200 bytes. severity: 0 information, 1 warning, 2 error. */
void openpatch_note(openpatch *op, uint8_t severity, const char *text);

#ifdef OPENPATCH_IMPLEMENTATION
enum { OP_HELLO = 1, OP_DESCRIBE, OP_START, OP_STOP, OP_PERIOD, OP_ENABLE, OP_TARE, OP_STATUS };
enum { OP_MAX_REQUEST = 0x1F, OP_REPLY = 0x40, OP_BOOT = 0x60, OP_REPORT, OP_NOTE, OP_DATA = 0x80 };

static uint32_t op_crc(uint32_t crc, uint8_t byte) { /* of zlib and Ethernet, four bits at a time */
    static const uint32_t table[16] = {
        0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
        0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C, 0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C};
    crc = table[(crc ^ byte) & 15] ^ crc >> 4;
    return table[(crc ^ byte >> 4) & 15] ^ crc >> 4;
}

/* COBS: a block is a byte that tells where the next zero is, and up to 254 bytes that are none. */
static void op_next_block(openpatch *op) {
    op->out[op->block] = (uint8_t)(op->fill - op->block);
    if (op->fill > sizeof op->out - 255) { /* another one might not fit */
        op->description->write(op->out, op->fill);
        op->fill = 0;
    }
    op->block = op->fill++;
}

static void op_put(openpatch *op, const void *bytes, size_t n) {
    for (const uint8_t *byte = (const uint8_t *)bytes; n > 0; n--, byte++) {
        op->crc = op_crc(op->crc, *byte);
        if (op->fill == 0) continue; /* only the CRC is of interest */
        if (op->fill - op->block == 255) op_next_block(op); /* full: no zero is meant */
        if (*byte == 0) op_next_block(op);
        else op->out[op->fill++] = *byte;
    }
}

static void op_put_text(openpatch *op, const char *text) {
    do op_put(op, text, 1);
    while (*text++ != 0);
}

static int op_begin(openpatch *op, uint8_t type, size_t payload) { /* -> whether there is room */
    op->block = 0;
    op->fill = 1;
    op->crc = 0xFFFFFFFF;
    op_put(op, &type, 1);
    return op->description->room == NULL || op->description->room() >= payload + (payload + 5) / 254 + 7;
}

static void op_end(openpatch *op) {
    const uint32_t crc = ~op->crc;
    op_put(op, &crc, 4);
    op_next_block(op);
    op->out[op->block] = 0; /* in its place: the end of the frame */
    op->description->write(op->out, op->fill);
}

static void op_put_item(openpatch *op, unsigned item) { /* of the description */
    const openpatch_description *d = op->description;
    const unsigned first_kind = 1u + d->n_types, after_kinds = first_kind + d->n_kinds;
    const uint8_t tag = item == 0 ? 1 : item < first_kind ? 2 : item < after_kinds ? 3 : 4;
    op_put(op, &tag, 1);
    if (tag == 1) {
        op_put(op, d, 12); /* the periods */
        op_put_text(op, d->product);
        op_put_text(op, d->serial_number);
        op_put_text(op, d->firmware);
    } else if (tag == 2) {
        const openpatch_type *type = &d->types[item - 1];
        op_put(op, type, 20); /* its numbers */
        op_put_text(op, type->name);
        op_put_text(op, type->unit);
    } else if (tag == 3) {
        const openpatch_kind *kind = &d->kinds[item - first_kind];
        op_put_text(op, kind->name);
        op_put(op, kind, 2); /* dtype, n_runs */
        for (uint8_t i = 0; i < kind->n_runs; i++) op_put(op, &kind->runs[i], 3u + kind->runs[i].n_axes);
    } else {
        op_put(op, &d->n_modules, 1);
        for (uint8_t i = 0; i < d->n_modules; i++) {
            const uint8_t entry[] = {d->modules[i].kind, 1}; /* one of this kind */
            op_put(op, entry, 2);
        }
    }
}

static uint8_t op_obey(openpatch *op, uint8_t type, const uint8_t *arguments, unsigned n) { /* -> how that went */
    static const uint8_t needed[] = {0, 2, 2, 4, 0, 4, 2, 1, 0}; /* bytes of arguments */
    const openpatch_description *d = op->description;
    const uint8_t module = arguments[0], is_all = module == OPENPATCH_ALL;
    uint32_t value = 0;
    if (type > OP_STATUS) return OPENPATCH_UNKNOWN_REQUEST;
    if (n < needed[type]) return OPENPATCH_BAD_LENGTH;
    memcpy(&value, arguments, needed[type]);
    if (type == OP_DESCRIBE && value >= op->greeting.n_items) return OPENPATCH_NO_SUCH;
    if (type == OP_START && value != op->greeting.crc) return OPENPATCH_OTHER_DESCRIPTION;
    if (type == OP_PERIOD && (value < d->shortest_us || value > d->longest_us)) return OPENPATCH_BAD_VALUE;
    if ((type == OP_ENABLE || type == OP_TARE) && module >= d->n_modules && !is_all) return OPENPATCH_NO_SUCH;
    if (type == OP_START || type == OP_STOP) op->greeting.streaming = type == OP_START;
    if (type == OP_PERIOD) op->period_us = d->set_period == NULL ? value : d->set_period(value);
    if (type == OP_TARE) return d->tare == NULL ? (uint8_t)OPENPATCH_NOT_SUPPORTED : d->tare(module);
    for (uint8_t i = 0; i < d->n_modules; i++) {
        if (type == OP_ENABLE && (module == i || is_all)) d->modules[i].off = arguments[1] == 0;
        if (type == OP_START) d->modules[i].told = 0;
    }
    return OPENPATCH_OK;
}

static void op_answer(openpatch *op, unsigned n_arguments) {
    const uint8_t type = op->received[1], *arguments = op->received + 3;
    const uint8_t error = op_obey(op, type, arguments, n_arguments);
    const uint8_t done = error == OPENPATCH_OK ? type : 0;
    op->greeted = 1;
    op_begin(op, (uint8_t)(OP_REPLY + type), 0); /* the host waits for it: room or not */
    op_put(op, op->received + 2, 1);
    op_put(op, &error, 1);
    if (done == OP_HELLO) op_put(op, &op->greeting, 14);
    if (done == OP_DESCRIBE) op_put(op, arguments, 2);
    if (done == OP_DESCRIBE) op_put_item(op, arguments[0] | (unsigned)arguments[1] << 8);
    if (done == OP_PERIOD) op_put(op, &op->period_us, 4);
    if (done == OP_STATUS) op_put(op, &op->report, 16);
    op_end(op);
}

static void op_take(openpatch *op, uint8_t byte) { /* a byte received: of a request, or its end */
    const uint8_t n = op->n_received;
    uint8_t next = op->received[0];
    uint32_t crc = 0xFFFFFFFF;
    if (byte != 0 && n < sizeof op->received) op->received[op->n_received++] = byte;
    if (byte != 0 || n == 0) return;
    op->n_received = 0;
    for (uint8_t i = 1; i < n; i++) { /* COBS again; no request is as long as a block can be */
        if (i == next) {
            next = (uint8_t)(next + op->received[i]);
            op->received[i] = 0;
        }
        crc = op_crc(crc, op->received[i]);
    }
    if (n < 7 || next != n || crc != 0xDEBB20E3) op->report.damaged++; /* as of all good frames */
    else if (op->received[1] >= 1 && op->received[1] <= OP_MAX_REQUEST) op_answer(op, n - 7u);
}

void openpatch_init(openpatch *op, const openpatch_description *description, uint8_t reset_reason) {
    for (size_t i = 0; i < sizeof *op; i++) ((uint8_t *)op)[i] = 0;
    op->description = description;
    op->period_us = description->period_us;
    op->greeting.major = 1;
    op->greeting.reset_reason = reset_reason;
    op->greeting.n_items = (uint16_t)(2 + description->n_types + description->n_kinds);
    op->crc = 0xFFFFFFFF;
    for (unsigned i = 0; i < op->greeting.n_items; i++) op_put_item(op, i);
    op->greeting.crc = ~op->crc;
    op->counted_us = description->now_us();
}

void openpatch_poll(openpatch *op) {
    const uint32_t ms = (op->description->now_us() - op->counted_us) / 1000;
    op->counted_us += 1000 * ms;
    op->report.uptime_ms += ms;
    op->greeting.uptime_ms = op->report.uptime_ms;
    for (int byte; (byte = op->description->read()) >= 0;) op_take(op, (uint8_t)byte);
    if ((int32_t)(op->report.uptime_ms - op->due_ms) < 0) return;
    op->due_ms = op->report.uptime_ms + 1000; /* the next announcement, if there is one */
    if (op->greeted && !op->greeting.streaming) return;
    if (!op_begin(op, op->greeting.streaming ? OP_REPORT : OP_BOOT, 16)) return;
    if (op->greeting.streaming) op_put(op, &op->report, 16);
    else op_put(op, &op->greeting, 14);
    op_end(op);
}

void openpatch_send(openpatch *op, uint8_t number, uint32_t sampled_us, const void *values,
                    uint8_t status, const uint8_t *each) {
    static const uint8_t sizes[] = {1, 2, 2, 4, 4};
    openpatch_module *module = &op->description->modules[number];
    const openpatch_kind *kind = &op->description->kinds[module->kind];
    size_t n = 0, size;
    if (!op->greeting.streaming || (module->off && module->told)) return;
    for (uint8_t i = 0; i < kind->n_runs; i++) n += (size_t)kind->runs[i].count * kind->runs[i].n_axes;
    size = n * sizes[kind->dtype];
    if (module->off) status = OPENPATCH_MASKED;
    if (op_begin(op, (uint8_t)(OP_DATA + module->kind), 8 + size + (each == NULL ? 0 : n))) {
        op_put(op, &number, 1);
        op_put(op, &module->sequence, 2);
        op_put(op, &sampled_us, 4);
        op_put(op, &status, 1);
        op_put(op, values, size);
        if (each != NULL) op_put(op, each, n);
        op_end(op);
        op->report.sent++;
        module->told = module->off;
    } else {
        op->report.dropped++;
    }
    module->sequence++;
}

void openpatch_note(openpatch *op, uint8_t severity, const char *text) {
    size_t n = 0;
    while (n < 200 && text[n] != 0) n++;
    if (!op_begin(op, OP_NOTE, 1 + n)) return;
    op_put(op, &severity, 1);
    op_put(op, text, n);
    op_end(op);
}
#endif /* OPENPATCH_IMPLEMENTATION */
#ifdef __cplusplus
}
#endif
#endif /* OPENPATCH_H */

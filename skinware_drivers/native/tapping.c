/* Keeps what comes over a wire while somebody wants it: wire_tap.py, and skinware/wire.py for what a piece is. */
#include "flow.h"

enum { CLASSIC = 1, FD, BYTES, MOST_BYTES = 1 << 14, CLASSIC_PAYLOAD = 8 };
enum { HEADER = 8, FD_FRAME = 72, LENGTH = 4, FLAGS = 5, IS_CUT = 0x80 }; /* of a frame's row */

struct piece {
    uint32_t size, count;
    uint8_t form, is_sent, reserved[6];
};

/* Begin a piece with so many bytes behind its head: where they go, NULL: there is no room. */
static uint8_t *begin_piece(struct tap *tap, uint8_t form, int64_t count, int64_t n_bytes, bool is_sent)
{
    struct piece head = {.count = (uint32_t)count, .form = form, .is_sent = is_sent};
    uint8_t *at = tap->bytes + tap->size;
    int64_t size = (int64_t)sizeof head + n_bytes;
    if (tap->size + size > tap->room) {
        tap->missed += count;
        return NULL;
    }
    head.size = (uint32_t)size;
    memcpy(at, &head, sizeof head);
    tap->size += size;
    return at + sizeof head;
}

/* Rows of the batch as they came, before anything is sorted out. */
void keep_frames(struct tap *tap, const struct batch *batch, int64_t first, int64_t n)
{
    int64_t known = batch->payload_size, size = known == CLASSIC_PAYLOAD ? HEADER + CLASSIC_PAYLOAD : FD_FRAME;
    size_t times = (size_t)n * sizeof *batch->time_ns;
    uint8_t *at = begin_piece(tap, known == CLASSIC_PAYLOAD ? CLASSIC : FD, n, (int64_t)times + n * size, false);
    if (!at)
        return;
    memcpy(at, batch->time_ns + first, times);
    at += times;
    for (int64_t i = 0; i < n; i++, at += size) {
        const uint8_t *row = batch->wire + (first + i) * batch->row_bytes;
        int64_t length = row[LENGTH] < known ? row[LENGTH] : known;
        memset(at, 0, (size_t)size); /* behind a short frame there is what was there before */
        memcpy(at, row, (size_t)(HEADER + length));
        memset(at + FLAGS + 1, 0, HEADER - FLAGS - 1);
        at[LENGTH] = (uint8_t)length;
        at[FLAGS] |= row[LENGTH] > known ? IS_CUT : 0;
    }
}

void keep_bytes(struct tap *tap, const uint8_t *bytes, int64_t n, int64_t time_ns, bool is_sent)
{
    for (; n > 0; n -= MOST_BYTES, bytes += MOST_BYTES) {
        int64_t some = n < MOST_BYTES ? n : MOST_BYTES, filled = (some + 7) / 8 * 8;
        uint8_t *at = begin_piece(tap, BYTES, some, (int64_t)sizeof time_ns + filled, is_sent);
        if (!at)
            continue;
        memcpy(at, &time_ns, sizeof time_ns);
        memcpy(at + sizeof time_ns, bytes, (size_t)some);
        memset(at + sizeof time_ns + some, 0, (size_t)(filled - some));
    }
}

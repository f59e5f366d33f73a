/* Bytes of a serial line on their way to rows of a batch. */
#ifndef SKINWARE_DRIVERS_FRAMING_H
#define SKINWARE_DRIVERS_FRAMING_H

#include "inside.h"

enum { SHORT_PAYLOAD = 64 }; /* longer ones have a length of 4 bytes in their rows */

enum checksum_form { EXCLUSIVE_OR, SUM, CRC_FROM_HIGH, CRC_FROM_LOW };

struct checksum { /* size 0: there is none */
    int64_t form, size, is_big, width, init, mask, xor_out, is_negative, is_reversed;
    const uint32_t *table; /* (256,) */
};

struct wire_field { /* a whole number in a header; size 0: there is none, which is 0 */
    int64_t offset, size, is_big, mask;
};

enum framing_form { PACKETS, LINES, COBS, ESCAPED };

struct framing { /* how frames lie in a stream of bytes; patterns: (n, 256) bool */
    int64_t form, body_start, shortest, longest; /* of a packet, or of what stands between delimiters */
    struct checksum checksum;
    struct wire_field identifier;

    int64_t delimiter, escape, longest_segment;
    const int16_t *meaning; /* (256,) of a byte after an escape; -1: none */

    int64_t n_sync, n_trailer;
    const uint8_t *sync, *trailer;
    struct wire_field length;
    int64_t more, bare;
    const int64_t *totals; /* (256,) of each value of the length, 0: it cannot be; NULL: bytes are counted */
    const struct wire_field *lengths; /* (256,) with `totals`: what more each value says */
    int64_t behind, known_from, look_ahead, confirms_each;
    int64_t checksum_at, covered_from, covered_to; /* from the beginning; negative, and `covered_to`: from the end */
};

struct reading { /* until where, and when; the stream's bytes are counted from its beginning */
    int64_t end, time_ns;
};

struct stream {
    const struct framing *framing;
    int64_t fd, payload_size; /* of bodies, at most */
    uint8_t *bytes, *content; /* room for what may be undecided and a chunk; for what stands between delimiters */
    int64_t size, place, before; /* bytes there are, until where they are decided, bytes before all of them */
    int64_t follows_at, is_discarding, is_behind; /* is_behind: there may be more frames in what has come */
    uint8_t *false_marks; /* (longest,) at each offset of frames: in how many frames in a row */
    int64_t n_false_marks;
    struct reading *reads; /* what is not decided yet came then */
    int64_t n_reads;
    const uint8_t *chunk; /* what came last; is_good: a frame was found since, is_damaged: something else was */
    int64_t chunk_bytes, is_good, is_damaged;
    int64_t frames, too_long; /* handed on; not */
    int64_t bytes_in, frame_bytes, idle_bytes, skipped_bytes, found, checksum_errors, bad_form;
};

uint8_t *begin_chunk(struct stream *stream);
void end_chunk(struct stream *stream, int64_t n, int64_t time_ns);
void append_row(struct batch *batch, int64_t bus, int64_t identifier, const uint8_t *body, int64_t size,
                int64_t time_ns);
SKINWARE_EXPORT int64_t skinware_stream_fill(struct stream *stream, struct batch *batch, int64_t bus);

#endif

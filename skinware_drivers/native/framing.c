/* Finds frames in the bytes of a serial line: serial/packets.py, delimited.py, checksums.py, stream.py;
 * its specification is tests/specification/framers.py. */
#include "framing.h"

struct found { /* a frame */
    const uint8_t *body;
    int64_t size, identifier, end; /* end: bytes of the stream up to its end */
};

enum verdict { GOOD, BAD, INCOMPLETE };

static int64_t read_field(const struct wire_field *field, const uint8_t *frame)
{
    uint32_t value = 0;
    for (int64_t i = 0; i < field->size; i++) {
        int64_t place = field->is_big ? i : field->size - 1 - i;
        value = value << 8 | frame[field->offset + place];
    }
    return value & (uint32_t)field->mask;
}

static uint32_t reversed(uint32_t value, int64_t width)
{
    uint32_t result = 0;
    for (int64_t bit = 0; bit < width; bit++)
        result |= (value >> bit & 1) << (width - 1 - bit);
    return result;
}

static uint32_t checksum_of(const struct checksum *checksum, const uint8_t *data, int64_t n)
{
    uint32_t state = (uint32_t)checksum->init, mask = (uint32_t)checksum->mask;
    switch (checksum->form) {
    case EXCLUSIVE_OR:
        for (int64_t i = 0; i < n; i++)
            state ^= data[i];
        return state;
    case SUM:
        for (int64_t i = 0; i < n; i++)
            state += data[i];
        return (checksum->is_negative ? 0 - state : state) & mask;
    case CRC_FROM_LOW:
        for (int64_t i = 0; i < n; i++)
            state = checksum->table[(state ^ data[i]) & 0xFF] ^ state >> 8;
        break;
    default:
        for (int64_t i = 0; i < n; i++)
            state = (state << 8 & mask) ^ checksum->table[(state >> (checksum->width - 8) ^ data[i]) & 0xFF];
    }
    return (checksum->is_reversed ? reversed(state, checksum->width) : state) ^ (uint32_t)checksum->xor_out;
}

static bool is_right(const struct checksum *checksum, const uint8_t *data, int64_t n, const uint8_t *sent)
{
    const struct wire_field field = {0, checksum->size, checksum->is_big, UINT32_MAX};
    return checksum_of(checksum, data, n) == read_field(&field, sent);
}

static void skip_bytes(struct stream *stream, int64_t n)
{
    stream->skipped_bytes += n;
    stream->place += n;
}

static bool find(struct stream *stream, const uint8_t *body, int64_t size, int64_t identifier, struct found *found)
{
    found->body = body;
    found->size = size > 0 ? size : 0;
    found->identifier = identifier;
    found->end = stream->before + stream->place;
    return true;
}

/* -- frames that begin with a pattern ------------------------------------------------------------------------------ */

/* How many of n bytes fit a pattern, which is as long or longer. */
static int64_t fitting(const uint8_t *pattern, const uint8_t *bytes, int64_t n)
{
    int64_t i = 0;
    while (i < n && pattern[256 * i + bytes[i]])
        i++;
    return i;
}

static bool fits(const uint8_t *pattern, int64_t n_pattern, const uint8_t *bytes, int64_t n)
{
    return n >= n_pattern && fitting(pattern, bytes, n_pattern) == n_pattern;
}

/* The next place at which the stream goes on, or ends, as frames begin. */
static int64_t beginning(const struct framing *framing, const struct stream *stream)
{
    for (int64_t place = stream->place; place < stream->size; place++) {
        int64_t left = stream->size - place, wanted = left < framing->n_sync ? left : framing->n_sync;
        if (fitting(framing->sync, stream->bytes + place, wanted) == wanted)
            return place;
    }
    return stream->size;
}

/* Bytes of the frame that begins here, at least: while its length is not there; 0: it cannot be. */
static int64_t total_of(const struct framing *framing, const uint8_t *frame, int64_t left, bool *is_bare)
{
    int64_t says, total;
    *is_bare = false;
    if (!framing->length.size)
        return framing->longest;
    says = read_field(&framing->length, frame);
    if (framing->totals) {
        const struct wire_field *length = framing->lengths + says;
        if (length->size && left < length->offset + length->size)
            return length->offset + length->size;
        total = framing->totals[says] + read_field(length, frame);
    } else {
        *is_bare = !says && framing->bare;
        total = says + framing->more - (*is_bare ? framing->bare : 0);
    }
    return total >= framing->shortest && total <= framing->longest ? total : 0;
}

static bool ends(const struct framing *framing, const uint8_t *end)
{
    return fits(framing->trailer, framing->n_trailer, end - framing->n_trailer, framing->n_trailer);
}

static bool has_checksum(const struct framing *framing, const uint8_t *frame, int64_t total)
{
    int64_t from = framing->covered_from, to = total + framing->covered_to;
    int64_t at = (framing->checksum_at < 0 ? total : 0) + framing->checksum_at;
    return !framing->checksum.size || is_right(&framing->checksum, frame + from, to - from, frame + at);
}

static bool take_packet(
    const struct framing *framing, struct stream *stream, int64_t total, bool is_bare, struct found *found)
{
    const uint8_t *frame = stream->bytes + stream->place;
    int64_t size = total - framing->body_start - framing->behind + (is_bare ? framing->bare : 0);
    stream->frame_bytes += total;
    stream->place += total;
    return find(stream, frame + framing->body_start, size, read_field(&framing->identifier, frame), found);
}

/* -- frames of one length without a checksum ------------------------------------------------------------------------
 *
 * Only marks are known of them: the trailer of one, the beginning of the next. Values can look like a mark, too, even
 * in frame after frame, at the same offset. Where such false marks are known, a step is kept over damaged marks; it is
 * left for another offset whose marks go on where its own end; and after lost bytes, the step is found at which the
 * known false marks are where they were. */

enum {
    MISSES = 4,    /* a step is kept if one of so many marks is in place */
    MARKS = 3,     /* beginnings that compete are compared by how many of so many marks follow */
    SIGHTINGS = 2, /* from so many frames in a row on, a false mark is known */
    PATIENCE = 16  /* lengths of a frame after which a lost step is forgotten, with its false marks */
};

/* Whether one frame can end and the next begin, so many bytes behind the place; n_sync bytes follow. */
static bool is_mark(const struct framing *framing, const struct stream *stream, int64_t at)
{
    const uint8_t *begin = stream->bytes + stream->place + at;
    return ends(framing, begin) && fits(framing->sync, framing->n_sync, begin, framing->n_sync);
}

/* How many marks follow, frame by frame, up to MARKS. */
static int64_t run_of(const struct framing *framing, const struct stream *stream, int64_t at)
{
    int64_t n = 0;
    while (n < MARKS && is_mark(framing, stream, at + (n + 1) * framing->longest))
        n++;
    return n;
}

/* Where false marks can be inside a frame. */
static int64_t first_offset(const struct framing *framing)
{
    return framing->n_trailer ? framing->n_trailer : 1;
}

static int64_t last_offset(const struct framing *framing)
{
    return framing->longest - (framing->n_sync ? framing->n_sync : 1);
}

static bool is_known(const struct stream *stream, int64_t offset)
{
    return stream->false_marks[offset] >= SIGHTINGS;
}

static void forget_false_marks(const struct framing *framing, struct stream *stream)
{
    memset(stream->false_marks, 0, (size_t)framing->longest);
    stream->n_false_marks = 0;
}

static void note_false_marks(const struct framing *framing, struct stream *stream)
{
    stream->n_false_marks = 0;
    for (int64_t at = first_offset(framing); at <= last_offset(framing); at++) {
        uint8_t *seen = stream->false_marks + at;
        *seen = is_mark(framing, stream, at) ? *seen + (*seen < SIGHTINGS) : 0;
        stream->n_false_marks += is_known(stream, at);
    }
}

/* Whether this is a frame and, if it must, is followed by another. */
static enum verdict form_of(const struct framing *framing, const struct stream *stream, bool is_in_step)
{
    const uint8_t *frame = stream->bytes + stream->place;
    int64_t total = framing->longest, left = stream->size - stream->place;
    if (!fits(framing->sync, framing->n_sync, frame, left) || !ends(framing, frame + total))
        return BAD;
    if (is_in_step && !framing->confirms_each)
        return GOOD;
    if (left < total + framing->look_ahead)
        return INCOMPLETE;
    return is_mark(framing, stream, total) && (!framing->n_trailer || ends(framing, frame + 2 * total)) ? GOOD : BAD;
}

/* Whether a frame in step begins at a false mark: its known ones are gone, and a true one is as far behind. */
static bool has_slipped(const struct framing *framing, const struct stream *stream)
{
    int64_t first = first_offset(framing), last = last_offset(framing);
    bool is_turned = false;
    for (int64_t at = first; at <= last && stream->n_false_marks; at++) {
        int64_t behind = framing->longest - at;
        if (is_known(stream, at) && is_mark(framing, stream, at))
            return false;
        is_turned |= is_known(stream, at) && behind >= first && behind <= last && is_mark(framing, stream, behind);
    }
    return is_turned;
}

/* After a frame in step that is none: how far the next one in step is; 0: the step is lost, -1: more must come. */
static int64_t next_step(const struct framing *framing, struct stream *stream)
{
    int64_t total = framing->longest;
    if (!stream->n_false_marks)
        return 0;
    for (int64_t i = 2; i <= MISSES; i++) {
        if (stream->size - stream->place < i * total + framing->n_sync)
            return -1;
        if (is_mark(framing, stream, i * total))
            return total;
    }
    for (int64_t at = first_offset(framing); at < total; at++)
        if (is_known(stream, at) && run_of(framing, stream, at) == MARKS) {
            forget_false_marks(framing, stream);
            return at;
        }
    return 0;
}

/* Whether a frame begins here, of all places that look so. */
static enum verdict competes(const struct framing *framing, struct stream *stream)
{
    int64_t total = framing->longest, lost = stream->before + stream->place - stream->follows_at;
    bool is_alone = true;
    if (stream->n_false_marks && lost > PATIENCE * total)
        forget_false_marks(framing, stream);
    for (int64_t at = first_offset(framing); at < total && is_alone; at++)
        is_alone = !is_mark(framing, stream, at);
    if (is_alone && !stream->n_false_marks)
        return GOOD;
    if (stream->size - stream->place < (MARKS + 1) * total + framing->n_sync)
        return INCOMPLETE;
    int64_t run = run_of(framing, stream, 0);
    for (int64_t at = first_offset(framing); at < total; at++) {
        bool is_marked = is_mark(framing, stream, at);
        if (is_known(stream, at) ? !is_marked : is_marked && run_of(framing, stream, at) > run)
            return BAD;
    }
    return GOOD;
}

static bool find_marked(const struct framing *framing, struct stream *stream, struct found *found)
{
    for (;;) {
        bool is_in_step = stream->before + stream->place == stream->follows_at;
        int64_t total = framing->longest, further = 0;
        if (!is_in_step)
            skip_bytes(stream, beginning(framing, stream) - stream->place);
        if (stream->size - stream->place < total)
            return false;
        enum verdict form = form_of(framing, stream, is_in_step);
        if (form == GOOD)
            form = is_in_step ? has_slipped(framing, stream) ? BAD : GOOD : competes(framing, stream);
        else if (form == BAD && is_in_step)
            further = next_step(framing, stream);
        if (form == INCOMPLETE || further < 0)
            return false;
        if (form == GOOD) {
            note_false_marks(framing, stream);
            stream->follows_at = stream->before + stream->place + total;
            return take_packet(framing, stream, total, false, found);
        }
        stream->bad_form++;
        skip_bytes(stream, further ? further : 1);
        if (further)
            stream->follows_at = stream->before + stream->place;
    }
}

static bool find_packet(const struct framing *framing, struct stream *stream, struct found *found)
{
    if (framing->look_ahead)
        return find_marked(framing, stream, found);
    for (;;) {
        skip_bytes(stream, beginning(framing, stream) - stream->place);
        const uint8_t *frame = stream->bytes + stream->place;
        int64_t left = stream->size - stream->place, total;
        bool is_bare;
        if (left < framing->known_from || !left)
            return false;
        total = total_of(framing, frame, left, &is_bare);
        if (left < total)
            return false;
        bool has_form = total && ends(framing, frame + total);
        if (has_form && (is_bare || has_checksum(framing, frame, total)))
            return take_packet(framing, stream, total, is_bare, found);
        *(has_form ? &stream->checksum_errors : &stream->bad_form) += 1;
        skip_bytes(stream, 1);
    }
}

/* -- frames between delimiters ------------------------------------------------------------------------------------- */

/* What a segment says, into `content`, which is as long; its size, -1: it has a form that cannot be. */
static int64_t decode_cobs(uint8_t *content, const uint8_t *segment, int64_t n)
{
    int64_t size = 0, place = 0;
    while (place < n) {
        int64_t code = segment[place];
        if (place + code > n)
            return -1;
        memcpy(content + size, segment + place + 1, (size_t)(code - 1));
        size += code - 1;
        place += code;
        if (code < 0xFF && place < n)
            content[size++] = 0;
    }
    return size;
}

static int64_t decode_escaped(const struct framing *framing, uint8_t *content, const uint8_t *segment, int64_t n)
{
    int64_t size = 0;
    for (int64_t place = 0; place < n; place++) {
        int64_t byte = segment[place];
        if (byte == framing->escape) {
            if (++place == n || framing->meaning[segment[place]] < 0)
                return -1;
            byte = framing->meaning[segment[place]];
        }
        content[size++] = (uint8_t)byte;
    }
    return size;
}

static int64_t decode(const struct framing *framing, uint8_t *content, const uint8_t *segment, int64_t n)
{
    if (framing->form == COBS)
        return decode_cobs(content, segment, n);
    if (framing->form == ESCAPED)
        return decode_escaped(framing, content, segment, n);
    memcpy(content, segment, (size_t)n);
    return n && segment[n - 1] == '\r' ? n - 1 : n;
}

/* Whether a segment is a frame; counted, if it is none. */
static bool find_content(
    const struct framing *framing, struct stream *stream, const uint8_t *segment, int64_t n, struct found *found)
{
    const struct checksum *checksum = &framing->checksum;
    uint8_t *content = stream->content;
    int64_t size = n <= framing->longest_segment ? decode(framing, content, segment, n) : -1;
    if (size >= framing->shortest && size <= framing->longest) {
        size -= checksum->size;
        if (!checksum->size || is_right(checksum, content, size, content + size)) {
            int64_t first = framing->body_start;
            stream->frame_bytes += n + 1;
            stream->place += n + 1;
            return find(stream, content + first, size - first, read_field(&framing->identifier, content), found);
        }
        stream->checksum_errors++;
    } else if (!size) {
        stream->idle_bytes += n + 1;
        stream->place += n + 1;
        return false;
    } else
        stream->bad_form++;
    skip_bytes(stream, n + 1);
    return false;
}

static bool find_segment(const struct framing *framing, struct stream *stream, struct found *found)
{
    for (;;) {
        const uint8_t *begin = stream->bytes + stream->place, *end;
        int64_t left = stream->size - stream->place;
        end = memchr(begin, (int)framing->delimiter, (size_t)left);
        if (!end) {
            if (!stream->is_discarding && left > framing->longest_segment) {
                stream->is_discarding = 1;
                stream->bad_form++;
            }
            if (stream->is_discarding)
                skip_bytes(stream, left);
            return false;
        }
        if (stream->is_discarding) {
            stream->is_discarding = 0;
            skip_bytes(stream, end - begin + 1);
        } else if (find_content(framing, stream, begin, end - begin, found))
            return true;
    }
}

/* -- the stream ---------------------------------------------------------------------------------------------------- */

/* Forget when those bytes came that lie before this place; frames are found in order. */
static void forget_reads(struct stream *stream, int64_t place)
{
    int64_t n = 0;
    while (n < stream->n_reads && stream->reads[n].end < place)
        n++;
    stream->n_reads -= n;
    memmove(stream->reads, stream->reads + n, (size_t)stream->n_reads * sizeof *stream->reads);
}

/* Make room for what comes next: a chunk, whose bytes go behind those that are still undecided. */
uint8_t *begin_chunk(struct stream *stream)
{
    int64_t undecided = stream->before + stream->place;
    stream->size -= stream->place;
    memmove(stream->bytes, stream->bytes + stream->place, (size_t)stream->size);
    stream->before = undecided;
    stream->place = 0;
    forget_reads(stream, undecided + 1);
    return stream->bytes + stream->size;
}

/* So many bytes have been written there. */
void end_chunk(struct stream *stream, int64_t n, int64_t time_ns)
{
    stream->chunk = stream->bytes + stream->size;
    stream->chunk_bytes = n;
    stream->size += n;
    stream->bytes_in += n;
    stream->reads[stream->n_reads++] = (struct reading){stream->before + stream->size, time_ns};
    stream->is_behind = 1;
    stream->is_good = stream->is_damaged = 0;
}

SKINWARE_EXPORT void skinware_stream_add(struct stream *stream, const uint8_t *chunk, int64_t n, int64_t time_ns)
{
    memcpy(begin_chunk(stream), chunk, (size_t)n);
    end_chunk(stream, n, time_ns);
}

void append_row(struct batch *batch, int64_t bus, int64_t identifier, const uint8_t *body, int64_t size,
                int64_t time_ns)
{
    uint8_t *row = batch->wire + batch->stop * batch->row_bytes;
    uint32_t name = (uint32_t)identifier, length = (uint32_t)size;
    memcpy(row, &name, sizeof name);
    if (batch->payload_size <= SHORT_PAYLOAD)
        row[4] = (uint8_t)length;
    else
        memcpy(row + 4, &length, sizeof length);
    memcpy(row + 8, body, (size_t)size);
    memset(row + 8 + size, 0, (size_t)(batch->payload_size - size));
    batch->time_ns[batch->stop] = time_ns;
    batch->bus[batch->stop++] = (uint16_t)bus;
}

/* Append the frames of what has come to the batch, up to its limit; how many rows that are. */
SKINWARE_EXPORT int64_t skinware_stream_fill(struct stream *stream, struct batch *batch, int64_t bus)
{
    const struct framing *framing = stream->framing;
    int64_t first = batch->stop, damaged = stream->checksum_errors + stream->bad_form;
    struct found found;
    while (stream->is_behind && batch->stop < batch->limit) {
        stream->is_behind = framing->form == PACKETS ? find_packet(framing, stream, &found)
                                                     : find_segment(framing, stream, &found);
        if (!stream->is_behind)
            break;
        stream->found++;
        stream->is_good = 1;
        forget_reads(stream, found.end);
        if (found.size > stream->payload_size)
            stream->too_long++;
        else
            append_row(batch, bus, found.identifier, found.body, found.size, stream->reads->time_ns);
    }
    stream->is_damaged |= stream->checksum_errors + stream->bad_form > damaged;
    stream->frames += batch->stop - first;
    return batch->stop - first;
}

/* Where frames come from, CAN sockets and serial lines, read in C; and the loop that takes, publishes and rests. */
#ifndef SKINWARE_DRIVERS_FLOW_H
#define SKINWARE_DRIVERS_FLOW_H

#include "framing.h"

struct tap { /* wire_tap.py: what goes over a wire, kept until Python fetches it */
    uint8_t *bytes;
    int64_t room, size, missed;
};

struct asked_block { /* registers that make one frame */
    const uint8_t *registers;
    const int64_t *heard_ns;
    int64_t *told_ns; /* when the frame was last whole */
    int64_t count, identifier;
};

struct asked_read { /* one question, and the beginning of its reply, both with room for a number in front over TCP */
    uint8_t *question, *reply, *registers;
    int64_t question_bytes, reply_head, reply_bytes, count, n_blocks;
    int64_t *heard_ns;
    const struct asked_block *blocks; /* those that end in this read */
};

struct asker { /* a Modbus master */
    int64_t fd, guests_fd, is_tcp, is_stuck; /* guests_fd: readable when others want to ask, -1: none can; is_stuck:
                                                Python has to go on */
    int64_t n_reads, most_blocks; /* of a cycle; blocks that end in one read */
    struct asked_read *reads;
    int64_t open, next, number, cycle; /* open: the read whose reply is awaited, -1: none */
    int64_t until_ns, free_ns, cycle_ns, deadline_ns; /* timeout; earliest next question; of the cycle: begun, next */
    int64_t timeout_ns, turnaround_ns, period_ns;
    int64_t sent, polls_missed, frames, bytes_in, frame_bytes, found;
    uint8_t *buffer; /* what has come of the reply */
    int64_t size;
    const uint32_t *crc_table;
};

struct can_socket { /* its datagrams are struct can_frame or canfd_frame, with stamps */
    int64_t fd;
    struct device_clock *clock;      /* of a controller that stamps, too; NULL: only the kernel does */
    int64_t offset_ns, last_poll_ns; /* CLOCK_MONOTONIC - CLOCK_REALTIME, and when that was */
    int64_t dropped_before, dropped; /* ever */
    int64_t frames, is_heard;        /* since Python looked; whether data came after all that Python sorted out */
    int64_t is_counted, is_small;    /* bits on the wire are; its buffer is full after a few frames */
    double speed_up, wire_bits, fullest;
};

struct source { /* a serial line, a line on which we ask, or a socket: one of the pointers is not NULL */
    int64_t fd, bus; /* fd: as it is known in `epoll_fd`, -1: it is gone */
    struct stream *stream;
    struct asker *asker;
    struct can_socket *can;
    struct tap *tap;              /* NULL: nobody wants what comes */
    int64_t heard_ns, is_watched; /* is_watched: Python wants to know that frames come */
};

struct flow {
    int64_t loop_fd, epoll_fd;     /* readable: Python has something to do; a bus has something */
    int64_t until_ns, latency_ns;  /* when Python has something to do; the longest rest */
    int64_t has_others;            /* buses are open that Python has to read */
    int64_t rest_until_ns, silence_ns, n_sources; /* silence_ns: after so long without a frame Python wants to know */
    struct source *sources;
};

SKINWARE_EXPORT void skinware_clock_convert(struct device_clock *clock, const int64_t *stamps, int64_t *times_ns,
                                            int64_t n);
bool receive(struct path *path, struct source *source);
bool receive_line(struct path *path, struct source *source);
void keep_frames(struct tap *tap, const struct batch *batch, int64_t first, int64_t n);
void keep_bytes(struct tap *tap, const uint8_t *bytes, int64_t n, int64_t time_ns, bool is_sent);
bool receive_asked(struct path *path, struct source *source);
int64_t asker_due_ns(const struct asker *asker);

#endif

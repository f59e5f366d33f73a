/* Where frames come from, CAN sockets and serial lines, read in C; and the loop that takes, publishes and rests. */
#ifndef SKINWARE_DRIVERS_FLOW_H
#define SKINWARE_DRIVERS_FLOW_H

#include "framing.h"

struct tap { /* wire_tap.py: what goes over a wire, kept until Python fetches it */
    uint8_t *bytes;
    int64_t room, size, lost;
};

struct source { /* a serial line, or a socket whose datagrams are struct can_frame or canfd_frame, with stamps */
    int64_t fd, bus;                           /* fd: as it is known in `epoll_fd`, -1: it is gone */
    struct stream *stream;                     /* of a line; NULL: what follows tap is of a socket */
    struct tap *tap;                           /* NULL: nobody wants what comes */
    int64_t headers, control;                  /* addresses of a mmsghdr and of 8 words for every row of the batch */
    int64_t offset_ns, last_poll_ns;           /* CLOCK_MONOTONIC - CLOCK_REALTIME, and when that was */
    int64_t lost_before, lost, frames, heard_ns; /* lost: ever; frames: since Python looked */
    int64_t is_counted, is_watched;            /* bits on the wire are; Python wants to know that frames come */
    int64_t is_small;                          /* its buffer is full after a few frames */
    double speed_up, wire_bits, fullest;
};

struct flow {
    int64_t loop_fd, epoll_fd;     /* readable: Python has something to do; a bus has something */
    int64_t until_ns, latency_ns;  /* when Python has something to do; the longest rest */
    int64_t has_others;            /* buses are open that Python has to read */
    int64_t rest_until_ns, silence_ns, n_sources; /* silence_ns: after so long without a frame Python wants to know */
    struct source *sources;
};

bool receive(struct path *path, struct source *source);
bool receive_line(struct path *path, struct source *source);
void keep_frames(const struct path *path, const struct source *source, int64_t first, int64_t n);
void keep_bytes(struct tap *tap, const uint8_t *bytes, int64_t n, int64_t time_ns);

#endif

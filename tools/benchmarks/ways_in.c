/* Ways in which the kernel hands over frames of a CAN interface: recvmmsg, a ring of packets, io_uring multishot.
 *
 * ways_in cost WAY INTERFACE PEER PORTION PORTIONS   sends portions by PEER and drains each: ns a frame for both
 * ways_in rest WAY INTERFACE SECONDS REST_US         receives with rests: frames, processor time
 * ways_in send PEER RATE_HZ SECONDS                  sends at a steady rate: frames, processor time
 * ways_in check WAY INTERFACE                        on a CAN interface: which frames come, with which marks
 *
 * WAY: recvmmsg | ring2 | ring3 (TPACKET_V2, V3) | uring, all on packet sockets; raw (recvmmsg) and rawuring on a CAN_RAW
 * socket. See ways_in.py.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <linux/can.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#include <linux/if_packet.h>
#include <linux/filter.h>
#include <linux/io_uring.h>
#include <net/ethernet.h>
#include <net/if.h>
#include <net/if_arp.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum { BATCH = 256, CONTROL = 64, BUFFERS = 4096, BUFFER = 256, BLOCK = 1 << 18, BLOCKS = 32, SLOT = 128, RETIRE_MS = 4, EXPERIMENTAL = 0x88B5, OWN_MARK = 0x5C1 };

typedef struct {
    int fd, ring, is_uring; /* ring: 2 or 3, the version */
    char *map; /* of the packet ring */
    unsigned at; /* block or slot that comes next */
    int uring; /* of io_uring */
    unsigned *sq_tail, sq_mask, *cq_head, *cq_tail, cq_mask;
    struct io_uring_sqe *sqes;
    struct io_uring_cqe *cqes;
    struct io_uring_buf_ring *buffers;
    char *data;
    struct msghdr message;
    int armed;
} way_in;

static struct can_frame frames[BATCH];
static struct iovec parts[BATCH];
static struct mmsghdr headers[BATCH];
static uint64_t control[BATCH][CONTROL / 8];
static struct sockaddr_ll from[BATCH];
static struct sockaddr_ll destination;
static uint64_t sum; /* so that every frame and stamp is looked at */
static int verbose;

static void fail(const char *what)
{
    perror(what);
    exit(1);
}

static double seconds(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void look(const struct can_frame *frame, int64_t stamp_ns, int type)
{
    sum += frame->can_id + frame->data[1] + (uint64_t)stamp_ns;
    if (verbose)
        printf("  id %03X, stamp %s, packet type %d\n", frame->can_id, stamp_ns ? "yes" : "no", type);
}

/* An ethernet interface, which stands in for a CAN one, takes frames of CAN's protocol number for something else. */
static int protocol_of(const char *interface)
{
    struct ifreq request = {0};
    int fd = socket(AF_PACKET, SOCK_DGRAM, 0);
    strncpy(request.ifr_name, interface, IFNAMSIZ - 1);
    if (fd < 0 || ioctl(fd, SIOCGIFHWADDR, &request))
        fail(interface);
    close(fd);
    return request.ifr_hwaddr.sa_family == ARPHRD_CAN ? ETH_P_CAN : EXPERIMENTAL;
}

static int bound(const char *interface)
{
    int type = SOCK_DGRAM, protocol = protocol_of(interface);
    int fd = socket(AF_PACKET, type, htons((uint16_t)protocol)), buffer = 4 << 20, one = 1;
    struct sockaddr_ll address = {.sll_family = AF_PACKET, .sll_protocol = htons((uint16_t)protocol)};
    address.sll_ifindex = (int)if_nametoindex(interface);
    if (fd < 0 || bind(fd, (struct sockaddr *)&address, sizeof address))
        fail(interface);
    setsockopt(fd, SOL_SOCKET, SO_RCVBUFFORCE, &buffer, sizeof buffer);
    setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &one, sizeof one);
    return fd;
}

static int open_raw(const char *interface)
{
    int fd = socket(AF_CAN, SOCK_RAW, CAN_RAW), buffer = 4 << 20, one = 1;
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(interface)};
    if (fd < 0 || bind(fd, (struct sockaddr *)&address, sizeof address))
        fail(interface);
    setsockopt(fd, SOL_SOCKET, SO_RCVBUFFORCE, &buffer, sizeof buffer);
    setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &one, sizeof one);
    return fd;
}

static void open_ring(way_in *way, int ring)
{
    int version = ring == 3 ? TPACKET_V3 : TPACKET_V2;
    unsigned size = ring == 3 ? 2048 : SLOT;
    struct tpacket_req3 request = {.tp_block_size = BLOCK,
                                   .tp_block_nr = BLOCKS,
                                   .tp_frame_size = size,
                                   .tp_frame_nr = BLOCK / size * BLOCKS,
                                   .tp_retire_blk_tov = RETIRE_MS};
    socklen_t length = ring == 3 ? sizeof request : sizeof(struct tpacket_req);
    if (setsockopt(way->fd, SOL_PACKET, PACKET_VERSION, &version, sizeof version) ||
        setsockopt(way->fd, SOL_PACKET, PACKET_RX_RING, &request, length))
        fail("ring");
    way->map = mmap(NULL, (size_t)BLOCK * BLOCKS, PROT_READ | PROT_WRITE, MAP_SHARED, way->fd, 0);
    if (way->map == MAP_FAILED)
        fail("mmap");
    way->ring = ring;
}

static void open_uring(way_in *way)
{
    struct io_uring_params params = {.flags = IORING_SETUP_CQSIZE | IORING_SETUP_SINGLE_ISSUER | IORING_SETUP_DEFER_TASKRUN,
                                     .cq_entries = BUFFERS};
    way->uring = (int)syscall(__NR_io_uring_setup, 8, &params);
    if (way->uring < 0)
        fail("io_uring");
    size_t size = params.cq_off.cqes + params.cq_entries * sizeof(struct io_uring_cqe);
    char *rings = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, way->uring, IORING_OFF_SQ_RING);
    way->sqes = mmap(NULL, params.sq_entries * sizeof *way->sqes, PROT_READ | PROT_WRITE, MAP_SHARED, way->uring,
                     IORING_OFF_SQES);
    size_t table = BUFFERS * sizeof(struct io_uring_buf);
    way->buffers = mmap(NULL, table, PROT_READ | PROT_WRITE, MAP_ANONYMOUS | MAP_PRIVATE, -1, 0);
    way->data = mmap(NULL, (size_t)BUFFERS * BUFFER, PROT_READ | PROT_WRITE, MAP_ANONYMOUS | MAP_PRIVATE, -1, 0);
    struct io_uring_buf_reg registered = {.ring_addr = (uintptr_t)way->buffers, .ring_entries = BUFFERS, .bgid = 1};
    if (rings == MAP_FAILED || (void *)way->sqes == MAP_FAILED ||
        syscall(__NR_io_uring_register, way->uring, IORING_REGISTER_PBUF_RING, &registered, 1) < 0)
        fail("io_uring buffers");
    way->sq_tail = (unsigned *)(rings + params.sq_off.tail);
    way->sq_mask = params.sq_entries - 1;
    unsigned *order = (unsigned *)(rings + params.sq_off.array);
    for (unsigned i = 0; i < params.sq_entries; i++)
        order[i] = i;
    way->cq_head = (unsigned *)(rings + params.cq_off.head);
    way->cq_tail = (unsigned *)(rings + params.cq_off.tail);
    way->cq_mask = params.cq_entries - 1;
    way->cqes = (struct io_uring_cqe *)(rings + params.cq_off.cqes);
    for (unsigned i = 0; i < BUFFERS; i++)
        way->buffers->bufs[i] = (struct io_uring_buf){.addr = (uintptr_t)(way->data + i * BUFFER), .len = BUFFER, .bid = (uint16_t)i};
    __atomic_store_n(&way->buffers->tail, (uint16_t)BUFFERS, __ATOMIC_RELEASE);
    way->message = (struct msghdr){.msg_controllen = CONTROL};
    way->is_uring = 1;
}

static way_in open_way(const char *name, const char *interface)
{
    way_in way = {.uring = -1};
    way.fd = strncmp(name, "raw", 3) ? bound(interface) : open_raw(interface);
    if (!strncmp(name, "ring", 4))
        open_ring(&way, name[4] - '0');
    if (!strcmp(name, "uring") || !strcmp(name, "rawuring"))
        open_uring(&way);
    for (int i = 0; i < BATCH; i++) {
        parts[i] = (struct iovec){&frames[i], sizeof frames[i]};
        headers[i].msg_hdr = (struct msghdr){.msg_iov = &parts[i], .msg_iovlen = 1, .msg_control = control[i]};
        headers[i].msg_hdr.msg_name = &from[i];
    }
    return way;
}

static int64_t stamp_of(const void *data)
{
    struct timespec stamp;
    memcpy(&stamp, data, sizeof stamp);
    return stamp.tv_sec * 1000000000LL + stamp.tv_nsec;
}

static int take_batches(way_in *way)
{
    int total = 0, count;
    do {
        for (int i = 0; i < BATCH; i++) {
            headers[i].msg_hdr.msg_controllen = CONTROL;
            headers[i].msg_hdr.msg_namelen = sizeof from[i];
        }
        count = recvmmsg(way->fd, headers, BATCH, MSG_DONTWAIT, NULL);
        for (int i = 0; i < count; i++)
            look(&frames[i], stamp_of(CMSG_DATA((struct cmsghdr *)control[i])), from[i].sll_pkttype);
        total += count > 0 ? count : 0;
    } while (count == BATCH);
    return total;
}

static int take_blocks(way_in *way)
{
    for (int total = 0;; way->at = (way->at + 1) % BLOCKS) {
        struct tpacket_block_desc *block = (struct tpacket_block_desc *)(way->map + (size_t)BLOCK * way->at);
        if (!(__atomic_load_n(&block->hdr.bh1.block_status, __ATOMIC_ACQUIRE) & TP_STATUS_USER))
            return total;
        struct tpacket3_hdr *packet = (struct tpacket3_hdr *)((char *)block + block->hdr.bh1.offset_to_first_pkt);
        for (unsigned i = 0; i < block->hdr.bh1.num_pkts; i++) {
            struct sockaddr_ll *sender = (struct sockaddr_ll *)((char *)packet + TPACKET_ALIGN(sizeof *packet));
            look((struct can_frame *)((char *)packet + packet->tp_net),
                 packet->tp_sec * 1000000000LL + packet->tp_nsec, sender->sll_pkttype);
            packet = (struct tpacket3_hdr *)((char *)packet + packet->tp_next_offset);
        }
        total += (int)block->hdr.bh1.num_pkts;
        __atomic_store_n(&block->hdr.bh1.block_status, TP_STATUS_KERNEL, __ATOMIC_RELEASE);
    }
}

static int take_slots(way_in *way)
{
    for (int total = 0;; total++, way->at = (way->at + 1) % (BLOCK / SLOT * BLOCKS)) {
        struct tpacket2_hdr *packet = (struct tpacket2_hdr *)(way->map + (size_t)SLOT * way->at);
        if (!(__atomic_load_n(&packet->tp_status, __ATOMIC_ACQUIRE) & TP_STATUS_USER))
            return total;
        struct sockaddr_ll *sender = (struct sockaddr_ll *)((char *)packet + TPACKET_ALIGN(sizeof *packet));
        look((struct can_frame *)((char *)packet + packet->tp_net), packet->tp_sec * 1000000000LL + packet->tp_nsec,
             sender->sll_pkttype);
        __atomic_store_n(&packet->tp_status, TP_STATUS_KERNEL, __ATOMIC_RELEASE);
    }
}

static void enter(way_in *way, unsigned wanted)
{
    unsigned submitted = 0;
    if (!way->armed) {
        struct io_uring_sqe *sqe = &way->sqes[*way->sq_tail & way->sq_mask];
        memset(sqe, 0, sizeof *sqe);
        sqe->opcode = IORING_OP_RECVMSG;
        sqe->fd = way->fd;
        sqe->addr = (uintptr_t)&way->message;
        sqe->ioprio = IORING_RECV_MULTISHOT;
        sqe->flags = IOSQE_BUFFER_SELECT;
        sqe->buf_group = 1;
        __atomic_store_n(way->sq_tail, *way->sq_tail + 1, __ATOMIC_RELEASE);
        way->armed = 1;
        submitted = 1;
    }
    if (syscall(__NR_io_uring_enter, way->uring, submitted, wanted, IORING_ENTER_GETEVENTS, NULL, 0) < 0 && errno != EINTR)
        fail("io_uring_enter");
}

static int take_uring(way_in *way)
{
    int total = 0;
    for (;;) {
        enter(way, 0);
        unsigned head = *way->cq_head, tail = __atomic_load_n(way->cq_tail, __ATOMIC_ACQUIRE);
        if (head == tail)
            return total;
        uint16_t back = way->buffers->tail;
        for (; head != tail; head++) {
            struct io_uring_cqe *cqe = &way->cqes[head & way->cq_mask];
            if (!(cqe->flags & IORING_CQE_F_MORE))
                way->armed = 0;
            if (cqe->res < 0)
                continue;
            uint16_t id = (uint16_t)(cqe->flags >> IORING_CQE_BUFFER_SHIFT);
            struct io_uring_recvmsg_out *out = (struct io_uring_recvmsg_out *)(way->data + id * BUFFER);
            char *name = (char *)(out + 1), *ancillary = name + way->message.msg_namelen;
            look((struct can_frame *)(ancillary + way->message.msg_controllen),
                 out->controllen ? stamp_of(CMSG_DATA((struct cmsghdr *)ancillary)) : 0, -1);
            total++;
            way->buffers->bufs[back++ & (BUFFERS - 1)] =
                (struct io_uring_buf){.addr = (uintptr_t)out, .len = BUFFER, .bid = id};
        }
        __atomic_store_n(&way->buffers->tail, back, __ATOMIC_RELEASE);
        __atomic_store_n(way->cq_head, head, __ATOMIC_RELEASE);
    }
}

static int take(way_in *way)
{
    return way->ring == 3 ? take_blocks(way) : way->ring ? take_slots(way) : way->is_uring ? take_uring(way) : take_batches(way);
}

/* Wait until something has come; 0 after the time. */
static int wait_for(way_in *way, int ms)
{
    if (way->is_uring)
        enter(way, 0); /* its requests run when it is entered */
    struct pollfd waiting = {.fd = way->is_uring ? way->uring : way->fd, .events = POLLIN};
    return poll(&waiting, 1, ms);
}

static void send_some(int fd, int count)
{
    static struct can_frame sent[BATCH];
    static struct iovec iov[BATCH];
    static struct mmsghdr messages[BATCH];
    for (int i = 0; i < BATCH; i++) {
        sent[i] = (struct can_frame){.can_id = (unsigned)(0x400 + i % 224), .can_dlc = 8, .data = {0x40, (uint8_t)i}};
        iov[i] = (struct iovec){&sent[i], sizeof sent[i]};
        messages[i].msg_hdr = (struct msghdr){
            .msg_iov = &iov[i], .msg_iovlen = 1, .msg_name = &destination, .msg_namelen = sizeof destination};
    }
    for (int left = count; left > 0;) {
        int done = sendmmsg(fd, messages, (unsigned)(left < BATCH ? left : BATCH), 0);
        if (done > 0)
            left -= done;
        else if (errno != ENOBUFS && errno != EAGAIN)
            fail("send");
    }
}

static int sender(const char *peer)
{
    destination = (struct sockaddr_ll){.sll_family = AF_PACKET, .sll_protocol = htons((uint16_t)protocol_of(peer)), .sll_halen = 6};
    destination.sll_ifindex = (int)if_nametoindex(peer);
    memset(destination.sll_addr, 0xFF, 6);
    int fd = socket(AF_PACKET, SOCK_DGRAM, 0);
    if (fd < 0)
        fail(peer);
    return fd;
}

static void send_one(int fd, unsigned identifier)
{
    struct can_frame frame = {.can_id = identifier, .can_dlc = 8};
    if (write(fd, &frame, sizeof frame) < 0)
        fail("write");
}

static void send_some_can(int fd, int count)
{
    while (count-- > 0)
        send_one(fd, 0x333);
}

static int cost(char **argument)
{
    way_in way = open_way(argument[0], argument[1]);
    int fd = sender(argument[2]), portion = atoi(argument[3]), portions = atoi(argument[4]);
    double sending = 0, receiving = 0, waiting = 0;
    long received = 0;
    take(&way);
    for (int i = 0; i < portions; i++) {
        double begin = seconds(CLOCK_THREAD_CPUTIME_ID);
        send_some(fd, portion);
        double middle = seconds(CLOCK_THREAD_CPUTIME_ID), wall = seconds(CLOCK_MONOTONIC);
        sending += middle - begin;
        long goal = received + portion;
        while (received < goal && seconds(CLOCK_MONOTONIC) < wall + 1) {
            int got = take(&way);
            if (got == 0) {
                double asleep = seconds(CLOCK_MONOTONIC);
                wait_for(&way, 100);
                waiting += seconds(CLOCK_MONOTONIC) - asleep;
            }
            received += got;
        }
        receiving += seconds(CLOCK_THREAD_CPUTIME_ID) - middle;
    }
    double n = (double)portion * portions;
    printf("{\"sent\": %.0f, \"received\": %ld, \"send_ns\": %.1f, \"receive_ns\": %.1f, \"wait_ms\": %.2f}\n", n, received,
           1e9 * sending / n, 1e9 * receiving / n, 1e3 * waiting / portions);
    return 0;
}

static int rest(char **argument)
{
    way_in way = open_way(argument[0], argument[1]);
    double end = seconds(CLOCK_MONOTONIC) + atof(argument[2]);
    struct timespec pause = {.tv_nsec = 1000L * atol(argument[3])};
    long received = 0, takes = 0;
    double begin = seconds(CLOCK_PROCESS_CPUTIME_ID);
    while (seconds(CLOCK_MONOTONIC) < end) {
        if (wait_for(&way, 200) > 0) {
            received += take(&way);
            takes++;
            nanosleep(&pause, NULL);
        }
    }
    printf("{\"received\": %ld, \"takes\": %ld, \"cpu_s\": %.6f}\n", received, takes,
           seconds(CLOCK_PROCESS_CPUTIME_ID) - begin);
    return 0;
}

static int send_steadily(char **argument)
{
    int fd = sender(argument[0]);
    double rate = atof(argument[1]), begin = seconds(CLOCK_MONOTONIC), end = begin + atof(argument[2]);
    struct timespec tick = {.tv_nsec = 1000000};
    long sent = 0;
    for (double now; (now = seconds(CLOCK_MONOTONIC)) < end; nanosleep(&tick, NULL)) {
        long due = (long)((now - begin) * rate);
        send_some(fd, (int)(due - sent));
        sent = due;
    }
    printf("{\"sent\": %ld, \"cpu_s\": %.6f}\n", sent, seconds(CLOCK_PROCESS_CPUTIME_ID));
    return 0;
}

/* Leave out what was sent by a socket with our mark: a packet socket cannot tell its own program's frames otherwise. */
static void leave_out_own(int fd)
{
    struct sock_filter program[] = {
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, (unsigned)(SKF_AD_OFF + SKF_AD_MARK)),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, OWN_MARK, 0, 1),
        BPF_STMT(BPF_RET | BPF_K, 0),
        BPF_STMT(BPF_RET | BPF_K, 0xFFFF),
    };
    struct sock_fprog filter = {.len = 4, .filter = program};
    if (setsockopt(fd, SOL_SOCKET, SO_ATTACH_FILTER, &filter, sizeof filter))
        fail("filter");
}

static int check(char **argument)
{
    way_in way = open_way(argument[0], argument[1]);
    int is_raw = strncmp(argument[0], "raw", 3) == 0, other = open_raw(argument[1]), mark = OWN_MARK;
    int own = is_raw ? way.fd : open_raw(argument[1]);
    for (int marked = 0; marked < (is_raw ? 1 : 2); marked++) {
        if (marked) {
            leave_out_own(way.fd);
            if (setsockopt(own, SOL_SOCKET, SO_MARK, &mark, sizeof mark))
                fail("mark");
        }
        verbose = 1;
        printf("%s%s: own frame 111, another program's 222, its error frame\n", argument[0], marked ? ", own marked" : "");
        send_one(own, 0x111);
        send_one(other, 0x222);
        send_one(other, CAN_ERR_FLAG | CAN_ERR_BUSOFF);
        for (int i = 0; i < 10; i++) {
            usleep(20000);
            take(&way);
        }
    }
    struct tpacket_stats_v3 statistics = {0};
    socklen_t size = sizeof statistics;
    verbose = 0;
    send_some_can(other, 100000);
    int taken = take(&way);
    if (!is_raw && !getsockopt(way.fd, SOL_PACKET, PACKET_STATISTICS, &statistics, &size))
        printf("%s: 100000 sent in one go, %d taken, the kernel counted %u dropped\n", argument[0], taken, statistics.tp_drops);
    return 0;
}

int main(int argc, char **argv)
{
    if (argc == 7 && !strcmp(argv[1], "cost"))
        return cost(argv + 2);
    if (argc == 6 && !strcmp(argv[1], "rest"))
        return rest(argv + 2);
    if (argc == 5 && !strcmp(argv[1], "send"))
        return send_steadily(argv + 2);
    if (argc == 4 && !strcmp(argv[1], "check"))
        return check(argv + 2);
    return 2;
}

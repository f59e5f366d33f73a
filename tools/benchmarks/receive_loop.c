/* The least that a receiver of CAN frames can do, in C: wait, rest, receive in batches with time stamps, look up, copy.
 *
 * receive_loop BUSES BOARDS LATENCY_MS SECONDS: what can_receivers.py is to the driver, in the same form. It prints the
 * UDP ports that it listens on, then, after a second without a frame, or SECONDS after the first one, what it received.
 */
#define _GNU_SOURCE
#include <netinet/in.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { BATCH = 256, CONTROL = 64, MOST_BUSES = 64, QUIET_MS = 1000, WANTED_BUFFER = 8 << 20, FIRST_BOARD = 1 };

struct frame {
    uint32_t identifier;
    uint8_t length, rest[3], payload[8];
};

static struct frame frames[BATCH];
static struct iovec parts[BATCH];
static struct mmsghdr headers[BATCH];
static uint64_t control[BATCH][CONTROL / 8];
static int16_t module_of[2048];
static uint8_t values[MOST_BUSES][16 * 16][12];
static int64_t module_time_ns[MOST_BUSES][16 * 16];
static long received[MOST_BUSES];

static double seconds(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static int open_bus(void)
{
    int fd = socket(AF_INET, SOCK_DGRAM, 0), one = 1, buffer = WANTED_BUFFER / 2;
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof address;
    if (fd < 0 || bind(fd, (struct sockaddr *)&address, size) || getsockname(fd, (struct sockaddr *)&address, &size)) {
        perror("receive_loop");
        exit(1);
    }
    if (setsockopt(fd, SOL_SOCKET, SO_RCVBUFFORCE, &buffer, sizeof buffer))
        setsockopt(fd, SOL_SOCKET, SO_RCVBUF, &buffer, sizeof buffer);
    setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &one, sizeof one);
    printf("%d ", ntohs(address.sin_port));
    return fd;
}

static int take(int fd, int bus)
{
    for (int i = 0; i < BATCH; i++)
        headers[i].msg_hdr.msg_controllen = CONTROL;
    int count = recvmmsg(fd, headers, BATCH, MSG_DONTWAIT, NULL);
    for (int i = 0; i < count; i++) {
        const struct frame *frame = &frames[i];
        int module = frame->identifier < 2048 ? module_of[frame->identifier] : -1;
        if (module < 0 || frame->length != 8)
            continue;
        struct timespec stamp;
        memcpy(&stamp, CMSG_DATA((struct cmsghdr *)control[i]), sizeof stamp);
        int is_tail = frame->payload[0] >> 7;
        memcpy(values[bus][module] + 7 * is_tail, frame->payload + 1, is_tail ? 5 : 7);
        module_time_ns[bus][module] = stamp.tv_sec * 1000000000LL + stamp.tv_nsec;
    }
    if (count > 0)
        received[bus] += count;
    return count;
}

int main(int argc, char **argv)
{
    if (argc != 5)
        return 2;
    int n_buses = atoi(argv[1]), n_boards = atoi(argv[2]), epoll = epoll_create1(0);
    double latency_s = atof(argv[3]) / 1e3, longest_s = atof(argv[4]), began_s = 0, began_cpu_s = 0, ended_s = 0;
    double ended_cpu_s = 0;
    int fds[MOST_BUSES];
    struct epoll_event events[MOST_BUSES];
    struct timespec rest = {.tv_nsec = (long)(1e9 * latency_s)};
    if (n_buses < 1 || n_buses > MOST_BUSES || n_boards < 1 || n_boards > 14)
        return 2;
    memset(module_of, -1, sizeof module_of);
    for (int board = 0; board < n_boards; board++)
        for (int triangle = 0; triangle < 16; triangle++)
            module_of[0x400 | (board + FIRST_BOARD) << 4 | triangle] = (int16_t)(16 * board + triangle);
    for (int i = 0; i < BATCH; i++) {
        parts[i] = (struct iovec){&frames[i], sizeof frames[i]};
        headers[i].msg_hdr = (struct msghdr){.msg_iov = &parts[i], .msg_iovlen = 1, .msg_control = control[i]};
    }
    for (int bus = 0; bus < n_buses; bus++) {
        fds[bus] = open_bus();
        events[0] = (struct epoll_event){.events = EPOLLIN, .data.u32 = (uint32_t)bus};
        epoll_ctl(epoll, EPOLL_CTL_ADD, fds[bus], &events[0]);
    }
    printf("\n");
    fflush(stdout);
    for (;;) {
        int ready = epoll_wait(epoll, events, MOST_BUSES, began_s > 0 ? QUIET_MS : -1);
        if (ready <= 0 || (began_s > 0 && ended_s - began_s > longest_s))
            break;
        for (int i = 0; i < ready; i++)
            while (take(fds[events[i].data.u32], (int)events[i].data.u32) == BATCH)
                ;
        ended_s = seconds(CLOCK_MONOTONIC);
        ended_cpu_s = seconds(CLOCK_PROCESS_CPUTIME_ID);
        if (began_s == 0) {
            began_s = ended_s;
            began_cpu_s = ended_cpu_s;
        }
        nanosleep(&rest, NULL);
    }
    printf("{\"frames\": [");
    for (int bus = 0; bus < n_buses; bus++)
        printf("%s%ld", bus ? ", " : "", received[bus]);
    printf("], \"lost\": 0, \"wall_s\": %.6f, \"cpu_s\": %.6f}\n", ended_s - began_s, ended_cpu_s - began_cpu_s);
    return 0;
}

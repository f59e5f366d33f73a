/*
 * A user of skinware.h for tools/bench paper: paper_reader NAMESPACE RATE_HZ DRIVER... One thread looks at the newest
 * frames of all drivers at that rate, or (0) each driver has a thread that reads every frame as it comes. Prints "ready",
 * then reads the times between which to measure (CLOCK_MONOTONIC ns). Prints for every thread how many turns it had and how
 * many frames were torn, then a line a turn: age of the oldest frame, processor time of the thread, in ns.
 */

#define SKINWARE_IMPLEMENTATION
#include <skinware.h>

#include <inttypes.h>
#include <pthread.h>
#include <stdio.h>

enum { MOST_DRIVERS = 8, MOST_TURNS = 1 << 17 };

typedef struct look {
    int64_t age_ns, cpu_ns;
} look;

typedef struct user {
    pthread_t thread;
    int first, count; /* of the drivers */
    int64_t period_ns;
    int64_t turns, torn;
    look *looks;
} user;

static skinware_reader *readers[MOST_DRIVERS];
static int64_t begin_ns, end_ns;

static int64_t cpu_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static int is_torn(skinware_reader *reader, const skinware_frame *frame) {
    const skinware_column *column = skinware_find_column(reader, "values");
    const uint16_t *values = (const uint16_t *)skinware_data(frame, column);
    const uint16_t expected = (uint16_t)frame->sequence;
    return values[0] != expected || values[column->count - 1] != expected;
}

static void sleep_until(int64_t time_ns) {
    struct timespec time;
    time.tv_sec = (time_t)(time_ns / 1000000000);
    time.tv_nsec = (long)(time_ns % 1000000000);
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &time, NULL) == EINTR) {
    }
}

static void *use(void *argument) {
    user *mine = (user *)argument;
    skinware_frame frames[MOST_DRIVERS] = {SKINWARE_FRAME_INIT};
    int64_t next_ns = skinware_now_ns(), before_ns = cpu_ns();
    int i;
    while (mine->turns < MOST_TURNS) {
        int64_t now_ns, spent_ns, oldest_ns = INT64_MAX;
        if (mine->period_ns != 0)
            sleep_until(next_ns += mine->period_ns);
        else if (skinware_wait(readers[mine->first], &frames[0], skinware_now_ns() + 10000000000) != SKINWARE_OK)
            break;
        for (i = 0; i < mine->count; i++) {
            if (skinware_read(readers[mine->first + i], &frames[i]) != SKINWARE_OK)
                exit(3);
            if (frames[i].published_ns < oldest_ns)
                oldest_ns = frames[i].published_ns;
        }
        now_ns = skinware_now_ns();
        spent_ns = cpu_ns();
        if (now_ns >= end_ns)
            break;
        if (now_ns >= begin_ns) {
            mine->looks[mine->turns].age_ns = now_ns - oldest_ns;
            mine->looks[mine->turns++].cpu_ns = spent_ns - before_ns;
            for (i = 0; i < mine->count; i++)
                mine->torn += is_torn(readers[mine->first + i], &frames[i]);
        }
        before_ns = cpu_ns();
    }
    return NULL;
}

int main(int count, char **arguments) {
    static user users[MOST_DRIVERS];
    const double rate_hz = count > 2 ? strtod(arguments[2], NULL) : 0;
    const int drivers = count - 3, threads = rate_hz > 0 ? 1 : drivers;
    int64_t turn;
    int i;
    if (drivers < 1 || drivers > MOST_DRIVERS)
        return 1;
    for (i = 0; i < drivers; i++)
        if (skinware_attach(&readers[i], arguments[1], arguments[3 + i]) != SKINWARE_OK)
            return 1;
    puts("ready");
    fflush(stdout);
    if (scanf("%" SCNd64 "%" SCNd64, &begin_ns, &end_ns) != 2)
        return 2;
    for (i = 0; i < threads; i++) {
        users[i].first = i;
        users[i].count = rate_hz > 0 ? drivers : 1;
        users[i].period_ns = rate_hz > 0 ? (int64_t)(1e9 / rate_hz) : 0;
        users[i].looks = (look *)calloc(MOST_TURNS, sizeof(look));
        if (users[i].looks == NULL || pthread_create(&users[i].thread, NULL, use, &users[i]) != 0)
            return 2;
    }
    for (i = 0; i < threads; i++) {
        pthread_join(users[i].thread, NULL);
        printf("%" PRId64 " %" PRId64 "\n", users[i].turns, users[i].torn);
        for (turn = 0; turn < users[i].turns; turn++)
            printf("%" PRId64 " %" PRId64 "\n", users[i].looks[turn].age_ns, users[i].looks[turn].cpu_ns);
    }
    return 0;
}

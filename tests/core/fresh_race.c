/*
 * skinware_fresh while the file's owner changes the table of what each sensor belongs to: fresh_race NAMESPACE SERVICE
 *
 * Every position is that of one sensor, so that a call takes long enough for the table to change in the middle of it.
 */
#define SKINWARE_IMPLEMENTATION
#include "skinware.h"

#include <pthread.h>
#include <stdio.h>

enum { CHANGES = 500, POSITIONS = 20000 };

static volatile uint32_t *owner;
static int is_over;

static void wait_ns(int64_t ns) {
    const int64_t end_ns = skinware_now_ns() + ns;
    while (skinware_now_ns() < end_ns)
        ;
}

static void *scribble(void *unused) {
    int i;
    (void)unused;
    for (i = 0; i < CHANGES; i++) {
        *owner = 0x7fffffffu;
        wait_ns(20000);
        *owner = 0;
        wait_ns(200000);
    }
    __atomic_store_n(&is_over, 1, __ATOMIC_RELEASE);
    return NULL;
}

int main(int count, char **words) {
    static uint32_t positions[POSITIONS];
    static unsigned char fresh[POSITIONS];
    skinware_reader *reader = NULL;
    skinware_frame frame = SKINWARE_FRAME_INIT;
    const skinware_column *table;
    pthread_t thread;
    char path[200];
    unsigned char *map;
    unsigned long calls = 0;
    int fd;
    if (count != 3 || skinware_attach(&reader, words[1], words[2]) || skinware_read(reader, &frame)) {
        fprintf(stderr, "%s\n", skinware_reason());
        return 1;
    }
    table = skinware_find_table(reader, "sensor_group");
    if (table == NULL)
        table = skinware_find_table(reader, "sensor_module");
    snprintf(path, sizeof path, "/dev/shm/skinware.%s/%s.ring", words[1], words[2]);
    fd = open(path, O_RDWR);
    map = (unsigned char *)mmap(NULL, reader->map_size, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    owner = (uint32_t *)(void *)(map + table->offset);
    if (pthread_create(&thread, NULL, scribble, NULL) != 0)
        return 1;
    while (!__atomic_load_n(&is_over, __ATOMIC_ACQUIRE)) {
        skinware_fresh(reader, &frame, 0, positions, POSITIONS, fresh);
        calls++;
    }
    pthread_join(thread, NULL);
    printf("%lu\n", calls);
    munmap(map, reader->map_size);
    close(fd);
    skinware_frame_free(&frame);
    skinware_detach(reader);
    return 0;
}

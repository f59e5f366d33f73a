/*
 * Copies and publication for skinware.memory; take.c has the loops of readers. Plain functions over plain structures, so
 * that one library serves every Python (docs/decisions/0026-native-code.md).
 */

#include "ring.h"

/* What a copy can come to. */
enum { NOTHING = 0, COPIED = 1, OVERTAKEN = -1 };

SKINWARE_EXPORT uint32_t skinware_native_headers(void);
SKINWARE_EXPORT void skinware_native_fence(void);
SKINWARE_EXPORT int skinware_native_copy(const skinware__ring *ring, uint64_t wanted, unsigned char *to);
SKINWARE_EXPORT void skinware_native_begin(skinware_ring_writer *writer, uint64_t skipped);
SKINWARE_EXPORT uint64_t skinware_native_commit(skinware_ring_writer *writer, int64_t acquired_ns, uint64_t flags);
SKINWARE_EXPORT void skinware_native_wake(const skinware_ring_writer *writer);

/* The checksum of the headers that this was compiled with. */
uint32_t skinware_native_headers(void) {
    return SKINWARE_HEADERS;
}

/* Orders everything before it against everything after it. */
void skinware_native_fence(void) {
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
}

/* Copies a frame (0: the newest), header first. NOTHING: there is none, or it is no longer in the ring. Never blocks. */
int skinware_native_copy(const skinware__ring *ring, uint64_t wanted, unsigned char *to) {
    uint64_t copied;
    if (wanted != 0)
        return skinware__copy(ring, wanted, to) ? COPIED : NOTHING;
    copied = skinware__copy_newest(ring, to, SKINWARE__COPY_ATTEMPTS);
    return copied == 0 ? NOTHING : copied == UINT64_MAX ? OVERTAKEN : COPIED;
}

void skinware_native_begin(skinware_ring_writer *writer, uint64_t skipped) {
    writer->skipped = skipped;
    (void)skinware_ring_begin(writer);
}

uint64_t skinware_native_commit(skinware_ring_writer *writer, int64_t acquired_ns, uint64_t flags) {
    return skinware_ring_commit(writer, acquired_ns, flags);
}

void skinware_native_wake(const skinware_ring_writer *writer) {
    skinware_ring_wake(writer);
}

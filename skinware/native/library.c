/*
 * What skinware.memory calls: a sleep that ends with the sample copied, copies, publication. Plain functions over plain
 * structures, so that one library serves every Python (docs/decisions/0026-native-code.md).
 */

#include "ring.h"

/* Changes whenever a function or structure here does; skinware/native/__init__.py has the same number. */
#define ABI 7

/* What a reader asks for. The map outlives it. */
typedef struct skinware_native_request {
    skinware__ring ring;
    uint64_t wake_count; /* the wake word before the reader looked at latest */
    uint64_t known;      /* the latest that is no news */
    uint64_t wanted;     /* sequence of the frame to copy; 0: the newest */
    int64_t timeout_ns;
} skinware_native_request;

/* What a copy can come to. */
enum { NOTHING = 0, COPIED = 1, OVERTAKEN = -1 };

SKINWARE_EXPORT uint32_t skinware_native_abi(void);
SKINWARE_EXPORT void skinware_native_fence(void);
SKINWARE_EXPORT int skinware_native_copy(const skinware__ring *ring, uint64_t wanted, unsigned char *to);
SKINWARE_EXPORT int skinware_native_wait(const skinware_native_request *request, unsigned char *to);
SKINWARE_EXPORT void skinware_native_begin(skinware_ring_writer *writer, uint64_t skipped);
SKINWARE_EXPORT uint64_t skinware_native_commit(skinware_ring_writer *writer, int64_t acquired_ns, uint64_t flags);
SKINWARE_EXPORT void skinware_native_wake(const skinware_ring_writer *writer);

uint32_t skinware_native_abi(void) {
    return ABI;
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

/*
 * Sleeps until the wake word is another than the one given, and copies then if there is news.
 *
 * NOTHING: the time was up, a signal came, the state changed, or the frame wanted is no longer in the ring.
 */
int skinware_native_wait(const skinware_native_request *request, unsigned char *to) {
    (void)skinware__sleep(request->ring.map + SKINWARE__WAKE_WORD_OFFSET, (uint32_t)request->wake_count,
                          request->timeout_ns);
    if (skinware__latest(&request->ring) == request->known)
        return NOTHING;
    return skinware_native_copy(&request->ring, request->wanted, to);
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

/* Frame ring, cell and doorbell: the mechanisms that processes share in memory.
 *
 * Pure C11, no Python: _atomics.c wraps it, and tests/native/ runs it under the sanitizers.
 * docs/reference/segment-format.md describes the bytes; this file is their reference implementation.
 *
 * Every word that two processes may access concurrently is accessed atomically, so there is no data race
 * by the C11 rules. The seqlock follows Boehm, "Can seqlocks get along with programming language memory
 * models?", MSPC 2012, section 4.
 */
#ifndef SHMIO_RING_H
#define SHMIO_RING_H

#include <errno.h>
#include <linux/futex.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#define RING_HEADER_SIZE 128u
#define SLOT_HEADER_SIZE 64u
#define REASON_SIZE 256u
#define RAW_OFFSET (SLOT_HEADER_SIZE + REASON_SIZE)
#define MAX_SLOTS (1u << 24)
#define MAX_FRAME_SIZE (1u << 26)
#define READ_ATTEMPTS 64

#define FLAG_EFFECTIVE 1u /* the slot has an effective image that differs from raw */

typedef _Atomic uint64_t a64;
typedef _Atomic uint32_t a32;
_Static_assert(sizeof(a64) == 8 && sizeof(a32) == 4, "atomics must have the size of what they hold");
_Static_assert(ATOMIC_LLONG_LOCK_FREE == 2 && ATOMIC_INT_LOCK_FREE == 2, "atomics in shared memory must be lock-free");

/* First cache line: fixed when the segment is built. Second cache line: written by the ring's writer. */
typedef struct {
    uint32_t slot_count; /* a power of two */
    uint32_t slot_stride;
    uint32_t frame_size; /* bytes of one image */
    uint32_t reserved3;
    uint32_t raw_offset; /* within a slot; RAW_OFFSET */
    uint32_t effective_offset; /* 0: slots have one image only */
    uint32_t reserved4;
    uint32_t reserved0;
    int64_t period_ns;
    int64_t stale_ns;
    uint64_t reserved1[2];
    a64 head;     /* number of the last complete frame; 0: none yet */
    a32 doorbell; /* futex word: incremented after a frame, or after a run of frames */
    a32 incarnation;
    a32 waiters; /* in a private ring: number of threads that wait on the doorbell */
    uint32_t reserved5;
    uint64_t reserved2[5];
} ring_header;
_Static_assert(sizeof(ring_header) == RING_HEADER_SIZE, "ring header");

typedef struct {
    a64 sequence; /* 2*frame+1 while the frame is being written, 2*frame+2 when complete */
    a64 words[7]; /* slot_info, as words */
} slot_header;
_Static_assert(sizeof(slot_header) == SLOT_HEADER_SIZE, "slot header");

typedef struct {
    uint64_t cycle;
    int64_t publish_ns; /* CLOCK_MONOTONIC */
    int64_t clock_ns;   /* instance clock, since the start */
    int64_t source_ns;  /* UTC, as accurate as the source's clock */
    uint32_t incarnation;
    uint8_t quality;
    uint8_t provenance;
    uint16_t flags;
    uint16_t reason_size;
    uint16_t reserved0;
    uint32_t delay_us; /* maximum age of the image at publish_ns: time since the source requested it */
    uint64_t event; /* in a frame: number of the last event before it; in an event: of the last frame */
} slot_info;
_Static_assert(sizeof(slot_info) == SLOT_HEADER_SIZE - 8, "slot info");

/* A checked view of one ring. It has a copy of the geometry, so that a later change in shared memory
 * cannot cause an access outside the mapping. */
typedef struct {
    uint8_t *base;
    uint32_t slot_count, slot_stride, frame_size, effective_offset;
    bool private; /* only this process uses the ring, and its threads wait with doorbell_wait and ring_waiters */
} ring_view;

static inline uint64_t align8(uint64_t size) { return (size + 7u) & ~(uint64_t)7u; }

static inline ring_header *ring_head(const ring_view *ring) { return (ring_header *)(void *)ring->base; }

static inline uint8_t *ring_slot(const ring_view *ring, uint64_t frame)
{
    return ring->base + RING_HEADER_SIZE + (uint64_t)ring->slot_stride * (frame & (ring->slot_count - 1));
}

/* Checks a ring's header within `size` bytes. Returns NULL if it is valid, else the text of an error. */
static inline const char *ring_open(ring_view *ring, uint8_t *base, uint64_t size)
{
    if (((uintptr_t)base & 7u) != 0) return "ring is not aligned to 8 bytes";
    if (size < RING_HEADER_SIZE) return "ring is shorter than its header";
    ring_header header;
    memcpy(&header, base, offsetof(ring_header, head));
    if (header.slot_count < 4 || header.slot_count > MAX_SLOTS || (header.slot_count & (header.slot_count - 1)) != 0)
        return "slot count is not a power of two in 4..2^24";
    if (header.frame_size == 0 || header.frame_size > MAX_FRAME_SIZE) return "frame size out of range";
    if (header.raw_offset != RAW_OFFSET || (header.effective_offset & 7u) != 0 || (header.slot_stride & 7u) != 0)
        return "slot offsets are wrong";
    uint64_t image = align8(header.frame_size), last = header.effective_offset ? header.effective_offset : RAW_OFFSET;
    if (header.slot_stride < last + image || (header.effective_offset && header.effective_offset < RAW_OFFSET + image))
        return "images overlap or do not fit in a slot";
    if (RING_HEADER_SIZE + (uint64_t)header.slot_count * header.slot_stride > size) return "slots do not fit in the section";
    *ring = (ring_view){base, header.slot_count, header.slot_stride, header.frame_size, header.effective_offset, false};
    return NULL;
}

/* Copies to shared memory in relaxed 64-bit words. The private data may end within a word. */
static inline void words_store(uint8_t *shared, const uint8_t *data, size_t size)
{
    a64 *words = (a64 *)(void *)shared;
    size_t whole = size / 8;
    for (size_t i = 0; i < whole; i++) {
        uint64_t word;
        memcpy(&word, data + 8 * i, 8);
        atomic_store_explicit(&words[i], word, memory_order_relaxed);
    }
    if (size % 8) {
        uint64_t word = 0;
        memcpy(&word, data + 8 * whole, size % 8);
        atomic_store_explicit(&words[whole], word, memory_order_relaxed);
    }
}

/* Copies from shared memory in relaxed 64-bit words. The private data may end within a word. */
static inline void words_load(uint8_t *data, const uint8_t *shared, size_t size)
{
    const a64 *words = (const a64 *)(const void *)shared;
    size_t whole = size / 8;
    for (size_t i = 0; i < whole; i++) {
        uint64_t word = atomic_load_explicit(&words[i], memory_order_relaxed);
        memcpy(data + 8 * i, &word, 8);
    }
    if (size % 8) {
        uint64_t word = atomic_load_explicit(&words[whole], memory_order_relaxed);
        memcpy(data + 8 * whole, &word, size % 8);
    }
}

static inline void futex_wake(a32 *word) { syscall(SYS_futex, word, FUTEX_WAKE, INT32_MAX, NULL, NULL, 0); }

/* Wakes all threads that wait on this word. Readers with a read-only mapping cannot register, so the
 * system call is always made. */
static inline void doorbell_ring(a32 *word)
{
    /* Release: a thread that sees the new value sees everything that was written before it. */
    atomic_fetch_add_explicit(word, 1, memory_order_release);
    futex_wake(word);
}

/* Waits until the word differs from `seen`, or until the time-out (negative: none). Returns 0 or errno
 * (EINTR, ETIMEDOUT). `waiters` counts this thread while it waits, unless it is NULL. */
static inline int doorbell_wait(const a32 *word, a32 *waiters, uint32_t seen, int64_t timeout_ns)
{
    int error = 0;
    struct timespec limit = {timeout_ns / 1000000000, timeout_ns % 1000000000};
    if (waiters) atomic_fetch_add_explicit(waiters, 1, memory_order_seq_cst);
    /* seq_cst, as in ring_wake: either this thread sees the new value of the word, or ring_wake sees this thread. */
    if (atomic_load_explicit(word, memory_order_seq_cst) == seen &&
        syscall(SYS_futex, word, FUTEX_WAIT, seen, timeout_ns < 0 ? NULL : &limit, NULL, 0) != 0 && errno != EAGAIN)
        error = errno;
    if (waiters) atomic_fetch_add_explicit(waiters, (uint32_t)-1, memory_order_relaxed);
    return error;
}

/* Returns what counts the threads that wait on a ring's doorbell; NULL if other processes may wait on it, too. */
static inline a32 *ring_waiters(const ring_view *ring) { return ring->private ? &ring_head(ring)->waiters : NULL; }

/* Wakes all readers. For a private ring, the system call is made only if a thread waits. */
static inline void ring_wake(const ring_view *ring)
{
    ring_header *header = ring_head(ring);
    if (!ring->private) {
        doorbell_ring(&header->doorbell);
        return;
    }
    atomic_fetch_add_explicit(&header->doorbell, 1, memory_order_seq_cst);
    if (atomic_load_explicit(&header->waiters, memory_order_seq_cst)) futex_wake(&header->doorbell);
}

/* Writes a frame, and returns its number. It wakes no reader. Each ring has one writer. `effective` is NULL if
 * consumers see the raw image, or if slots have no room for another. */
static inline uint64_t ring_write(const ring_view *ring, slot_info info, const uint8_t *reason, const uint8_t *raw,
                                  const uint8_t *effective)
{
    ring_header *header = ring_head(ring);
    uint64_t frame = atomic_load_explicit(&header->head, memory_order_relaxed) + 1; /* only the writer changes it */
    uint8_t *base = ring_slot(ring, frame);
    slot_header *slot = (slot_header *)(void *)base;

    atomic_store_explicit(&slot->sequence, 2 * frame + 1, memory_order_relaxed);
    /* Pairs with the acquire fence in ring_read: a reader that sees any word below also sees the odd sequence. */
    atomic_thread_fence(memory_order_release);
    info.flags = (uint16_t)(effective ? info.flags | FLAG_EFFECTIVE : info.flags & ~FLAG_EFFECTIVE);
    words_store((uint8_t *)slot->words, (const uint8_t *)&info, sizeof info);
    if (info.reason_size) words_store(base + SLOT_HEADER_SIZE, reason, info.reason_size);
    words_store(base + RAW_OFFSET, raw, ring->frame_size);
    if (effective) words_store(base + ring->effective_offset, effective, ring->frame_size);
    /* Pairs with the acquire load of the sequence in ring_read: a reader that sees the even number sees the whole frame. */
    atomic_store_explicit(&slot->sequence, 2 * frame + 2, memory_order_release);
    /* Pairs with the acquire load of head in every reader: the slots of all frames up to head were complete. */
    atomic_store_explicit(&header->head, frame, memory_order_release);
    return frame;
}

/* Writes a frame, wakes all readers, and returns the frame's number. */
static inline uint64_t ring_publish(const ring_view *ring, slot_info info, const uint8_t *reason, const uint8_t *raw,
                                    const uint8_t *effective)
{
    uint64_t frame = ring_write(ring, info, reason, raw, effective);
    ring_wake(ring);
    return frame;
}

/* Returns false for numbers that no frame can have, because their sequence would wrap. */
static inline bool ring_may_have(uint64_t frame) { return frame != 0 && frame <= UINT64_MAX / 2 - 1; }

/* Copies one frame; its number must satisfy ring_may_have(). Returns false if the slot no longer has it, or is being
 * overwritten. `reason` has REASON_SIZE bytes. */
static inline bool ring_read(const ring_view *ring, uint64_t frame, slot_info *info, uint8_t *reason, uint8_t *raw,
                             uint8_t *effective)
{
    const uint8_t *base = ring_slot(ring, frame);
    const slot_header *slot = (const slot_header *)(const void *)base;
    uint64_t whole = 2 * frame + 2;
    if (atomic_load_explicit(&slot->sequence, memory_order_acquire) != whole) return false;
    words_load((uint8_t *)info, (const uint8_t *)slot->words, sizeof *info);
    if (info->reason_size > REASON_SIZE) info->reason_size = REASON_SIZE; /* torn or hostile; checked below */
    if (info->reason_size) words_load(reason, base + SLOT_HEADER_SIZE, info->reason_size);
    words_load(raw, base + RAW_OFFSET, ring->frame_size);
    if (!ring->effective_offset) info->flags &= (uint16_t)~FLAG_EFFECTIVE;
    if (info->flags & FLAG_EFFECTIVE) words_load(effective, base + ring->effective_offset, ring->frame_size);
    /* Pairs with the release fence in ring_write. */
    atomic_thread_fence(memory_order_acquire);
    return atomic_load_explicit(&slot->sequence, memory_order_relaxed) == whole;
}

/* Copies the newest frame and returns its number. Returns 0 if the ring has no frame yet, or if the writer
 * has overtaken each of READ_ATTEMPTS reads. */
static inline uint64_t ring_latest(const ring_view *ring, slot_info *info, uint8_t *reason, uint8_t *raw, uint8_t *effective)
{
    for (int attempt = 0; attempt < READ_ATTEMPTS; attempt++) {
        uint64_t frame = atomic_load_explicit(&ring_head(ring)->head, memory_order_acquire);
        if (frame == 0 || ring_read(ring, frame, info, reason, raw, effective)) return frame;
    }
    return 0;
}

/* Writes a cell: a sequence word, then bytes. A cell has one writer. Readers copy all of its bytes or none. */
static inline void cell_write(uint8_t *cell, const uint8_t *data, size_t size)
{
    a64 *sequence = (a64 *)(void *)cell;
    uint64_t odd = atomic_load_explicit(sequence, memory_order_relaxed) | 1u; /* an earlier writer may have died half-way */
    atomic_store_explicit(sequence, odd, memory_order_relaxed);
    atomic_thread_fence(memory_order_release); /* pairs with the fence in cell_read */
    words_store(cell + 8, data, size);
    atomic_store_explicit(sequence, odd + 1, memory_order_release); /* pairs with the first load in cell_read */
}

/* Copies a cell. Returns false if it was being written at each of READ_ATTEMPTS attempts. */
static inline bool cell_read(const uint8_t *cell, uint8_t *data, size_t size)
{
    const a64 *sequence = (const a64 *)(const void *)cell;
    for (int attempt = 0; attempt < READ_ATTEMPTS; attempt++) {
        uint64_t before = atomic_load_explicit(sequence, memory_order_acquire);
        if (before & 1u) continue;
        words_load(data, cell + 8, size);
        atomic_thread_fence(memory_order_acquire);
        if (atomic_load_explicit(sequence, memory_order_relaxed) == before) return true;
    }
    return false;
}

#endif

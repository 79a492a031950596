/* A queue of byte records in shared memory, for one producer and one consumer. Neither ever waits.
 *
 * Pure C11 like ring.h. Writers send commands to a source through such queues. Each pair of writer and
 * block has one. docs/reference/segment-format.md describes the bytes. Accesses to the data are not
 * atomic; head and tail order them. The bytes between tail and head belong to the consumer, all others
 * to the producer.
 */
#ifndef SHMIO_QUEUE_H
#define SHMIO_QUEUE_H

#include "ring.h"

#define QUEUE_HEADER_SIZE 128u
#define RECORD_HEADER_SIZE 8u /* u32 bytes of the record, u32 zero */

typedef struct {
    a64 head; /* total bytes added; in the producer's cache line */
    uint64_t reserved0[7];
    a64 tail; /* total bytes removed; in the consumer's cache line */
    uint64_t reserved1[7];
} queue_header;
_Static_assert(sizeof(queue_header) == QUEUE_HEADER_SIZE, "queue header");

enum queue_result { QUEUE_EMPTY = 0, QUEUE_RECORD = 1, QUEUE_BROKEN = 2 };

/* Copies bytes into the queue, and wraps at `capacity`, a power of two. */
static inline void queue_copy_in(uint8_t *data, uint64_t capacity, uint64_t at, const uint8_t *from, uint64_t size)
{
    uint64_t start = at & (capacity - 1), first = size < capacity - start ? size : capacity - start;
    memcpy(data + start, from, first);
    memcpy(data, from + first, size - first);
}

/* Copies bytes out of the queue, and wraps at `capacity`. */
static inline void queue_copy_out(uint8_t *to, const uint8_t *data, uint64_t capacity, uint64_t at, uint64_t size)
{
    uint64_t start = at & (capacity - 1), first = size < capacity - start ? size : capacity - start;
    memcpy(to, data + start, first);
    memcpy(to + first, data, size - first);
}

/* Adds a record. Returns false if the queue has no room. The consumer never sees an incomplete record,
 * even if the producer dies. */
static inline bool queue_push(uint8_t *queue, uint64_t capacity, const uint8_t *record, uint32_t size)
{
    queue_header *header = (queue_header *)(void *)queue;
    uint8_t *data = queue + QUEUE_HEADER_SIZE;
    uint64_t needed = RECORD_HEADER_SIZE + align8(size);
    uint64_t head = atomic_load_explicit(&header->head, memory_order_relaxed); /* only the producer writes it */
    /* Pairs with the release store in queue_drop: the producer may overwrite records that the consumer has removed. */
    uint64_t used = head - atomic_load_explicit(&header->tail, memory_order_acquire);
    if (used > capacity || needed > capacity - used) return false;
    uint32_t words[2] = {size, 0};
    queue_copy_in(data, capacity, head, (const uint8_t *)words, sizeof words);
    queue_copy_in(data, capacity, head + RECORD_HEADER_SIZE, record, size);
    /* Pairs with the acquire load in queue_peek: a consumer that sees this head sees the record. */
    atomic_store_explicit(&header->head, head + needed, memory_order_release);
    return true;
}

/* Finds the size of the oldest record. Returns BROKEN if head, tail and size are inconsistent, which shmio
 * never writes. */
static inline enum queue_result queue_peek(const uint8_t *queue, uint64_t capacity, uint32_t *size)
{
    const queue_header *header = (const queue_header *)(const void *)queue;
    uint64_t tail = atomic_load_explicit(&header->tail, memory_order_relaxed); /* only the consumer writes it */
    uint64_t used = atomic_load_explicit(&header->head, memory_order_acquire) - tail;
    if (used == 0) return QUEUE_EMPTY;
    uint32_t words[2];
    if (used > capacity || used < RECORD_HEADER_SIZE) return QUEUE_BROKEN;
    queue_copy_out((uint8_t *)words, queue + QUEUE_HEADER_SIZE, capacity, tail, sizeof words);
    if (RECORD_HEADER_SIZE + align8(words[0]) > used) return QUEUE_BROKEN;
    *size = words[0];
    return QUEUE_RECORD;
}

/* Copies out and removes the record that queue_peek has found. */
static inline void queue_drop(uint8_t *queue, uint64_t capacity, uint8_t *record, uint32_t size)
{
    queue_header *header = (queue_header *)(void *)queue;
    uint64_t tail = atomic_load_explicit(&header->tail, memory_order_relaxed);
    queue_copy_out(record, queue + QUEUE_HEADER_SIZE, capacity, tail + RECORD_HEADER_SIZE, size);
    /* Pairs with the acquire load in queue_push: a producer that sees this tail may overwrite the record. */
    atomic_store_explicit(&header->tail, tail + RECORD_HEADER_SIZE + align8(size), memory_order_release);
}

/* Discards all records; the consumer calls this after BROKEN. */
static inline void queue_clear(uint8_t *queue)
{
    queue_header *header = (queue_header *)(void *)queue;
    uint64_t head = atomic_load_explicit(&header->head, memory_order_acquire);
    atomic_store_explicit(&header->tail, head, memory_order_release);
}

#endif

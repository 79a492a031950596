/* Runs of frames as bytes: the entries of a message of the fabric (docs/reference/fabric.md).
 *
 * Pure C11 like ring.h. It copies many frames between a ring and a message at once, but only plain ones: good,
 * without a reason. Python does the same for all other entries (shmio/fabric/messages.py), and for one entry at a
 * time. */
#ifndef SHMIO_FRAMES_H
#define SHMIO_FRAMES_H

#include "ring.h"

enum { ENTRY_FRAME = 1, ENTRY_HEADER_SIZE = 5, FRAME_HEADER_SIZE = 68, QUALITY_GOOD = 2, LAST_PROVENANCE = 3 };

/* The header of a frame of a recording, shmio.frame.v1 (docs/reference/dump-format.md). All fields are
 * little-endian. */
typedef struct {
    uint64_t number, cycle;
    int64_t publish_ns, clock_ns, source_ns;
    uint64_t event;
    uint32_t incarnation;
    uint8_t quality, provenance;
    uint16_t flags, reason_size, reserved;
    uint32_t frame_size, delay_us;
} frame_header;
_Static_assert(offsetof(frame_header, delay_us) + sizeof(uint32_t) == FRAME_HEADER_SIZE, "frame header");
_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "frames are encoded in the byte order of this host");

/* Returns the maximum size of the entry of a plain frame. */
static inline size_t frames_entry_size(const ring_view *ring)
{
    return ENTRY_HEADER_SIZE + FRAME_HEADER_SIZE + (size_t)ring->frame_size * (ring->effective_offset ? 2 : 1);
}

/* Copies the plain frames after `*last` into `data`: those that follow each other without an event after `event`.
 * Stops at any other frame, or when a further entry might need more than `room` bytes. Returns the number of bytes;
 * `*last` is then the last frame, and `*clock_ns` the latest time of all of them on the instance's clock. */
static inline size_t frames_pack(const ring_view *ring, uint64_t event, uint8_t *data, size_t room, uint64_t *last,
                                 int64_t *clock_ns)
{
    uint64_t head = atomic_load_explicit(&ring_head(ring)->head, memory_order_acquire);
    uint8_t reason[REASON_SIZE];
    size_t size = 0;
    while (*last < head && ring_may_have(*last + 1) && room - size >= frames_entry_size(ring)) {
        slot_info info;
        uint8_t *raw = data + size + ENTRY_HEADER_SIZE + FRAME_HEADER_SIZE;
        if (!ring_read(ring, *last + 1, &info, reason, raw, raw + ring->frame_size)) break;
        if (info.quality != QUALITY_GOOD || info.reason_size || info.provenance > LAST_PROVENANCE || info.event > event)
            break;
        frame_header header = {
            ++*last, info.cycle, info.publish_ns, info.clock_ns, info.source_ns, info.event, info.incarnation,
            info.quality, info.provenance, info.flags & FLAG_EFFECTIVE, 0, 0, ring->frame_size, info.delay_us,
        };
        uint32_t length = FRAME_HEADER_SIZE + ring->frame_size * (header.flags ? 2 : 1);
        data[size] = ENTRY_FRAME;
        memcpy(data + size + 1, &length, sizeof length);
        memcpy(data + size + ENTRY_HEADER_SIZE, &header, FRAME_HEADER_SIZE);
        if (!size || info.clock_ns > *clock_ns) *clock_ns = info.clock_ns;
        size += ENTRY_HEADER_SIZE + length;
    }
    return size;
}

/* Publishes the plain frames at the beginning of `data`: those with the numbers after `number`, without a gap. Wakes
 * the readers once. Each frame gets the times, the event and the incarnation of `stamp`. Its age is the one that it
 * had when its owner published it, the time from then to `made_ns` on the owner's clock, and `late_ns`. Returns the
 * number of frames; `*end` is then the position after the last one, and `*last` its own position. */
static inline uint32_t frames_publish(const ring_view *ring, const uint8_t *data, size_t size, uint64_t number,
                                      slot_info stamp, int64_t made_ns, uint64_t late_ns, size_t *last, size_t *end)
{
    uint32_t count = 0, length;
    size_t at = 0;
    while (size - at >= ENTRY_HEADER_SIZE + FRAME_HEADER_SIZE && data[at] == ENTRY_FRAME) {
        frame_header header;
        memcpy(&length, data + at + 1, sizeof length);
        memcpy(&header, data + at + ENTRY_HEADER_SIZE, FRAME_HEADER_SIZE);
        bool effective = header.flags & FLAG_EFFECTIVE;
        if (length != FRAME_HEADER_SIZE + (uint64_t)ring->frame_size * (effective ? 2 : 1) ||
            length > size - at - ENTRY_HEADER_SIZE || header.frame_size != ring->frame_size || header.reason_size ||
            header.quality != QUALITY_GOOD || header.provenance > LAST_PROVENANCE || header.number != number + 1 ||
            (effective && !ring->effective_offset))
            break;
        uint64_t waited_ns = made_ns > header.publish_ns ? (uint64_t)made_ns - (uint64_t)header.publish_ns : 0;
        uint64_t age_us = header.delay_us + waited_ns / 1000 + late_ns / 1000 + 1;
        slot_info info = stamp;
        info.cycle = header.cycle;
        info.source_ns = header.source_ns;
        info.quality = header.quality;
        info.provenance = header.provenance;
        info.delay_us = age_us < UINT32_MAX ? (uint32_t)age_us : UINT32_MAX;
        const uint8_t *raw = data + at + ENTRY_HEADER_SIZE + FRAME_HEADER_SIZE;
        ring_write(ring, info, NULL, raw, effective ? raw + ring->frame_size : NULL);
        number++;
        count++;
        *last = at;
        *end = at += ENTRY_HEADER_SIZE + length;
    }
    if (count) ring_wake(ring);
    return count;
}

#endif

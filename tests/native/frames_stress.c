/* Frames go from a ring, which is being written, through messages into another ring, for the sanitizers. Exit status 0:
 * every frame arrived whole, and in order, up to the last one. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>

#include "../../shmio/segment/frames.h"

enum { SLOTS = 16, SIZE = 1004, FRAMES = 30000, MESSAGE = 4 * (ENTRY_HEADER_SIZE + FRAME_HEADER_SIZE + 2 * SIZE) };

static int problems;

static void check(bool right, const char *what)
{
    if (right) return;
    problems++;
    fprintf(stderr, "broken: %s\n", what);
}

static ring_view make_ring(void)
{
    uint64_t image = align8(SIZE), stride = RAW_OFFSET + 2 * image, size = RING_HEADER_SIZE + SLOTS * stride;
    uint8_t *memory = aligned_alloc(64, (size + 63) / 64 * 64);
    memset(memory, 0, size);
    ring_header *header = (ring_header *)(void *)memory;
    header->slot_count = SLOTS;
    header->slot_stride = (uint32_t)stride;
    header->frame_size = SIZE;
    header->raw_offset = RAW_OFFSET;
    header->effective_offset = (uint32_t)(RAW_OFFSET + image);
    ring_view ring;
    const char *wrong = ring_open(&ring, memory, size);
    if (wrong) {
        fprintf(stderr, "%s\n", wrong);
        exit(1);
    }
    return ring;
}

static void *write_frames(void *near)
{
    uint8_t raw[SIZE], effective[SIZE];
    for (uint64_t frame = 1; frame <= FRAMES; frame++) {
        memset(raw, (int)frame, SIZE);
        memset(effective, (int)(frame + 1), SIZE);
        slot_info info = {.cycle = 3 * frame, .clock_ns = (int64_t)frame, .quality = QUALITY_GOOD};
        ring_publish(near, info, NULL, raw, frame % 2 ? effective : NULL);
    }
    return NULL;
}

static bool uniform(const uint8_t *image, uint64_t frame)
{
    for (uint32_t i = 0; i < SIZE; i++)
        if (image[i] != (uint8_t)frame) return false;
    return true;
}

/* Checks the newest `count` frames of the far ring, of which the last one was the frame `last` of the near ring. */
static void check_frames(const ring_view *far, uint32_t count, uint64_t last)
{
    uint8_t raw[SIZE], effective[SIZE], reason[REASON_SIZE];
    uint64_t head = atomic_load(&ring_head(far)->head);
    for (uint32_t back = 0; back < count; back++) {
        slot_info info;
        uint64_t frame = last - back;
        bool read = ring_read(far, head - back, &info, reason, raw, effective);
        check(read && info.cycle == 3 * frame && info.incarnation == 7 && uniform(raw, frame), "a frame is torn");
        check(((info.flags & FLAG_EFFECTIVE) != 0) == (frame % 2 != 0), "an effective image");
        if (info.flags & FLAG_EFFECTIVE) check(uniform(effective, frame + 1), "an effective image is torn");
    }
}

int main(void)
{
    static uint8_t message[MESSAGE];
    ring_view near = make_ring(), far = make_ring();
    uint64_t last = 0, seen = 0;
    pthread_t writer;
    pthread_create(&writer, NULL, write_frames, &near);
    while (last < FRAMES) {
        a32 *bell = &ring_head(&near)->doorbell;
        uint32_t before = atomic_load_explicit(bell, memory_order_acquire);
        uint64_t head = atomic_load_explicit(&ring_head(&near)->head, memory_order_acquire), from = last;
        int64_t clock_ns = 0;
        size_t size = frames_pack(&near, 0, message, sizeof message, &last, &clock_ns), at = 0, end = 0;
        if (size) {
            uint32_t count = frames_publish(&far, message, size, from, (slot_info){.incarnation = 7}, 0, 0, &at, &end);
            check(count == last - from && end == size && clock_ns == (int64_t)last, "a message is not whole");
            check_frames(&far, count, last);
            seen += count;
        } else if (head == last) {
            doorbell_wait(bell, NULL, before, 1000000000);
        } else {
            uint64_t newest = atomic_load(&ring_head(&near)->head);
            check(newest > last + SLOTS - 1, "a frame was lost early");
            uint64_t resume = newest - SLOTS / 2;
            if (resume <= last) resume = last + 1;
            last = resume;
        }
    }
    pthread_join(writer, NULL);
    check(last == atomic_load(&ring_head(&near)->head), "the last frame was not reached");
    check(seen == atomic_load(&ring_head(&far)->head), "frames seen and published differ");
    free(near.base);
    free(far.base);
    return problems ? 1 : 0;
}

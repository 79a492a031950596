/* Many threads on one ring, for the sanitizers. Exit status 0: every frame read was whole, in order, and every gap counted. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>

#include "../../shmio/segment/ring.h"

enum { SLOTS = 16, SIZE = 1004, FRAMES = 30000, LATEST_READERS = 3, STREAM_READERS = 3 };

static ring_view ring;
static _Atomic int problems;
static uint8_t cell[8 + 64] __attribute__((aligned(8)));

static void check(bool right, const char *what)
{
    if (right) return;
    atomic_fetch_add(&problems, 1);
    fprintf(stderr, "broken: %s\n", what);
}

static bool uniform(const uint8_t *image, uint64_t frame)
{
    for (uint32_t i = 0; i < SIZE; i++)
        if (image[i] != (uint8_t)frame) return false;
    return true;
}

static void *write_frames(void *unused)
{
    (void)unused;
    uint8_t raw[SIZE], effective[SIZE], reason[REASON_SIZE];
    for (uint64_t frame = 1; frame <= FRAMES; frame++) {
        memset(raw, (int)frame, SIZE);
        memset(effective, (int)(frame + 1), SIZE);
        memset(reason, (int)(frame % 26 + 'a'), sizeof reason);
        slot_info info = {.cycle = 3 * frame, .quality = 2, .reason_size = frame % 3 ? 0 : REASON_SIZE};
        check(ring_publish(&ring, info, reason, raw, frame % 2 ? effective : NULL) == frame, "frame number");
        uint64_t words[8] = {frame, frame, frame, frame, frame, frame, frame, frame};
        cell_write(cell, (const uint8_t *)words, sizeof words);
    }
    return NULL;
}

static bool sound(uint64_t frame, const slot_info *info, const uint8_t *reason, const uint8_t *raw, const uint8_t *effective)
{
    if (info->cycle != 3 * frame || !uniform(raw, frame)) return false;
    if (((info->flags & FLAG_EFFECTIVE) != 0) != (frame % 2 != 0)) return false;
    if ((info->flags & FLAG_EFFECTIVE) && !uniform(effective, frame + 1)) return false;
    for (uint32_t i = 0; i < info->reason_size; i++)
        if (reason[i] != frame % 26 + 'a') return false;
    return true;
}

static void *read_latest(void *unused)
{
    (void)unused;
    uint8_t raw[SIZE], effective[SIZE], reason[REASON_SIZE];
    slot_info info;
    uint64_t last = 0;
    while (last < FRAMES) {
        uint64_t frame = ring_latest(&ring, &info, reason, raw, effective);
        if (frame == 0) continue;
        check(frame >= last, "latest went back");
        check(sound(frame, &info, reason, raw, effective), "latest is torn");
        last = frame;
        uint64_t words[8];
        if (cell_read(cell, (uint8_t *)words, sizeof words)) check(words[0] == words[7], "cell is torn");
    }
    return NULL;
}

static void *read_stream(void *unused)
{
    (void)unused;
    uint8_t raw[SIZE], effective[SIZE], reason[REASON_SIZE];
    slot_info info;
    uint64_t last = 0, seen = 0, missed = 0;
    while (last < FRAMES) {
        a32 *bell = &ring_head(&ring)->doorbell;
        uint32_t before = atomic_load_explicit(bell, memory_order_acquire);
        uint64_t head = atomic_load_explicit(&ring_head(&ring)->head, memory_order_acquire);
        if (head == last) {
            doorbell_wait(bell, ring_waiters(&ring), before, 1000000000);
            continue;
        }
        if (ring_read(&ring, last + 1, &info, reason, raw, effective)) {
            check(sound(last + 1, &info, reason, raw, effective), "stream frame is torn");
            last++;
            seen++;
        } else {
            check(head > last + SLOTS - 1 || atomic_load(&ring_head(&ring)->head) > last + SLOTS - 1, "a frame was lost early");
            uint64_t resume = atomic_load(&ring_head(&ring)->head) - SLOTS / 2;
            if (resume <= last) resume = last + 1;
            missed += resume - last;
            last = resume;
        }
    }
    check(seen + missed == last, "frames seen and missed do not add up");
    return NULL;
}

/* Returns 0 if all went well with a ring that other processes may use, or with a private one. */
static int run(bool private)
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
    const char *wrong = ring_open(&ring, memory, size);
    if (wrong) {
        fprintf(stderr, "%s\n", wrong);
        return 1;
    }
    ring.private = private;
    pthread_t threads[1 + LATEST_READERS + STREAM_READERS];
    int count = 0;
    for (int i = 0; i < LATEST_READERS; i++) pthread_create(&threads[count++], NULL, read_latest, NULL);
    for (int i = 0; i < STREAM_READERS; i++) pthread_create(&threads[count++], NULL, read_stream, NULL);
    pthread_create(&threads[count++], NULL, write_frames, NULL);
    for (int i = 0; i < count; i++) pthread_join(threads[i], NULL);
    check(atomic_load(&header->waiters) == 0, "a thread still counts as waiting");
    free(memory);
    return atomic_load(&problems) ? 1 : 0;
}

int main(void) { return run(false) || run(true); }

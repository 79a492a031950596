/* What time it is for a source of a running instance, from docs/reference/segment-format.md alone; for reader.c. */
#ifndef EXAMPLES_CLOCK_H
#define EXAMPLES_CLOCK_H

#include <stdatomic.h>
#include <stdint.h>
#include <string.h>
#include <time.h>

#define CLOCK_WORD(at) ((const _Atomic uint64_t *)(const void *)(base + (at)))

/* Where the clock page is, if the source of this layout lives on it; else 0. `table`, `end`: the section table. */
static inline uint64_t clock_page(const uint8_t *base, uint64_t size, uint64_t table, uint64_t end, uint32_t layout)
{
    static const char key[] = "\"stepped\":true"; /* of the attributes, JSON without blanks */
    uint64_t page = 0, key_size = sizeof key - 1;
    int lives = 0;
    for (uint64_t entry = table; entry < end; entry += 128) {
        uint32_t kind, of;
        uint64_t at, length;
        memcpy(&kind, base + entry, 4), memcpy(&of, base + entry + 24, 4); /* entries below the count never change, */
        memcpy(&at, base + entry + 8, 8), memcpy(&length, base + entry + 16, 8); /* but for flags, which is not read */
        if (at % 64 || at > size || length > size - at) continue;
        if (kind == 7 && length >= 576) page = at;
        for (uint64_t i = at; kind == 5 && of == layout && i + key_size <= at + length; i++)
            lives |= memcmp(base + i, key, key_size) == 0;
    }
    return lives ? page : 0;
}

/* The present, comparable to a frame's `publish`. `page`: where the clock page is; 0: the source keeps real time. Who
 * calls has checked that the page lies within the mapping, aligned. */
static inline int64_t present_ns(const uint8_t *base, uint64_t page)
{
    for (unsigned attempt = 0; page && attempt < 16; attempt++) { /* of the two copies one is whole at any time */
        uint64_t cell = page + (attempt % 2 ? 320 : 64), words[4];
        uint64_t sequence = atomic_load_explicit(CLOCK_WORD(cell), memory_order_acquire);
        for (unsigned i = 0; i < 4; i++)
            words[i] = atomic_load_explicit(CLOCK_WORD(cell + 8 + 8 * i), memory_order_relaxed);
        atomic_thread_fence(memory_order_acquire);
        if (sequence % 2 || atomic_load_explicit(CLOCK_WORD(cell), memory_order_relaxed) != sequence) continue;
        if ((uint32_t)words[0] == 0) break; /* wall */
        uint64_t started = atomic_load_explicit(CLOCK_WORD(40), memory_order_relaxed);
        return (int64_t)(started + words[2] - (words[0] >> 33 & 1 ? words[3] : 0)); /* a step under way: before it */
    }
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

#endif

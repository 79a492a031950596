/* From a doorbell to an event loop: what a thread does that waits for the one and tells the other by an eventfd(2).
 *
 * Pure C11, as ring.h. An event loop cannot wait on a futex, and a thread that needs the interpreter's lock to tell it
 * of each ring fights with it for that lock; this one never needs it. */
#ifndef SHMIO_RELAY_H
#define SHMIO_RELAY_H

#include "ring.h"

enum { RELAY_HEARD, RELAY_TOLD, RELAY_HELD, RELAY_STOPPED };

/* What the thread and the event loop share. Whatever is not HEARD: the loop has not looked yet, and will. */
typedef struct {
    a32 state;
    a32 reserved;
    _Atomic(const a32 *) word; /* the doorbell, as long as the thread waits for it */
} relay;
_Static_assert(sizeof(relay) == 16, "relay");

/* Makes `descriptor` readable at first, after each ring, and after `turn_ns` without one; a loop that has not heard of
 * the last one is not told again, and whoever rings need not wake us then. Returns when it is stopped. */
static inline void relay_run(relay *shared, const a32 *word, int descriptor, int64_t turn_ns)
{
    const uint64_t one = 1;
    atomic_store(&shared->word, word);
    for (;;) {
        /* Before telling: what comes from now on is told again. */
        uint32_t seen = atomic_load_explicit(word, memory_order_acquire);
        uint32_t state = RELAY_HEARD;
        if (atomic_compare_exchange_strong(&shared->state, &state, RELAY_TOLD)) {
            if (write(descriptor, &one, sizeof one) < 0) return; /* never: its counter does not overflow by one */
        } else if (state == RELAY_TOLD && atomic_compare_exchange_strong(&shared->state, &state, RELAY_HELD)) {
            doorbell_wait(&shared->state, RELAY_HELD, -1);
        }
        if (atomic_load(&shared->state) == RELAY_STOPPED) return;
        doorbell_wait(word, seen, turn_ns);
    }
}

/* Changes the state, unless the thread is to end: that is final. */
static inline void relay_free(relay *shared, uint32_t state)
{
    uint32_t before = atomic_load(&shared->state);
    while (before != RELAY_STOPPED && !atomic_compare_exchange_weak(&shared->state, &before, state)) {}
    if (before == RELAY_HELD) syscall(SYS_futex, &shared->state, FUTEX_WAKE, 1, NULL, NULL, 0);
}

/* The loop's, before it looks at what the doorbell rings for. Not after relay_stop: the descriptor may be another's. */
static inline void relay_heard(relay *shared, int descriptor)
{
    uint64_t count;
    if (read(descriptor, &count, sizeof count) < 0) count = 0; /* EAGAIN: told by something else */
    relay_free(shared, RELAY_HEARD);
}

/* Has the thread return: at once, or, if it is just about to wait, within its `turn_ns` or by another relay_stop. It
 * tells nothing more. */
static inline void relay_stop(relay *shared)
{
    relay_free(shared, RELAY_STOPPED);
    const a32 *word = atomic_load(&shared->word);
    if (word) syscall(SYS_futex, word, FUTEX_WAKE, INT32_MAX, NULL, NULL, 0); /* others look, and wait on */
}

#endif

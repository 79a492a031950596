/* A thread that waits on a doorbell and wakes an event loop by an eventfd(2).
 *
 * Pure C11 like ring.h. An event loop cannot wait on a futex. A thread that takes the interpreter's lock
 * for each wake-up would compete with the loop for it; this thread never needs the lock. */
#ifndef SHMIO_RELAY_H
#define SHMIO_RELAY_H

#include "ring.h"

enum { RELAY_HEARD, RELAY_TOLD, RELAY_HELD, RELAY_STOPPED };

/* State that the thread and the event loop share. HEARD: the loop has handled the last wake-up. TOLD: it has
 * not handled it yet. HELD: it has not, and the thread waits until it has. */
typedef struct {
    a32 state;
    a32 reserved;
    _Atomic(const a32 *) word; /* the doorbell while the thread waits for it */
} relay;
_Static_assert(sizeof(relay) == 16, "relay");

/* Makes `descriptor` readable at the start, after each ring of the doorbell, and after `turn_ns` without
 * one. There is no further wake-up until the loop has handled the last one; meanwhile, ringing the
 * doorbell need not wake this thread. Returns when it is stopped. */
static inline void relay_run(relay *shared, const a32 *word, int descriptor, int64_t turn_ns)
{
    const uint64_t one = 1;
    atomic_store(&shared->word, word);
    for (;;) {
        /* Before the write, so that any later ring causes another wake-up. */
        uint32_t seen = atomic_load_explicit(word, memory_order_acquire);
        uint32_t state = RELAY_HEARD;
        if (atomic_compare_exchange_strong(&shared->state, &state, RELAY_TOLD)) {
            if (write(descriptor, &one, sizeof one) < 0) return; /* cannot happen: the counter does not overflow */
        } else if (state == RELAY_TOLD && atomic_compare_exchange_strong(&shared->state, &state, RELAY_HELD)) {
            doorbell_wait(&shared->state, RELAY_HELD, -1);
        }
        if (atomic_load(&shared->state) == RELAY_STOPPED) return;
        doorbell_wait(word, seen, turn_ns);
    }
}

/* Changes the state, unless it is STOPPED, which is final. */
static inline void relay_free(relay *shared, uint32_t state)
{
    uint32_t before = atomic_load(&shared->state);
    while (before != RELAY_STOPPED && !atomic_compare_exchange_weak(&shared->state, &before, state)) {}
    if (before == RELAY_HELD) syscall(SYS_futex, &shared->state, FUTEX_WAKE, 1, NULL, NULL, 0);
}

/* The loop calls this before it checks the shared data. Do not call it after relay_stop: the descriptor
 * may have been closed and reused. */
static inline void relay_heard(relay *shared, int descriptor)
{
    uint64_t count;
    if (read(descriptor, &count, sizeof count) < 0) count = 0; /* EAGAIN: something else woke the loop */
    relay_free(shared, RELAY_HEARD);
}

/* Makes the thread return at once. If the thread is just about to wait, it returns after `turn_ns` or
 * another relay_stop. There are no more wake-ups. */
static inline void relay_stop(relay *shared)
{
    relay_free(shared, RELAY_STOPPED);
    const a32 *word = atomic_load(&shared->word);
    if (word) syscall(SYS_futex, word, FUTEX_WAKE, INT32_MAX, NULL, NULL, 0); /* other waiters check the word and wait again */
}

#endif

/* Lets a thread wait on a doorbell, and wake an event loop by an eventfd(2).
 *
 * Pure C11 like ring.h. An event loop cannot wait on a futex, so a thread waits for it. The thread never
 * takes the interpreter's lock, for which it would compete with the loop. */
#ifndef SHMIO_RELAY_H
#define SHMIO_RELAY_H

#include "ring.h"

enum { RELAY_IDLE, RELAY_NOTIFIED, RELAY_WAITING, RELAY_STOPPED };

/* State that the thread and the event loop share. IDLE: the loop has handled the last wake-up. NOTIFIED: the
 * loop has not handled it yet. WAITING: the same, and the thread waits until the loop has handled it. */
typedef struct {
    a32 state;
    a32 reserved;
    _Atomic(const a32 *) word; /* the doorbell while the thread waits for it */
} relay;
_Static_assert(sizeof(relay) == 16, "relay");

/* Makes `descriptor` readable at the start, after each ring of the doorbell, and after `turn_ns` without a
 * ring. `waiters` is that of doorbell_wait. Until the loop has handled a wake-up, it gets no other, and the
 * doorbell does not wake this thread. Returns after relay_stop. */
static inline void relay_run(relay *shared, const a32 *word, a32 *waiters, int descriptor, int64_t turn_ns)
{
    const uint64_t one = 1;
    atomic_store(&shared->word, word);
    for (;;) {
        /* Loaded before the write, so that any later ring causes another wake-up. */
        uint32_t seen = atomic_load_explicit(word, memory_order_acquire);
        uint32_t state = RELAY_IDLE;
        if (atomic_compare_exchange_strong(&shared->state, &state, RELAY_NOTIFIED)) {
            if (write(descriptor, &one, sizeof one) < 0) return; /* cannot happen: the counter does not overflow */
        } else if (state == RELAY_NOTIFIED && atomic_compare_exchange_strong(&shared->state, &state, RELAY_WAITING)) {
            doorbell_wait(&shared->state, NULL, RELAY_WAITING, -1);
        }
        if (atomic_load(&shared->state) == RELAY_STOPPED) return;
        doorbell_wait(word, waiters, seen, turn_ns);
    }
}

/* Changes the state, unless it is STOPPED, which is final. */
static inline void relay_free(relay *shared, uint32_t state)
{
    uint32_t before = atomic_load(&shared->state);
    while (before != RELAY_STOPPED && !atomic_compare_exchange_weak(&shared->state, &before, state)) {}
    if (before == RELAY_WAITING) syscall(SYS_futex, &shared->state, FUTEX_WAKE, 1, NULL, NULL, 0);
}

/* Acknowledges a wake-up. The loop calls this before it checks the shared data. Do not call it after
 * relay_stop, because the descriptor may have been closed and reused. */
static inline void relay_heard(relay *shared, int descriptor)
{
    uint64_t count;
    if (read(descriptor, &count, sizeof count) < 0) count = 0; /* EAGAIN: something else woke the loop */
    relay_free(shared, RELAY_IDLE);
}

/* Ends the wake-ups, and makes the thread return at once. If the thread is just about to wait, it returns
 * after `turn_ns` or another relay_stop. */
static inline void relay_stop(relay *shared)
{
    relay_free(shared, RELAY_STOPPED);
    const a32 *word = atomic_load(&shared->word);
    /* Other threads that wait on the word check it, and wait again. */
    if (word) syscall(SYS_futex, word, FUTEX_WAKE, INT32_MAX, NULL, NULL, 0);
}

#endif

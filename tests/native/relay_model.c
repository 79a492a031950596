/* Runs all interleavings of the parties of relay.h: its thread, an event loop, and the one that rings.
 *
 * The header itself is compiled here. Each of its accesses to shared memory and each of its system calls
 * is replaced by one that first lets another party continue. From each state, every party is tried next. A state
 * is identified by what each party has seen and by the shared data, so that each is explored once. The doorbell
 * is that of a ring: first of one that other processes may use, then of a private one. Memory is assumed to be
 * sequentially consistent, and a futex may also wake without a reason, as after a signal.
 * Exit status 0: no ring of the doorbell was lost, and a stopped thread ends. */
#include <errno.h>
#include <linux/futex.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <ucontext.h>
#include <unistd.h>

static void turn(void);          /* lets another party continue */
static uint64_t saw(uint64_t value); /* records what a party has read, which decides what it does next */
static long model_syscall(long number, const volatile void *word, int operation, uint32_t value, ...);
static ssize_t model_read(int descriptor, void *data, size_t size);
static ssize_t model_write(int descriptor, const void *data, size_t size);

#undef atomic_load
#undef atomic_store
#undef atomic_exchange
#undef atomic_compare_exchange_strong
#undef atomic_compare_exchange_weak
#undef atomic_load_explicit
#undef atomic_store_explicit
#undef atomic_fetch_add_explicit
#define MODEL(access) __extension__({ turn(); __auto_type result_ = (access); saw((uint64_t)(uintptr_t)result_); result_; })
#define atomic_load(at) MODEL(__extension__({ __auto_type at_ = (at); __typeof__((void)0, *at_) v_; __atomic_load(at_, &v_, 5); v_; }))
#define atomic_load_explicit(at, order) atomic_load(at)
#define atomic_store(at, value) \
    __extension__({ turn(); __auto_type at_ = (at); __typeof__((void)0, *at_) v_ = (value); __atomic_store(at_, &v_, 5); })
#define atomic_store_explicit(at, value, order) atomic_store(at, value)
#define atomic_exchange(at, value) MODEL(__atomic_exchange_n((uint32_t *)(at), value, 5))
#define atomic_compare_exchange_strong(at, expected, value) \
    MODEL(__extension__({ bool done_ = __atomic_compare_exchange_n((uint32_t *)(at), expected, value, false, 5, 5); \
        saw(*(expected)); done_; }))
#define atomic_compare_exchange_weak atomic_compare_exchange_strong
#define atomic_fetch_add_explicit(at, value, order) MODEL(__atomic_fetch_add((uint32_t *)(at), value, 5))
#define syscall model_syscall
#define read model_read
#define write model_write

static void forget(void);
#include "../../shmio/segment/ring.h"
#undef atomic_load_explicit
/* relay_run begins each turn with this call; nothing that it saw earlier matters from here on. */
#define atomic_load_explicit(at, order) (forget(), atomic_load(at))
#include "../../shmio/segment/relay.h"

#undef read
#undef write

enum { THREAD, LOOP, RINGER, STOPPER, PARTIES, DEEPEST = 400, SPURIOUS = 1, STATES = 1 << 22, DESCRIPTOR = 7 };

static struct {
    ucontext_t context; /* its start */
    jmp_buf at;         /* its next step */
    bool begun;
    uint64_t seen;             /* digest of everything that it has read */
    const volatile void *waits; /* the futex that it waits for; the descriptor, if it is the loop */
    bool done;
} parties[PARTIES];
static jmp_buf chooser;
static ucontext_t nowhere;
static int now;
static char stacks[PARTIES][1 << 16];

/* Data that the parties share. */
static relay shared;
static ring_header header;
static ring_view ring = {.base = (uint8_t *)&header};
static uint32_t frames, looked_at, told;
static bool stopping, stop_called;
static int spurious;
static uint32_t rings;

static uint64_t saw(uint64_t value)
{
    parties[now].seen = (parties[now].seen ^ (value + 0x9e3779b97f4a7c15u)) * 0x100000001b3u + 1;
    parties[now].seen ^= parties[now].seen >> 29;
    return value;
}

static void forget(void) { parties[now].seen = 0; }

static void turn(void)
{
    saw(~0u); /* its position is part of its state */
    if (!_setjmp(parties[now].at)) _longjmp(chooser, 1); /* unlike swapcontext(3), without a system call */
}

static long model_syscall(long number, const volatile void *at, int operation, uint32_t value, ...)
{
    (void)number;
    turn();
    if (operation == FUTEX_WAKE) {
        for (int i = 0; i < PARTIES; i++)
            if (parties[i].waits == at) parties[i].waits = NULL;
        return 0;
    }
    if (*(const volatile uint32_t *)at != value) {
        saw(1);
        errno = EAGAIN;
        return -1;
    }
    saw(2);
    parties[now].waits = at;
    turn();
    saw(3);
    return 0;
}

static ssize_t model_read(int descriptor, void *data, size_t size)
{
    (void)descriptor, (void)data;
    turn();
    saw(told);
    if (!told) return -1;
    told = 0;
    return (ssize_t)size;
}

static ssize_t model_write(int descriptor, const void *data, size_t size)
{
    (void)descriptor, (void)data;
    turn();
    told++;
    return (ssize_t)size;
}

static void run_thread(void) { relay_run(&shared, &header.doorbell, ring_waiters(&ring), DESCRIPTOR, 1); }

/* Handles each wake-up and looks. One more wake-up has no cause, as happens to event loops. */
static void run_loop(void)
{
    for (bool once = !stopping;; once = false) {
        forget(); /* nothing that it saw earlier matters from here on */
        saw(once);
        turn();
        while (!told && !once) {
            parties[now].waits = &told;
            turn();
        }
        relay_heard(&shared, DESCRIPTOR);
        turn();
        looked_at = (uint32_t)saw(frames);
        if (stopping && looked_at == rings) return;
    }
}

static void run_ringer(void)
{
    for (uint32_t i = 0; i < rings; i++) {
        turn();
        frames++;
        ring_wake(&ring);
    }
}

static void run_stopper(void)
{
    relay_stop(&shared);
    stop_called = true;
}

static void run(unsigned low, unsigned high)
{
    ((void (*)(void))((uintptr_t)low | (uintptr_t)high << 32))();
    parties[now].done = true;
    _longjmp(chooser, 1);
}

static void begin(bool with_stop)
{
    void (*const functions[PARTIES])(void) = {run_thread, run_loop, run_ringer, run_stopper};
    memset(&shared, 0, sizeof shared);
    header.doorbell = header.waiters = frames = looked_at = told = 0;
    stopping = with_stop, rings = with_stop ? 1 : 2, stop_called = false, spurious = 0;
    for (int i = 0; i < PARTIES; i++) {
        parties[i].begun = false, parties[i].seen = 0, parties[i].waits = NULL, parties[i].done = i == STOPPER && !with_stop;
        getcontext(&parties[i].context);
        parties[i].context.uc_stack.ss_sp = stacks[i];
        parties[i].context.uc_stack.ss_size = sizeof stacks[i];
        uintptr_t function = (uintptr_t)functions[i];
        makecontext(&parties[i].context, (void (*)(void))run, 2, (unsigned)function, (unsigned)(function >> 32));
    }
}

/* A choice is a party that continues, or PARTIES: the thread wakes without a reason. */
static bool possible(int choice)
{
    if (choice == PARTIES) return parties[THREAD].waits && !parties[THREAD].done && spurious < SPURIOUS && !stopping;
    return !parties[choice].done && (!parties[choice].waits || (choice == LOOP && told));
}

static void go_on(int choice)
{
    if (choice == PARTIES) {
        spurious++;
        choice = THREAD;
    }
    now = choice;
    parties[now].waits = NULL;
    if (_setjmp(chooser)) return;
    if (parties[now].begun) _longjmp(parties[now].at, 1);
    parties[now].begun = true;
    swapcontext(&nowhere, &parties[now].context);
}

static uint64_t digest(void)
{
    uint64_t all[3 * PARTIES + 7], hash = 14695981039346656037u;
    int count = 0;
    for (int i = 0; i < PARTIES; i++) {
        all[count++] = parties[i].seen;
        all[count++] = (uintptr_t)parties[i].waits;
        all[count++] = parties[i].done;
    }
    all[count++] = shared.state;
    all[count++] = header.doorbell;
    all[count++] = header.waiters;
    all[count++] = (uint64_t)frames << 32 | looked_at;
    all[count++] = (uint64_t)told << 32 | (unsigned)spurious;
    all[count++] = stop_called;
    all[count++] = shared.word != NULL;
    for (int i = 0; i < count; i++) {
        hash = (hash ^ all[i]) * 0x100000001b3u;
        hash ^= hash >> 31;
    }
    return hash ? hash : 1;
}

static uint64_t known[STATES];
static uint32_t states;
static unsigned char path[DEEPEST];

static bool is_new(uint64_t hash)
{
    uint64_t at = hash % STATES;
    while (known[at] && known[at] != hash) at = (at + 1) % STATES;
    if (known[at]) return false;
    known[at] = hash;
    if (++states > STATES / 2) {
        fprintf(stderr, "too many states: enlarge STATES\n");
        exit(2);
    }
    return true;
}

static int broken(const char *what, int depth)
{
    fprintf(stderr, "%s; thread 0, loop 1, ringer 2, stopper 3, woken 4:", what);
    for (int i = 0; i < depth; i++) fprintf(stderr, " %d", path[i]);
    fprintf(stderr, "\n");
    return 1;
}

/* No party can continue: check whether that is right. */
static const char *wrong_end(void)
{
    if (!stopping) return looked_at == rings ? NULL : "a ring was lost";
    if (parties[THREAD].done) return NULL;
    /* The thread was just about to wait for its turn_ns: whoever waits for its end stops it again. */
    if (parties[THREAD].waits == &header.doorbell)
        return shared.state == RELAY_STOPPED ? NULL : "a stopped thread keeps running";
    return "a stopped thread waits for the loop";
}

static void replay(int depth)
{
    begin(stopping);
    for (int i = 0; i < depth; i++) go_on(path[i]);
}

static int explore(int depth)
{
    bool any = false;
    for (int choice = 0; choice < PARTIES; choice++) any = any || possible(choice);
    const char *wrong = any ? NULL : wrong_end();
    if (depth == DEEPEST) wrong = "no end";
    if (wrong) return broken(wrong, depth);
    for (int choice = 0; choice <= PARTIES; choice++) {
        if (choice) replay(depth);
        if (!possible(choice)) continue;
        path[depth] = (unsigned char)choice;
        go_on(choice);
        if (is_new(digest()) && explore(depth + 1)) return 1;
    }
    return 0;
}

int main(void)
{
    for (int mode = 0; mode < 4; mode++) {
        bool with_stop = mode & 1;
        ring.private = mode & 2;
        states = 0;
        memset(known, 0, sizeof known);
        begin(with_stop);
        is_new(digest());
        if (explore(0)) return 1;
        printf("%s, %s: %u states\n", ring.private ? "private" : "shared", with_stop ? "stopped" : "to the end", states);
    }
    return 0;
}

/* Times the way from ring_publish to waiting processes that copy the frame, compared with one
 * eventfd for each process.
 *
 * wakeup READERS ROUNDS prints a line "name call_ns last_ns" for each round: the duration of the
 * writer's call, and the time from its beginning until the last reader has finished.
 */
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>

#include "ring.h"

#define FRAME_SIZE 2180u
#define MAX_READERS 256
#define SLOTS 8u
#define WARM_UP 3 /* rounds that are not measured */

enum { RING, EVENTFD, WAYS };
static const char *const names[WAYS] = {"ring,frame", "eventfd"};

static ring_view ring;
static uint8_t raw[FRAME_SIZE];
static _Atomic int64_t *arrivals;
static int events[MAX_READERS];

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

static void rest(long duration_us)
{
    struct timespec duration = {0, duration_us * 1000};
    nanosleep(&duration, NULL);
}

static void wait_ring(uint64_t *last)
{
    slot_info info;
    uint8_t reason[REASON_SIZE], out[FRAME_SIZE], effective[FRAME_SIZE];
    for (;;) {
        uint32_t seen = atomic_load_explicit(&ring_head(&ring)->doorbell, memory_order_acquire);
        if (atomic_load_explicit(&ring_head(&ring)->head, memory_order_acquire) > *last) break;
        doorbell_wait(&ring_head(&ring)->doorbell, seen, -1);
    }
    if (!ring_read(&ring, ++*last, &info, reason, out, effective) || memcmp(out, raw, FRAME_SIZE) != 0) _exit(1);
}

static void follow(int way, int reader, int rounds)
{
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    uint64_t last = atomic_load(&ring_head(&ring)->head), value;
    atomic_store(&arrivals[reader], 1); /* ready */
    for (int round = 0; round < rounds + WARM_UP; round++) {
        if (way == RING)
            wait_ring(&last);
        else if (read(events[reader], &value, sizeof value) != sizeof value)
            _exit(1);
        atomic_store(&arrivals[reader], now_ns());
    }
    _exit(0);
}

static void call(int way, int readers)
{
    static const slot_info info;
    static const uint8_t reason[REASON_SIZE];
    uint64_t one = 1;
    if (way == RING)
        ring_publish(&ring, info, reason, raw, NULL);
    else
        for (int reader = 0; reader < readers; reader++)
            if (write(events[reader], &one, sizeof one) != sizeof one) abort();
}

/* Returns when the last reader had finished. The wait for a dead reader has a time-out. */
static int64_t last_arrival(int readers, long rest_us)
{
    for (int attempt = 0; attempt < 10000; attempt++) {
        int64_t last = 0;
        int back = 0;
        for (int reader = 0; reader < readers; reader++) {
            int64_t arrived = atomic_load(&arrivals[reader]);
            back += arrived != 0;
            if (arrived > last) last = arrived;
        }
        if (back == readers) return last;
        rest(rest_us);
    }
    fputs("a reader does not come back\n", stderr);
    exit(1);
}

static void measure(int way, int readers, int rounds)
{
    long rest_us = readers < 10 ? 2000 : 10000;
    for (int reader = 0; reader < readers; reader++) {
        atomic_store(&arrivals[reader], 0);
        fflush(stdout);
        pid_t pid = fork();
        if (pid < 0) exit(1);
        if (pid == 0) follow(way, reader, rounds);
    }
    last_arrival(readers, rest_us);
    for (int round = 0; round < rounds + WARM_UP; round++) {
        for (int reader = 0; reader < readers; reader++) atomic_store(&arrivals[reader], 0);
        rest(rest_us);
        int64_t begun_ns = now_ns();
        call(way, readers);
        int64_t called_ns = now_ns();
        rest(rest_us);
        int64_t last_ns = last_arrival(readers, rest_us);
        if (round >= WARM_UP)
            printf("%s %lld %lld\n", names[way], (long long)(called_ns - begun_ns), (long long)(last_ns - begun_ns));
    }
    for (int reader = 0; reader < readers; reader++) wait(NULL);
}

int main(int count, char **arguments)
{
    if (count != 3) return 2;
    int readers = atoi(arguments[1]), rounds = atoi(arguments[2]);
    if (readers < 1 || readers > MAX_READERS || rounds < 5) return 2;

    uint32_t stride = (RAW_OFFSET + (uint32_t)align8(FRAME_SIZE) + 63u) & ~63u;
    size_t size = RING_HEADER_SIZE + (size_t)stride * SLOTS;
    uint8_t *memory = mmap(NULL, size + sizeof(int64_t) * MAX_READERS, PROT_READ | PROT_WRITE,
                           MAP_SHARED | MAP_ANONYMOUS | MAP_POPULATE, -1, 0);
    if (memory == MAP_FAILED) return 1;
    arrivals = (_Atomic int64_t *)(void *)(memory + size);
    ring_header header = {.slot_count = SLOTS, .slot_stride = stride, .frame_size = FRAME_SIZE, .raw_offset = RAW_OFFSET};
    memcpy(memory, &header, offsetof(ring_header, head));
    const char *wrong = ring_open(&ring, memory, size);
    if (wrong) {
        fprintf(stderr, "%s\n", wrong);
        return 1;
    }
    memset(raw, 0x5A, sizeof raw);
    for (int reader = 0; reader < readers; reader++)
        if ((events[reader] = eventfd(0, 0)) < 0) return 1;
    for (int turn = 0; turn < 5; turn++)
        for (int way = 0; way < WAYS; way++) measure((way + turn) % WAYS, readers, rounds / 5);
    return 0;
}

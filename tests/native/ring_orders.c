/* Checks the memory orders in ring.h by trying every value that C11 lets a reader load while a writer works.
 *
 * The header itself is compiled here. Each atomic access is replaced by one to a memory of messages: a
 * location keeps all values that it ever had, each with the view that a reader gains by reading it with
 * acquire. A load may return any value that is not older than those the reader has seen. This is C11 as
 * corrected by RC11 (Lahav et al., PLDI 2017), without seq_cst. So this model leaves out the waiters of a
 * private ring, which need it. On x86 most of it never happens, so no test on such a machine finds an order
 * that is too weak. The writer reads nothing that the reader writes; therefore the writer runs first, and
 * only the reader's choices are explored. Exit status 0: all results are right. */
#include <setjmp.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static uint64_t model_load(const volatile void *at, memory_order order);
static void model_store(volatile void *at, uint64_t value, memory_order order);
static uint64_t model_add(volatile void *at, uint64_t value, memory_order order);
static void model_fence(memory_order order);

#undef atomic_load_explicit
#undef atomic_store_explicit
#undef atomic_fetch_add_explicit
#undef atomic_thread_fence
#define atomic_load_explicit(at, order) (__typeof__((void)0, *(at)))model_load(at, order)
#define atomic_store_explicit(at, value, order) model_store(at, value, order)
#define atomic_fetch_add_explicit(at, value, order) model_add(at, value, order)
#define atomic_thread_fence(order) model_fence(order)

#include "../../shmio/segment/ring.h"

enum { LOCATIONS = 64, MESSAGES = 16, DEEPEST = 64, FRAMES = 2, SLOTS = 1, SIZE = 8 };
#define WHOLE(frame) (2 * (uint64_t)(frame) + 2)

typedef struct {
    uint8_t of[LOCATIONS];
} view; /* the oldest message of each location that may still be read */

typedef struct {
    uint64_t value;
    view view;
} message;

typedef struct {
    view now, acquired, released; /* in effect; added by an acquire fence; passed on by the last release fence */
} party;

static const volatile void *places[LOCATIONS];
static message messages[LOCATIONS][MESSAGES];
static int counts[LOCATIONS], locations;
static party writer, reader, *self;

static unsigned char choices[DEEPEST], limits[DEEPEST]; /* for each load of this run: message chosen, of how many */
static int depth;
static jmp_buf over;
static uint64_t first_loaded;
static bool loaded;
static unsigned long runs;

static int location(const volatile void *at)
{
    for (int i = 0; i < locations; i++)
        if (places[i] == at) return i;
    if (locations == LOCATIONS) abort();
    places[locations] = at;
    counts[locations] = 1; /* the initial zero */
    return locations++;
}

static void join(view *into, const view *from)
{
    for (int i = 0; i < LOCATIONS; i++)
        if (from->of[i] > into->of[i]) into->of[i] = from->of[i];
}

static void model_store(volatile void *at, uint64_t value, memory_order order)
{
    int where = location(at), number = counts[where]++;
    if (number == MESSAGES) abort();
    self->now.of[where] = (uint8_t)number;
    message *new = &messages[where][number];
    new->value = value;
    new->view = order == memory_order_relaxed ? self->released : self->now;
    new->view.of[where] = (uint8_t)number;
}

static uint64_t model_add(volatile void *at, uint64_t value, memory_order order)
{
    int where = location(at);
    message before = messages[where][counts[where] - 1];
    model_store(at, before.value + value, order);
    join(&messages[where][counts[where] - 1].view, &before.view); /* a release sequence continues */
    return before.value;
}

static uint64_t model_load(const volatile void *at, memory_order order)
{
    int where = location(at), oldest = self->now.of[where], number = counts[where] - 1;
    if (self == &reader && number > oldest) {
        if (depth == DEEPEST) longjmp(over, 1); /* a retry of the reader adds nothing new */
        limits[depth] = (unsigned char)(number - oldest + 1);
        number = oldest + choices[depth++];
    }
    const message *read = &messages[where][number];
    self->now.of[where] = (uint8_t)number;
    join(&self->acquired, &read->view);
    if (order != memory_order_relaxed) join(&self->now, &read->view);
    if (!loaded) first_loaded = read->value, loaded = true;
    return read->value;
}

static void model_fence(memory_order order)
{
    if (order != memory_order_release) join(&self->now, &self->acquired);
    if (order != memory_order_acquire) self->released = self->now;
}

/* The data under test. */

static uint8_t memory[RING_HEADER_SIZE + SLOTS * (RAW_OFFSET + SIZE)] __attribute__((aligned(64)));
static uint8_t cell[8 + 16] __attribute__((aligned(64)));
static ring_view ring = {memory, SLOTS, RAW_OFFSET + SIZE, SIZE, 0, false};

static void check(bool right, const char *what)
{
    if (right) return;
    fprintf(stderr, "%s; message chosen by each load, of how many:", what);
    for (int i = 0; i < depth; i++) fprintf(stderr, " %d/%d", choices[i], limits[i]);
    fprintf(stderr, "\n");
    exit(1);
}

static void read_a_frame(void)
{
    uint32_t rung = atomic_load_explicit(&ring_head(&ring)->doorbell, memory_order_acquire);
    uint64_t head = atomic_load_explicit(&ring_head(&ring)->head, memory_order_acquire);
    check(head >= rung, "the bell has rung, but its frame is not there");
    for (uint64_t frame = 1; frame <= FRAMES; frame++) {
        slot_info info;
        uint8_t reason[REASON_SIZE];
        uint64_t raw;
        party before = reader;
        loaded = false;
        bool there = ring_read(&ring, frame, &info, reason, (uint8_t *)&raw, NULL);
        check(frame > head || first_loaded >= WHOLE(frame), "head has advanced, but its frame is not there");
        if (there) check(info.cycle == frame && info.publish_ns == -(int64_t)frame && raw == 3 * frame, "a frame is mixed");
        reader = before;
    }
}

static void read_a_cell(void)
{
    uint64_t words[2];
    if (cell_read(cell, (uint8_t *)words, sizeof words)) check(words[0] == words[1], "a cell is mixed");
}

static void try_all(void (*work)(void))
{
    memset(choices, 0, sizeof choices);
    for (;;) {
        memset(&reader, 0, sizeof reader);
        depth = 0;
        runs++;
        if (!setjmp(over)) work();
        do depth--;
        while (depth >= 0 && choices[depth] + 1 == limits[depth]);
        if (depth < 0) return;
        choices[depth]++;
        memset(choices + depth + 1, 0, sizeof choices - (size_t)depth - 1);
    }
}

int main(void)
{
    self = &writer;
    for (uint64_t frame = 1; frame <= FRAMES; frame++) {
        slot_info info = {.cycle = frame, .publish_ns = -(int64_t)frame};
        uint64_t raw = 3 * frame, words[2] = {frame, frame};
        ring_publish(&ring, info, NULL, (const uint8_t *)&raw, NULL);
        cell_write(cell, (const uint8_t *)words, sizeof words);
    }
    self = &reader;
    try_all(read_a_frame);
    try_all(read_a_cell);
    printf("%lu ways to read\n", runs);
    return 0;
}

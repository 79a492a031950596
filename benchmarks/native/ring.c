/* Times the ring's C core against memcpy: one frame of FRAME_SIZE bytes, in and out of shared memory.
 *
 * ring SLOTS ROUNDS CALLS prints a line "name ns" for each contender and round.
 */
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>

#include "ring.h"

#define FRAME_SIZE 2180u

static ring_view ring;
static slot_info info;
static uint8_t *plain;
static uint8_t raw[FRAME_SIZE], out[FRAME_SIZE], effective[FRAME_SIZE], reason[REASON_SIZE];

/* Tells the compiler that memory is read here, so that it does not remove a copy as useless. */
static void keep(const void *memory) { __asm__ volatile("" : : "r"(memory) : "memory"); }

static void publish(void) { ring_publish(&ring, info, reason, raw, NULL); }

static void latest(void)
{
    ring_latest(&ring, &info, reason, out, effective);
    keep(out);
}

static void bell(void) { doorbell_ring(&ring_head(&ring)->doorbell); }

static void copy_in(void)
{
    memcpy(plain, raw, FRAME_SIZE);
    keep(plain);
}

static void copy_out(void)
{
    memcpy(out, plain, FRAME_SIZE);
    keep(out);
}

static const struct {
    const char *name;
    void (*call)(void);
} contenders[] = {{"publish", publish}, {"bell", bell}, {"copy_in", copy_in}, {"latest", latest}, {"copy_out", copy_out}};

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

int main(int count, char **arguments)
{
    if (count != 4) return 2;
    uint32_t slots = (uint32_t)atoi(arguments[1]);
    int rounds = atoi(arguments[2]), calls = atoi(arguments[3]);

    uint32_t effective_at = RAW_OFFSET + (uint32_t)align8(FRAME_SIZE);
    uint32_t stride = (effective_at + (uint32_t)align8(FRAME_SIZE) + 63u) & ~63u;
    size_t size = RING_HEADER_SIZE + (size_t)stride * slots;
    uint8_t *memory = mmap(NULL, size + FRAME_SIZE, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS | MAP_POPULATE, -1, 0);
    if (memory == MAP_FAILED) {
        perror("mmap");
        return 1;
    }
    plain = memory + size;
    ring_header header = {.slot_count = slots,
                          .slot_stride = stride,
                          .frame_size = FRAME_SIZE,
                          .raw_offset = RAW_OFFSET,
                          .effective_offset = effective_at};
    memcpy(memory, &header, offsetof(ring_header, head));
    const char *wrong = ring_open(&ring, memory, size);
    if (wrong) {
        fprintf(stderr, "%s\n", wrong);
        return 1;
    }
    memset(raw, 0x5A, sizeof raw);
    publish();
    latest();
    if (memcmp(raw, out, FRAME_SIZE) != 0) {
        fputs("a frame came back changed\n", stderr);
        return 1;
    }
    for (int round = 0; round < rounds; round++)
        for (size_t i = 0; i < sizeof contenders / sizeof *contenders; i++) {
            int64_t begun_ns = now_ns();
            for (int call = 0; call < calls; call++) contenders[i].call();
            printf("%s %.2f\n", contenders[i].name, (double)(now_ns() - begun_ns) / calls);
        }
    return 0;
}

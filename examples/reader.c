/* Follows one register of a running instance: prints every frame once, and counts lost frames exactly.
 *
 * Written from docs/reference/segment-format.md alone; uses no code of shmio.
 *     cc -std=c11 -o reader examples/reader.c
 *     ./reader a50 cell/Robot_800/Axs1_Pos [FRAMES]
 */
#define _DEFAULT_SOURCE
#include <fcntl.h>
#include <inttypes.h>
#include <linux/futex.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>
#include "clock.h"

enum { ABI = 2, LAYOUT = 1, FRAMES = 2, RETIRED = 1, ENTRY = 128, RING_HEADER = 128, RAW = 320, LOOK_NS = 200000000 };

static const uint8_t *base; /* the mapping, read-only */
static uint64_t size;
static char object[256];
static ino_t inode;

static _Noreturn void fail(const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vfprintf(stderr, format, arguments);
    fputc('\n', stderr);
    exit(1);
}

/* Read shared words by single atomic accesses. The caller has checked that they are within the
 * mapping and aligned. */
#define WORD(type, at, order) atomic_load_explicit((const _Atomic type *)(const void *)(base + (at)), order)
static uint32_t get32(uint64_t at) { return WORD(uint32_t, at, memory_order_acquire); }
static uint64_t get64(uint64_t at) { return WORD(uint64_t, at, memory_order_acquire); }
static uint64_t relaxed64(uint64_t at) { return WORD(uint64_t, at, memory_order_relaxed); }
static bool within(uint64_t at, uint64_t length) { return at <= size && length <= size - at; }

typedef struct { /* a ring: place of its header, and a checked copy of its geometry */
    uint64_t at, entry, clock; /* entry: in the section table; clock: place of the page; 0: real time */
    uint32_t slots, stride, frame_size, effective;
    int64_t stale_ns;
} Ring;

typedef struct {
    char type[16];
    uint64_t offset;
    unsigned bit, size;
    bool big;
} Register;

typedef struct {
    uint64_t number, cycle;
    int64_t asked_ns; /* lower bound of the image's time */
    unsigned quality;
    char reason[257];
    uint8_t value[8];
} Frame;

/* Everyone can create a file in /dev/shm: trust those of root, of this user, and of a group that both have. */
static bool trusted(const struct stat *status)
{
    gid_t groups[256];
    int count = getgroups(sizeof groups / sizeof *groups, groups);
    bool member = status->st_gid == getegid();
    if (status->st_uid == 0 || status->st_uid == geteuid()) return true;
    for (int i = 0; i < count; i++) member |= groups[i] == status->st_gid;
    return member && status->st_gid != 0 && (status->st_mode & 0040) && !(status->st_mode & 0022);
}

static void map(const char *instance)
{
    struct stat status;
    snprintf(object, sizeof object, "/dev/shm/shmio-%s", instance);
    int fd = open(object, O_RDONLY | O_CLOEXEC | O_NOFOLLOW);
    if (fd < 0 || fstat(fd, &status) != 0) fail("no instance %s, or no permission to read it", instance);
    if (!trusted(&status)) fail("%s belongs to user %u, whom this user does not trust", object, (unsigned)status.st_uid);
    size = (uint64_t)status.st_size, inode = status.st_ino;
    void *memory = size < 4096 ? NULL : mmap(NULL, size, PROT_READ, MAP_SHARED, fd, 0);
    close(fd);
    if (memory == MAP_FAILED) fail("cannot map %s", object);
    base = memory;
    uint64_t magic = base ? get64(0) : 0; /* acquire: the magic is written last */
    if (magic == 0) fail("instance %s is starting, or died during its start", instance);
    if (memcmp(&magic, "SHMIOSEG", 8) != 0) fail("%s is no segment of shmio", object);
    if (get32(8) != ABI || get32(12) != 4096) fail("%s has ABI %u, this program knows %d", object, get32(8), ABI);
}

/* Searches in the layout's JSON, which has no blanks between tokens; enough for plain paths. */
static bool find_register(const char *json, const char *path, Register *found)
{
    char key[512];
    snprintf(key, sizeof key, "{\"path\":\"%s\",\"type\":\"", path);
    const char *at = strstr(json, key), *dims, *offset, *bit, *bytes;
    if (!at || !(dims = strstr(at, "\"dims\":")) || !(offset = strstr(at, "\"offset\":")) ||
        !(bit = strstr(at, "\"bit\":")) || !(bytes = strstr(at, "\"size\":")))
        return false;
    if (sscanf(at + strlen(key), "%15[A-Z]", found->type) != 1) return false;
    if (strncmp(dims + 7, "null", 4) != 0) fail("%s is an array: name a register of one value", path);
    found->offset = strtoull(offset + 9, NULL, 10);
    found->bit = (unsigned)strtoul(bit + 6, NULL, 10) & 7; /* null, for all types but BOOL, gives 0 */
    found->size = (unsigned)strtoul(bytes + 7, NULL, 10);
    found->big = strstr(json, "\"byte_order\":\"little\"") == NULL;
    return true;
}

static Ring find(const char *source, const char *path, Register *found)
{
    uint64_t count = get64(48) >> 32, table = get64(56), end = table + ENTRY * count, entry = table; /* acquire */
    if (table % 8 || get32(68) != ENTRY || !within(table, end - table)) fail("the section table is not sound");
    while (entry < end && (get32(entry) != FRAMES || get32(entry + 4) & RETIRED ||
                           strncmp((const char *)base + entry + 32, source, 64) != 0))
        entry += ENTRY;
    if (entry == end) fail("no source %s", source);
    uint64_t at = get64(entry + 8), length = get64(entry + 16), layout = table + ENTRY * (uint64_t)get32(entry + 24);
    if (layout >= end || get32(layout) != LAYOUT || !within(get64(layout + 8), get64(layout + 16)) ||
        at % 64 || !within(at, length) || length < RING_HEADER)
        fail("the sections of source %s are not sound", source);
    uint64_t clock = clock_page(base, size, table, end, get32(entry + 24));
    Ring ring = {at, entry, clock, get32(at), get32(at + 4), get32(at + 8), get32(at + 20), (int64_t)get64(at + 40)};
    uint64_t image = ((uint64_t)ring.frame_size + 7) / 8 * 8;
    if (ring.slots < 4 || (ring.slots & (ring.slots - 1)) || get32(at + 16) != RAW || ring.effective % 8 ||
        ring.stride % 8 || ring.effective < RAW + image || ring.stride < ring.effective + image ||
        (uint64_t)ring.slots * ring.stride > length - RING_HEADER)
        fail("the ring of source %s is not sound", source);
    char *json = strndup((const char *)base + get64(layout + 8), get64(layout + 16));
    if (!json || !find_register(json, path, found)) fail("source %s has no register %s", source, path);
    free(json);
    if (found->size < 1 || found->size > 8 || found->size > ring.frame_size ||
        found->offset > ring.frame_size - found->size)
        fail("%s: a value of type %s cannot be shown", path, found->type);
    return ring;
}

static bool read_frame(const Ring *ring, const Register *of, uint64_t number, Frame *frame)
{
    uint64_t slot = ring->at + RING_HEADER + (uint64_t)ring->stride * (number & (ring->slots - 1));
    if (get64(slot) != 2 * number + 2) return false; /* acquire: the reads below come after it */
    uint64_t words[40], pair[2]; /* the slot's header and reason; a value spans at most two words */
    for (unsigned i = 1; i < 40; i++) words[i] = relaxed64(slot + 8 * i);
    uint64_t first = slot + (words[5] >> 48 & 1 ? ring->effective : RAW) + of->offset / 8 * 8;
    pair[0] = relaxed64(first);
    pair[1] = of->offset % 8 + of->size > 8 ? relaxed64(first + 8) : 0;
    atomic_thread_fence(memory_order_acquire);
    if (relaxed64(slot) != 2 * number + 2) return false; /* overwritten meanwhile */
    *frame = (Frame){number, words[1], (int64_t)(words[2] - (words[6] >> 32) * 1000), words[5] >> 32 & 0xFF, "", {0}};
    memcpy(frame->reason, &words[8], (words[6] & 0xFFFF) > 256 ? 256 : words[6] & 0xFFFF);
    for (char *c = frame->reason; *c; c++) *c = (unsigned char)*c < 32 || *c == 127 ? '?' : *c;
    memcpy(frame->value, (const uint8_t *)pair + of->offset % 8, of->size);
    return true;
}

static bool stale(const Frame *frame, const Ring *ring)
{
    int64_t age = present_ns(base, ring->clock) - frame->asked_ns;
    return age > ring->stale_ns || (age < 0 && !ring->clock); /* real time: no frame comes from the future */
}

static void show(const Frame *frame, const Register *of, uint64_t missed, bool is_stale)
{
    uint64_t value = 0;
    for (unsigned i = 0; i < of->size; i++) value = value << 8 | frame->value[of->big ? i : of->size - 1 - i];
    union { uint32_t half; uint64_t whole; float real; double lreal; } bits = {.whole = value}; /* half: the low half */
    const char *quality = is_stale ? "bad" : frame->quality == 2 ? "good" : frame->quality == 1 ? "uncertain" : "bad";
    printf("%" PRIu64 " cycle %" PRIu64 " missed %" PRIu64 " %s ", frame->number, frame->cycle, missed, quality);
    if (strcmp(of->type, "REAL") == 0) printf("%.9g", (double)bits.real);
    else if (strcmp(of->type, "LREAL") == 0) printf("%.17g", bits.lreal);
    else if (strcmp(of->type, "BOOL") == 0) printf("%s", value >> of->bit & 1 ? "true" : "false");
    else if (strstr("SINT DINT LINT", of->type)) /* also INT, but no unsigned type */
        printf("%" PRId64, (int64_t)(value << (64 - 8 * of->size)) >> (64 - 8 * of->size));
    else printf("%" PRIu64, value);
    printf(" %s\n", is_stale ? "stale" : frame->reason);
    if (fflush(stdout) != 0) exit(0); /* the reader of the output has gone */
}

int main(int count, char **arguments)
{
    char *path = count < 3 ? NULL : strchr(arguments[2], '/');
    if (!path) fail("usage: reader INSTANCE SOURCE/REGISTER [FRAMES]");
    map(arguments[1]);
    *path++ = 0;
    Frame frame;
    Register of;
    Ring ring = find(arguments[2], path, &of);
    uint64_t left = count > 3 ? strtoull(arguments[3], NULL, 10) : UINT64_MAX, missed = 0, last = get64(ring.at + 64);
    for (bool told = true; left > 0;) {
        uint32_t bell = get32(ring.at + 72); /* before reading head, so that no wake-up is lost */
        for (uint64_t head; left > 0 && (head = get64(ring.at + 64)) > last;) {
            if (read_frame(&ring, &of, last + 1, &frame)) {
                show(&frame, &of, missed, told = stale(&frame, &ring));
                last++, left--;
            } else { /* overtaken; skip a few more frames, because the oldest are overwritten next */
                uint64_t next = head > last + ring.slots ? head - ring.slots / 4 * 3 : last + 1;
                missed += next - last, last = next;
            }
        }
        struct stat status; /* a stopped instance wakes nobody, but its shared memory has been unlinked */
        if (stat(object, &status) != 0 || status.st_ino != inode) fail("%s has stopped", arguments[1]);
        if (get32(ring.entry + 4) & RETIRED) fail("source %s was changed by a reload: start anew", arguments[2]);
        if (!told && stale(&frame, &ring)) show(&frame, &of, missed, told = true);
        const struct timespec look = {0, left > 0 ? LOOK_NS : 0};
        syscall(SYS_futex, base + ring.at + 72, FUTEX_WAIT, bell, &look, NULL, 0);
    }
}

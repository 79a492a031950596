/* Shifts CLOCK_REALTIME for a family of processes, as if somebody had set the host's clock.
 *
 * Loaded by LD_PRELOAD. The offset in ns is an int64 in the file that SHMIO_FAULTS_CLOCK names. The file
 * is mapped, so that the offset can change at any moment. CLOCK_MONOTONIC is never changed, as setting a
 * host's clock does not change it. Of the waits for a time of the clock only the futex's is converted to
 * the kernel's clock (gRPC uses it; Python waits by CLOCK_MONOTONIC). Unlike in the kernel, a change of
 * the offset has no effect on waits that have begun.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <linux/futex.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define SECOND INT64_C(1000000000)

static const volatile int64_t zero, *offset = &zero;

__attribute__((constructor)) static void find_offset(void)
{
    const char *file = getenv("SHMIO_FAULTS_CLOCK");
    int fd = file ? open(file, O_RDONLY | O_CLOEXEC) : -1;
    void *memory = fd < 0 ? MAP_FAILED : mmap(NULL, sizeof *offset, PROT_READ, MAP_SHARED, fd, 0);
    if (memory != MAP_FAILED) offset = memory;
    if (fd >= 0) close(fd);
}

static void shift(struct timespec *when, int64_t by)
{
    int64_t ns = when->tv_sec * SECOND + when->tv_nsec + by;
    if (ns < 0) ns = 0;
    *when = (struct timespec){ns / SECOND, ns % SECOND};
}

int clock_gettime(clockid_t clock, struct timespec *now)
{
    static int (*next)(clockid_t, struct timespec *);
    if (!next) next = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int status = next(clock, now);
    if (status == 0 && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) shift(now, *offset);
    return status;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone)
{
    (void)zone;
    struct timespec precise;
    clock_gettime(CLOCK_REALTIME, &precise);
    *now = (struct timeval){precise.tv_sec, precise.tv_nsec / 1000};
    return 0;
}

time_t time(time_t *into)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (into) *into = now.tv_sec;
    return now.tv_sec;
}

long syscall(long number, ...)
{
    static long (*next)(long, ...);
    if (!next) next = (long (*)(long, ...))dlsym(RTLD_NEXT, "syscall");
    long a[6];
    va_list arguments;
    va_start(arguments, number);
    for (int i = 0; i < 6; i++) a[i] = va_arg(arguments, long);
    va_end(arguments);
    struct timespec copy;
    if (number == SYS_futex && a[1] & FUTEX_CLOCK_REALTIME && a[3]) {
        copy = *(const struct timespec *)a[3];
        shift(&copy, -*offset);
        a[3] = (long)&copy;
    }
    return next(number, a[0], a[1], a[2], a[3], a[4], a[5]);
}

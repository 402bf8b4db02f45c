/* Library to preload: from a chosen call on, writes or locks fail with an error number, or the clock jumps.

   A process calls `disturb` to choose; the counter of calls may be in shared memory. The file of the standard output never fails. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>
#include <stdio.h>

enum { WRITES = 1, LOCKS, CLOCK };
static int here, *counter = &here, chosen, first, number, forever;

void disturb(int what, int from, int error, int always, int *shared)
{
    chosen = what, first = from, number = error, forever = always;
    if (shared)
        counter = shared;
}

static int fails(int what)
{
    if (chosen != what)
        return 0;
    int n = __sync_add_and_fetch(counter, 1);
    if (!first || (forever ? n < first : n != first))
        return 0;
    errno = number;
    return 1;
}

static int is_file(int handle)
{
    struct stat found, told;
    return !fstat(handle, &found) && S_ISREG(found.st_mode) && !(!fstat(1, &told) && told.st_ino == found.st_ino);
}

#define WITH(test, type, name, declared, ...)                 \
    type name declared                                        \
    {                                                         \
        static type(*real) declared;                          \
        if (!real)                                            \
            real = (type(*) declared)dlsym(RTLD_NEXT, #name); \
        return (test) ? -1 : real(__VA_ARGS__);               \
    }

WITH(is_file(f) && fails(WRITES), ssize_t, write, (int f, const void *b, size_t n), f, b, n)
WITH(is_file(f) && fails(WRITES), ssize_t, writev, (int f, const struct iovec *v, int n), f, v, n)
WITH(is_file(f) && fails(WRITES), ssize_t, pwrite, (int f, const void *b, size_t n, off_t at), f, b, n, at)
WITH(is_file(f) && fails(WRITES), ssize_t, pwrite64, (int f, const void *b, size_t n, off64_t at), f, b, n, at)
WITH(is_file(f) && fails(WRITES), int, ftruncate, (int f, off_t n), f, n)
WITH(is_file(f) && fails(WRITES), int, ftruncate64, (int f, off64_t n), f, n)
WITH(fails(WRITES), int, fsync, (int f), f)
WITH(fails(WRITES), int, fdatasync, (int f), f)
WITH(fails(WRITES), int, rename, (const char *a, const char *b), a, b)
WITH(fails(WRITES), int, renameat, (int d, const char *a, int e, const char *b), d, a, e, b)
WITH(fails(WRITES), int, link, (const char *a, const char *b), a, b)
WITH(fails(WRITES), int, symlink, (const char *a, const char *b), a, b)
WITH(fails(WRITES), int, mkdir, (const char *a, mode_t m), a, m)
WITH(fails(WRITES), int, unlink, (const char *a), a)
WITH(fails(WRITES), int, unlinkat, (int d, const char *a, int m), d, a, m)
WITH(fails(WRITES), int, rmdir, (const char *a), a)
WITH(fails(LOCKS), int, flock, (int f, int how), f, how)

#define OPENS(name, declared, ...)                                                    \
    int name(declared, int how, ...)                                                  \
    {                                                                                 \
        static int (*real)(declared, int, mode_t);                                    \
        va_list more;                                                                 \
        va_start(more, how);                                                          \
        mode_t mode = how & (O_CREAT | O_TMPFILE) ? va_arg(more, mode_t) : 0;         \
        va_end(more);                                                                 \
        if (!real)                                                                    \
            real = (int (*)(declared, int, mode_t))dlsym(RTLD_NEXT, #name);           \
        return how & (O_CREAT | O_TRUNC) && fails(WRITES) ? -1 : real(__VA_ARGS__, how, mode); \
    }
#define PATH const char *path
#define BESIDE int folder, const char *path
OPENS(open, PATH, path)
OPENS(open64, PATH, path)
OPENS(openat, BESIDE, folder, path)
OPENS(openat64, BESIDE, folder, path)

static int lock(const char *name, int f, int what, void *more)
{
    int (*real)(int, int, ...) = (int (*)(int, int, ...))dlsym(RTLD_NEXT, name);
    int locks = what == F_SETLK || what == F_SETLKW || what == F_OFD_SETLK || what == F_OFD_SETLKW;
    return locks && fails(LOCKS) ? -1 : real(f, what, more);
}

#define FCNTL(name)                       \
    int name(int f, int what, ...)        \
    {                                     \
        va_list more;                     \
        va_start(more, what);             \
        void *p = va_arg(more, void *);   \
        va_end(more);                     \
        return lock(#name, f, what, p);   \
    }
FCNTL(fcntl)
FCNTL(fcntl64)

/* Seconds by which the clock is wrong now: years back and ahead, in turn for twenty calls each. */
static time_t jump(void)
{
    return chosen != CLOCK ? 0 : (__sync_add_and_fetch(counter, 1) / 20 % 2 ? -1 : 1) * 315576000;
}

int clock_gettime(clockid_t which, struct timespec *now)
{
    static int (*real)(clockid_t, struct timespec *);
    if (!real)
        real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int result = real(which, now);
    if (which == CLOCK_REALTIME)
        now->tv_sec += jump();
    return result;
}

time_t time(time_t *where)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (where)
        *where = now.tv_sec;
    return now.tv_sec;
}

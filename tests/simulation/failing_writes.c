/* Preloaded: the n-th operation on a file below a folder fails, as it does on a disk that is full or broken. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

enum { SHORT = 1, FULL_ONCE = 2, FULL = 3, BROKEN = 4 };

static char folder[4096];
static long at, seen;
static int how;

/* Begin to count; n = 0 only counts. Returns how many operations there were since the last call. */
long failing_writes_arm(const char *below, long n, int mode) {
    long before = seen;
    strncpy(folder, below, sizeof folder - 1);
    at = n;
    how = mode;
    seen = 0;
    return before;
}

static int here(const char *path) { return folder[0] && path && !strncmp(path, folder, strlen(folder)); }

static int here_fd(int fd) {
    char link[64], path[4096];
    ssize_t n;
    if (!folder[0]) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return here(path);
}

/* Whether this operation fails; `takes` says whether it takes room on the disk. */
static int fails(int takes) {
    int now;
    seen++;
    if (!at || seen < at) return 0;
    now = seen == at;
    if (how == BROKEN && now) { errno = EIO; return 1; }
    /* Once, also for the second half of what was written by halves. */
    if (takes && (how == FULL || (how == FULL_ONCE && seen <= at + 1))) { errno = ENOSPC; return 1; }
    return 0;
}

#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int fd, const void *data, size_t size) {
    if (here_fd(fd)) {
        int first = at && seen + 1 == at;
        if (fails(1)) {
            int error = errno;
            if (first && how != BROKEN && size > 1) return NEXT(write)(fd, data, size / 2); /* the rest fails */
            errno = error;
            return -1;
        }
        if (first && how == SHORT && size > 1) size /= 2;
    }
    return NEXT(write)(fd, data, size);
}

#define PWRITE(name, offset_t)                                                  \
    ssize_t name(int fd, const void *data, size_t size, offset_t offset) {      \
        if (here_fd(fd)) {                                                      \
            if (fails(1)) return -1;                                            \
            if (at && seen == at && how == SHORT && size > 1) size /= 2;        \
        }                                                                       \
        return NEXT(name)(fd, data, size, offset);                              \
    }
PWRITE(pwrite, off_t)
PWRITE(pwrite64, off64_t)

int fsync(int fd) { return here_fd(fd) && fails(0) ? -1 : NEXT(fsync)(fd); }
int ftruncate(int fd, off_t n) { return here_fd(fd) && fails(0) ? -1 : NEXT(ftruncate)(fd, n); }
int ftruncate64(int fd, off64_t n) { return here_fd(fd) && fails(0) ? -1 : NEXT(ftruncate64)(fd, n); }
int rename(const char *a, const char *b) { return here(b) && fails(0) ? -1 : NEXT(rename)(a, b); }
int unlink(const char *a) { return here(a) && fails(0) ? -1 : NEXT(unlink)(a); }
int mkdir(const char *a, mode_t m) { return here(a) && fails(1) ? -1 : NEXT(mkdir)(a, m); }
int chmod(const char *a, mode_t m) { return here(a) && fails(0) ? -1 : NEXT(chmod)(a, m); }

#define OPEN(name)                                                              \
    int name(const char *path, int flags, ...) {                                \
        mode_t mode = 0;                                                        \
        if (flags & (O_CREAT | O_TMPFILE)) {                                    \
            va_list more;                                                       \
            va_start(more, flags);                                              \
            mode = va_arg(more, mode_t);                                        \
            va_end(more);                                                       \
        }                                                                       \
        if ((flags & O_CREAT) && here(path) && fails(1)) return -1;             \
        return NEXT(name)(path, flags, mode);                                   \
    }
OPEN(open)
OPEN(open64)

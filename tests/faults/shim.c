/* Loaded before the C library: counts the calls that touch files below a folder, and kills at one, fails one, or notes all.
 *
 * graspq_arm sets what is done in this process; children do nothing. Calls on files below `under` are counted in the order
 * in which they are made, but for those below a folder `tensorboard`, whose writer is a thread of its own.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum { OFF, NOTE, KILL, KILL_HALF, FAIL, FAIL_ON, FAIL_FILE }; /* FAIL_ON: that call and all later ones; FAIL_FILE: those on the same file */
enum { WRITE = 1, FSYNC = 2, RENAME = 4, CREATE = 8, OPEN = 16, READ = 32, REMOVE = 64, MKDIR = 128, TRUNCATE = 256, LINK = 512, SAID = 1024 };
#define CHANGES (WRITE | FSYNC | RENAME | CREATE | REMOVE | MKDIR | TRUNCATE | LINK)

static struct { int mode, error, log; long at, count; pid_t process; unsigned calls; size_t length; char under[PATH_MAX]; } armed = {.log = -1};
static char bad[PATH_MAX]; /* the file of FAIL_FILE */
static pthread_mutex_t order = PTHREAD_MUTEX_INITIALIZER;

#define REAL(result, name, ...) static result (*real)(__VA_ARGS__); if (!real) real = dlsym(RTLD_NEXT, #name)

void graspq_arm(const char *under, int mode, long at, int error, const char *log, unsigned calls) {
    if (log[0]) armed.log = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_CREAT | O_TRUNC | O_APPEND | O_CLOEXEC, 0644);
    snprintf(armed.under, sizeof armed.under, "%s/", under);
    armed.length = strlen(armed.under);
    armed.at = at, armed.error = error, armed.calls = calls, armed.count = 0, armed.process = getpid();
    armed.mode = mode, bad[0] = 0;
}

static int ours(void) { return armed.mode != OFF && getpid() == armed.process; }

/* Whole path of a file that is named relative to a folder; empty where it is not below `under`. */
static void whole(int folder, const char *path, char *found) {
    char link[64];
    ssize_t length = 0;
    if (!path) path = "";
    if (path[0] != '/') {
        if (folder == AT_FDCWD) { if (syscall(SYS_getcwd, found, PATH_MAX) < 0) found[0] = 0; length = strlen(found); }
        else {
            snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
            length = syscall(SYS_readlink, link, found, PATH_MAX - 1);
            if (length < 0) length = 0;
        }
        found[length] = 0;
    }
    if (path[0]) {
        while (path[0] == '.' && path[1] == '/') path += 2;
        snprintf(found + length, PATH_MAX - length, "%s%s", length ? "/" : "", strcmp(path, ".") ? path : "");
    }
    size_t end = strlen(found);
    if (end && found[end - 1] == '/') found[--end] = 0;
    int inside = !strncmp(found, armed.under, armed.length) || (end + 1 == armed.length && !strncmp(found, armed.under, end));
    if (!inside || strstr(found, "/tensorboard")) found[0] = 0;
}

static void put(int op, long result, long place, const char *a, const char *b, const void *data, size_t size) {
    if (armed.mode != NOTE || armed.log < 0) return;
    int64_t head[6] = {op, result, place, a ? (int64_t)strlen(a) : 0, b ? (int64_t)strlen(b) : 0, (int64_t)size};
    struct iovec parts[4] = {{head, sizeof head}, {(void *)a, head[3]}, {(void *)b, head[4]}, {(void *)data, size}};
    if (syscall(SYS_writev, armed.log, parts, 4) < 0) abort();
}

/* Count a call; 0: go on, 1: fail with errno set, 2: do half of it and then call `die`. */
static void die(void) { syscall(SYS_kill, getpid(), SIGKILL); for (;;) pause(); }
static int met(int op, const char *name) {
    if (!(op & armed.calls)) return 0;
    long number = ++armed.count;
    if (armed.mode == KILL && number == armed.at) die();
    if (armed.mode == KILL_HALF && number == armed.at) { if (op == WRITE) return 2; die(); }
    if (armed.mode == FAIL_FILE && number == armed.at) strcpy(bad, name);
    if ((armed.mode == FAIL && number == armed.at) || (armed.mode == FAIL_ON && number >= armed.at) || (armed.mode == FAIL_FILE && bad[0] && !strcmp(bad, name))) {
        if (armed.log >= 0 && syscall(SYS_write, armed.log, "x", 1) < 0) abort(); /* it has failed: see failing_calls.py */
        errno = armed.error;
        return 1;
    }
    return 0;
}

#define LOCK pthread_mutex_lock(&order)
#define UNLOCK do { int kept = errno; pthread_mutex_unlock(&order); errno = kept; } while (0)

static int opened(int folder, const char *path, int flags, mode_t mode) {
    char name[PATH_MAX];
    if (!ours() || (whole(folder, path, name), !name[0]))
        return syscall(SYS_openat, folder, path, flags, mode);
    int changes = (flags & (O_CREAT | O_TRUNC)) && (flags & O_TMPFILE) != O_TMPFILE, op = changes ? CREATE : OPEN;
    LOCK;
    int result = -1;
    if (met(op, name) != 1) {
        struct stat before;
        int there = fstatat(folder, path, &before, 0) == 0;
        result = syscall(SYS_openat, folder, path, flags, mode);
        int kept = errno;
        put(op, result < 0 ? -1 : 0, there ? (flags & O_TRUNC ? 2 : 1) : 0, name, 0, 0, 0);
        errno = kept;
    }
    UNLOCK;
    return result;
}

#define MODE_OF(flags) mode_t mode = 0; if ((flags) & (O_CREAT | O_TMPFILE)) { va_list rest; va_start(rest, flags); mode = va_arg(rest, mode_t); va_end(rest); }
int open(const char *path, int flags, ...) { MODE_OF(flags) return opened(AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE_OF(flags) return opened(AT_FDCWD, path, flags, mode); }
int openat(int folder, const char *path, int flags, ...) { MODE_OF(flags) return opened(folder, path, flags, mode); }
int openat64(int folder, const char *path, int flags, ...) { MODE_OF(flags) return opened(folder, path, flags, mode); }
int creat(const char *path, mode_t mode) { return opened(AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, mode); }

static int reads_refused(const char *path, const char *how) {
    char name[PATH_MAX];
    if (!ours() || how[0] != 'r' || (whole(AT_FDCWD, path, name), !name[0])) return 0;
    LOCK;
    int refused = met(OPEN, name) == 1;
    if (!refused) put(OPEN, 0, 0, name, 0, 0, 0);
    UNLOCK;
    return refused;
}
FILE *fopen(const char *path, const char *how) { REAL(FILE *, fopen, const char *, const char *); return reads_refused(path, how) ? NULL : real(path, how); }
FILE *fopen64(const char *path, const char *how) { REAL(FILE *, fopen64, const char *, const char *); return reads_refused(path, how) ? NULL : real(path, how); }

/* Where the next byte goes. */
static long place_of(int file) {
    int flags = fcntl(file, F_GETFL);
    struct stat now;
    if (flags >= 0 && (flags & O_APPEND) && !fstat(file, &now)) return now.st_size;
    return lseek(file, 0, SEEK_CUR);
}

static ssize_t wrote(int file, const void *data, size_t size, long place) {
    char name[PATH_MAX];
#define DO(bytes) (place < 0 ? syscall(SYS_write, file, data, bytes) : syscall(SYS_pwrite64, file, data, bytes, place))
    if (!ours()) return DO(size);
    if (file == 1 || file == 2) { LOCK; put(SAID, file, 0, 0, 0, data, size); UNLOCK; return DO(size); }
    whole(file, "", name);
    if (!name[0]) return DO(size);
    LOCK;
    ssize_t result = -1;
    int what = met(WRITE, name);
    if (what == 2) { DO(size / 2); die(); }
    if (!what) {
        long at = place < 0 ? place_of(file) : place;
        result = DO(size);
        int kept = errno;
        put(WRITE, result < 0 ? -1 : 0, at, name, 0, data, result > 0 ? result : 0);
        errno = kept;
    }
    UNLOCK;
    return result;
}
ssize_t write(int file, const void *data, size_t size) { return wrote(file, data, size, -1); }
ssize_t pwrite(int file, const void *data, size_t size, off_t place) { return wrote(file, data, size, place); }
ssize_t pwrite64(int file, const void *data, size_t size, off64_t place) { return wrote(file, data, size, place); }

static ssize_t read_some(int file, void *data, size_t size, long place) {
    char name[PATH_MAX];
#define GET (place < 0 ? syscall(SYS_read, file, data, size) : syscall(SYS_pread64, file, data, size, place))
    if (!ours() || !(armed.calls & READ) || (whole(file, "", name), !name[0])) return GET;
    LOCK;
    ssize_t result = -1;
    if (!met(READ, name)) { result = GET; int kept = errno; put(READ, 0, 0, name, 0, 0, 0); errno = kept; }
    UNLOCK;
    return result;
}
ssize_t read(int file, void *data, size_t size) { return read_some(file, data, size, -1); }
ssize_t pread(int file, void *data, size_t size, off_t place) { return read_some(file, data, size, place); }
ssize_t pread64(int file, void *data, size_t size, off64_t place) { return read_some(file, data, size, place); }

static ssize_t sent(int to, int from, off_t *place, size_t size) {
    char name[PATH_MAX], link[64];
    if (!ours() || (whole(to, "", name), !name[0])) return syscall(SYS_sendfile, to, from, place, size);
    LOCK;
    ssize_t result = -1;
    int what = met(WRITE, name);
    if (what == 2) { syscall(SYS_sendfile, to, from, place, size / 2); die(); }
    if (!what) {
        long at = place_of(to);
        result = syscall(SYS_sendfile, to, from, place, size);
        int kept = errno;
        void *data = result > 0 && armed.mode == NOTE ? malloc(result) : NULL;
        if (data) {
            snprintf(link, sizeof link, "/proc/self/fd/%d", to);
            int again = syscall(SYS_openat, AT_FDCWD, link, O_RDONLY);
            if (again < 0 || syscall(SYS_pread64, again, data, result, at) != result) abort();
            syscall(SYS_close, again);
        }
        put(WRITE, result < 0 ? -1 : 0, at, name, 0, data, data ? result : 0);
        free(data);
        errno = kept;
    }
    UNLOCK;
    return result;
}
ssize_t sendfile(int to, int from, off_t *place, size_t size) { return sent(to, from, place, size); }
ssize_t sendfile64(int to, int from, off64_t *place, size_t size) { return sent(to, from, (off_t *)place, size); }
/* Python then copies by reading and writing. */
ssize_t copy_file_range(int a, off64_t *b, int c, off64_t *d, size_t e, unsigned f) { errno = ENOSYS; return -1; }

/* A call on one file or two; `name` and `other` are whole paths. */
#define CALL(op, place, folder, path, folder2, path2, ...) \
    char name[PATH_MAX], other[PATH_MAX]; \
    other[0] = 0; \
    if (!ours()) return syscall(__VA_ARGS__); \
    whole(folder, path, name); \
    if (op == RENAME || op == LINK) whole(folder2, path2, other); \
    if (!name[0] && !other[0]) return syscall(__VA_ARGS__); \
    LOCK; \
    int result = -1; \
    if (met(op, name) != 1) { result = syscall(__VA_ARGS__); int kept = errno; put(op, result < 0 ? -1 : 0, place, name, other, 0, 0); errno = kept; } \
    UNLOCK; \
    return result;
#define NONE ((const char *)0)

/* No power is cut here (`power_loss` replays what was noted), so the disk is not waited for: a wrong descriptor still fails. */
int fsync(int file) { struct stat there; CALL(FSYNC, 0, file, "", 0, NONE, SYS_fstat, file, &there) }
int fdatasync(int file) { return fsync(file); }
int ftruncate(int file, off_t size) { CALL(TRUNCATE, size, file, "", 0, NONE, SYS_ftruncate, file, size) }
int ftruncate64(int file, off64_t size) { CALL(TRUNCATE, size, file, "", 0, NONE, SYS_ftruncate, file, size) }
int truncate(const char *path, off_t size) { CALL(TRUNCATE, size, AT_FDCWD, path, 0, NONE, SYS_truncate, path, size) }
int truncate64(const char *path, off64_t size) { CALL(TRUNCATE, size, AT_FDCWD, path, 0, NONE, SYS_truncate, path, size) }
int rename(const char *a, const char *b) { CALL(RENAME, 0, AT_FDCWD, a, AT_FDCWD, b, SYS_rename, a, b) }
int renameat(int f, const char *a, int g, const char *b) { CALL(RENAME, 0, f, a, g, b, SYS_renameat, f, a, g, b) }
int renameat2(int f, const char *a, int g, const char *b, unsigned flags) { CALL(RENAME, flags, f, a, g, b, SYS_renameat2, f, a, g, b, flags) }
int link(const char *a, const char *b) { CALL(LINK, 0, AT_FDCWD, a, AT_FDCWD, b, SYS_link, a, b) }
int linkat(int f, const char *a, int g, const char *b, int flags) { CALL(LINK, 0, f, a, g, b, SYS_linkat, f, a, g, b, flags) }
int unlink(const char *path) { CALL(REMOVE, 0, AT_FDCWD, path, 0, NONE, SYS_unlink, path) }
int unlinkat(int folder, const char *path, int flags) { CALL(REMOVE, flags, folder, path, 0, NONE, SYS_unlinkat, folder, path, flags) }
int rmdir(const char *path) { CALL(REMOVE, AT_REMOVEDIR, AT_FDCWD, path, 0, NONE, SYS_rmdir, path) }
int mkdir(const char *path, mode_t mode) { CALL(MKDIR, 0, AT_FDCWD, path, 0, NONE, SYS_mkdir, path, mode) }
int mkdirat(int folder, const char *path, mode_t mode) { CALL(MKDIR, 0, folder, path, 0, NONE, SYS_mkdirat, folder, path, mode) }

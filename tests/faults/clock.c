/* A wall clock that goes wrong: preloaded, it changes what a process reads, as GRASPQ_CLOCK says. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <string.h>
#include <sys/time.h>
#include <time.h>

static long shift(void) {
    static _Thread_local unsigned long calls;
    const char *how = getenv("GRASPQ_CLOCK");
    if (how == NULL) return 0;
    if (strcmp(how, "past") == 0) return -1000000000L;
    if (strcmp(how, "future") == 0) return 2000000000L;
    /* An hour back and a day forth, by turns. */
    if (strcmp(how, "jumping") == 0) return ++calls % 2 ? -3600L : 86400L;
    return 0;
}

int clock_gettime(clockid_t which, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (real == NULL) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int result = real(which, now);
    if (result == 0 && which == CLOCK_REALTIME) now->tv_sec += shift();
    return result;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec exact;
    (void)zone;
    int result = clock_gettime(CLOCK_REALTIME, &exact);
    now->tv_sec = exact.tv_sec;
    now->tv_usec = exact.tv_nsec / 1000;
    return result;
}

time_t time(time_t *where) {
    struct timespec exact;
    clock_gettime(CLOCK_REALTIME, &exact);
    if (where != NULL) *where = exact.tv_sec;
    return exact.tv_sec;
}

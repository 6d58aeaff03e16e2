/* A wrong wall clock for a program under test: preloaded, it answers for the system's. CAUDATA_TEST_CLOCK is how far it is off, s; with
   CAUDATA_TEST_CLOCK_STEP it is put back by a day after so many seconds, with CAUDATA_TEST_CLOCK_SWING it is ahead by so many
   seconds in every other second. Clocks that only count (CLOCK_MONOTONIC) stay as they are. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>

typedef int (*clock_gettime_fn)(clockid_t, struct timespec *);

static int ask(clockid_t clock, struct timespec *out)
{
    static clock_gettime_fn real;
    if (!real)
        real = (clock_gettime_fn)dlsym(RTLD_NEXT, "clock_gettime");
    return real(clock, out);
}

static long long seconds(const char *name)
{
    const char *text = getenv(name);
    return text ? atoll(text) : 0;
}

int clock_gettime(clockid_t clock, struct timespec *out)
{
    static long long begun = -1;
    int result = ask(clock, out);
    if (result != 0 || clock != CLOCK_REALTIME)
        return result;
    struct timespec counted;
    ask(CLOCK_MONOTONIC, &counted);
    if (begun < 0)
        begun = counted.tv_sec;
    out->tv_sec += seconds("CAUDATA_TEST_CLOCK");
    long long step = seconds("CAUDATA_TEST_CLOCK_STEP");
    if (step && counted.tv_sec - begun >= step)
        out->tv_sec -= 86400;
    if (counted.tv_sec % 2)
        out->tv_sec += seconds("CAUDATA_TEST_CLOCK_SWING");
    return 0;
}

int gettimeofday(struct timeval *out, void *zone)
{
    struct timespec now;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &now);
    out->tv_sec = now.tv_sec;
    out->tv_usec = now.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *out)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (out)
        *out = now.tv_sec;
    return now.tv_sec;
}

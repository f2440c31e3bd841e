/* Moves the wall clock of the processes that preload it, as an administrator or a time server moves that of a machine.

   The file named by ES_TEST_CLOCK holds the seconds to add, a 64-bit integer; writing it takes effect at once. The
   monotonic clock stays as it is. Linux has no namespace for the wall clock. A wait until a time of that clock is made
   one for the time that the kernel knows; a wait that has begun is not changed. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <linux/futex.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static const int64_t none = 0;
static const volatile int64_t *moved_s = &none;

__attribute__((constructor)) static void open_clock(void) {
  const char *path = getenv("ES_TEST_CLOCK");
  int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
  if (file < 0) return;
  void *mapped = mmap(NULL, sizeof(int64_t), PROT_READ, MAP_SHARED, file, 0);
  if (mapped != MAP_FAILED) moved_s = mapped;
  close(file);
}

static long kernel(long number, long a, long b, long c, long d, long e, long f) {
  static long (*next)(long, ...);
  if (!next) next = (long (*)(long, ...))dlsym(RTLD_NEXT, "syscall");
  return next(number, a, b, c, d, e, f);
}

/* The kernel's time for one of the moved clock; those of the monotonic clock are less than 30 years. */
static struct timespec in_kernel_time(const struct timespec *until) {
  struct timespec known = *until;
  if (known.tv_sec > 1000000000) known.tv_sec -= *moved_s;
  return known;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
  int failed = (int)kernel(SYS_clock_gettime, clock, (long)now, 0, 0, 0, 0);
  if (!failed && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) now->tv_sec += *moved_s;
  return failed;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
  int failed = (int)kernel(SYS_gettimeofday, (long)now, (long)zone, 0, 0, 0, 0);
  if (!failed) now->tv_sec += *moved_s;
  return failed;
}

time_t time(time_t *stored) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (stored) *stored = now.tv_sec;
  return now.tv_sec;
}

int pthread_cond_timedwait(pthread_cond_t *restrict condition, pthread_mutex_t *restrict mutex,
                           const struct timespec *restrict until) {
  static int (*next)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);
  if (!next) next = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
  struct timespec known = in_kernel_time(until);
  return next(condition, mutex, &known);
}

long syscall(long number, ...) {
  va_list words;
  long word[6];
  va_start(words, number);
  for (int i = 0; i < 6; i++) word[i] = va_arg(words, long);
  va_end(words);
  struct timespec known;
  if (number == SYS_futex && (word[1] & FUTEX_CLOCK_REALTIME) && word[3]) {
    known = in_kernel_time((const struct timespec *)word[3]);
    word[3] = (long)&known;
  }
  return kernel(number, word[0], word[1], word[2], word[3], word[4], word[5]);
}

/* SPDX-License-Identifier: Apache-2.0
 *
 * The shape of a control loop: joint states in, torques out, here from and to text.
 *
 *     ./example blf_dsc_law.bin < states.txt > torques.txt
 *
 * A line of states is a stamp [ns], then the state and the reference of `blf_dsc_update`.
 */
#define _POSIX_C_SOURCE 199309L

#include "blf_dsc_law.h"

#include <inttypes.h>
#include <stdio.h>
#include <time.h>

#define N BLF_DSC_JOINTS
#define STOPPED 5

/* In a robot's loop, this waits for the next state. */
static int next_state(int64_t *stamp, double *values) {
  if (scanf("%" SCNd64, stamp) != 1) return 0;
  for (int k = 0; k < 6 * N; k++)
    if (scanf("%lf", values + k) != 1) return 0;
  return 1;
}

/* In a robot's loop, this limits the torques to what the arm may get, and sends them. */
static void send(double *torque) {
  for (int i = 0; i < N; i++) printf("%.17g%c", torque[i], i + 1 < N ? ' ' : '\n');
}

static double microseconds(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return 1e6 * (double)now.tv_sec + 1e-3 * (double)now.tv_nsec;
}

int main(int count, char **words) {
  blf_dsc_law *law;
  const char *problem = blf_dsc_load(count > 1 ? words[1] : "blf_dsc_law.bin", &law);
  if (problem != NULL) {
    fprintf(stderr, "%s\n", problem);
    return 1;
  }
  int64_t first = 0, last = 0, stamp;
  double values[6 * N], torque[N], total = 0.0, longest = 0.0, learning = 0.0;
  int samples = 0, stopped = 0;
  while (!stopped && next_state(&stamp, values)) {
    if (samples == 0) first = stamp;
    double t = (double)(stamp - first) * 1e-9;
    double dt = samples == 0 ? BLF_DSC_SAMPLE_TIME : (double)(stamp - last) * 1e-9;
    double before = microseconds();
    int flags = blf_dsc_update(law, t, dt, values, values + 3 * N, torque);
    double taken = microseconds() - before;
    if (flags & ~BLF_DSC_NOT_SENSORS) {
      fprintf(stderr, "flags %d at %g s: here you stop the arm\n", flags, t);
      stopped = 1;
    } else {
      send(torque); /* as limited */
      before = microseconds();
      blf_dsc_advance(law, torque);
      double learned = microseconds() - before;
      learning = learned > learning ? learned : learning;
    }
    total += taken;
    longest = taken > longest ? taken : longest;
    last = stamp;
    samples++;
  }
  fprintf(stderr, "%d samples, %.3g us each, at most %.3g us, and %.3g us of learning after it\n",
          samples, samples > 0 ? total / samples : 0.0, longest, learning);
  blf_dsc_free(law);
  return stopped ? STOPPED : 0;
}

/* SPDX-License-Identifier: Apache-2.0
 *
 * Calls the compiled law in blf_dsc_update.o and blf_dsc_advance.o.  All its vectors are parts of one array of doubles.
 */
#include "blf_dsc_law.h"

#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the law is compiled for a little-endian processor"
#endif

#define N BLF_DSC_JOINTS
#define DIGEST "@DIGEST@" /* of the objects, and of the places below */
#define VALUES @VALUES@
/* places among the values */
#define MEASUREMENT @MEASUREMENT@
#define KNOT @KNOT@ /* of the reference: its time, then six coefficients of each joint */
#define TORQUE @TORQUE@
#define LAST_TORQUE @LAST_TORQUE@ /* of the state */

/* A vector as the object takes it: owner, parent, number of items, their size, address, length, step. */
#define ARRAY void *, void *, int64_t, int64_t, double *, int64_t, int64_t
#define VECTOR(at, size) NULL, NULL, size, sizeof(double), now + (at), size, sizeof(double)

int32_t update_kernel(int64_t *flags, void **error,
                      @TYPES@,
                      double t, double dt) __asm__("@SYMBOL@");

int32_t advance_kernel(void **none, void **error,
                       @ADVANCE_TYPES@) __asm__("@ADVANCE_SYMBOL@");

struct blf_dsc_law {
  /* as in the file */
  char digest[sizeof DIGEST - 1];
  double initial[VALUES];
  uint32_t checksum;
  /* at work */
  double now[VALUES];
  int is_advanced;
};

#define CHECKED offsetof(struct blf_dsc_law, checksum)

/* Return the CRC-32 of some bytes. */
static uint32_t crc32_of(const void *bytes, size_t size) {
  const unsigned char *byte = bytes;
  uint32_t crc = 0xffffffffu;
  for (size_t i = 0; i < size; i++) {
    crc ^= byte[i];
    for (int bit = 0; bit < 8; bit++)
      crc = (crc >> 1) ^ (0xedb88320u & (0u - (crc & 1u)));
  }
  return ~crc;
}

static const char *read_law(const char *path, blf_dsc_law *law) {
  FILE *file = fopen(path, "rb");
  if (file == NULL) return "the file of the settings cannot be opened";
  size_t size = CHECKED + sizeof law->checksum, got = fread(law, 1, size, file);
  int is_whole = got == size && fgetc(file) == EOF;
  fclose(file);
  if (got < sizeof law->digest || memcmp(law->digest, DIGEST, sizeof law->digest) != 0)
    return "the file of the settings is of other objects: take all files of one folder";
  if (!is_whole || crc32_of(law, CHECKED) != law->checksum)
    return "the file of the settings is damaged: copy it again";
  return NULL;
}

const char *blf_dsc_load(const char *path, blf_dsc_law **law) {
  *law = malloc(sizeof **law);
  if (*law == NULL) return "there is not enough memory";
  const char *problem = read_law(path, *law);
  if (problem != NULL) {
    blf_dsc_free(*law);
    *law = NULL;
    return problem;
  }
  blf_dsc_begin(*law);
  return NULL;
}

/* Whether some values are finite: zero times any other is not zero. */
static int are_finite(const double *values, int size) {
  int finite = 1;
  for (int i = 0; i < size; i++) finite = finite && 0.0 * values[i] == 0.0;
  return finite;
}

void blf_dsc_begin(blf_dsc_law *law) {
  memcpy(law->now, law->initial, sizeof law->now);
  law->is_advanced = 1;
}

int blf_dsc_update(blf_dsc_law *law, double t, double dt, const double *state,
                   const double *reference, double *torque) {
  if (!law->is_advanced || !(dt > 0.0 && dt < BLF_DSC_GAP) || !are_finite(&t, 1) ||
      !are_finite(reference, 3 * N))
    return BLF_DSC_INVALID;
  double *now = law->now;
  memcpy(now + MEASUREMENT, state, 3 * N * sizeof *state);
  now[KNOT] = t;
  for (int i = 0; i < N; i++) {
    double *coefficients = now + KNOT + 1 + 6 * i;
    coefficients[0] = reference[i];
    coefficients[1] = reference[N + i];
    coefficients[2] = 0.5 * reference[2 * N + i];
  }
  int64_t flags = 0;
  void *error = NULL;
  if (update_kernel(&flags, &error,
                    @ARGUMENTS@,
                    t, dt) != 0)
    return BLF_DSC_INVALID;
  if (flags & BLF_DSC_INVALID) return (int)flags;
  memcpy(torque, now + TORQUE, N * sizeof *torque);
  law->is_advanced = 0;
  return (int)flags;
}

int blf_dsc_advance(blf_dsc_law *law, const double *sent) {
  if (law->is_advanced || !are_finite(sent, N)) return BLF_DSC_INVALID;
  double *now = law->now;
  memcpy(now + LAST_TORQUE, sent, N * sizeof *sent);
  void *none = NULL, *error = NULL;
  if (advance_kernel(&none, &error,
                     @ADVANCE_ARGUMENTS@) != 0)
    return BLF_DSC_INVALID;
  law->is_advanced = 1;
  return 0;
}

void blf_dsc_free(blf_dsc_law *law) { free(law); }

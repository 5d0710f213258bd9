/* SPDX-License-Identifier: Apache-2.0
 *
 * The control law of blf_dsc_controller @VERSION@, called from C.
 *
 * THE SAFE STOP AND THE ENVELOPE ARE NOT IN HERE: the caller limits speeds, positions and torques,
 * and stops the arm.  README.md says when.
 *
 * Each array has BLF_DSC_JOINTS entries for each quantity, in the order
 * @JOINTS@.
 * Of prismatic joints, m stands for rad, and N for N m.
 */
#ifndef BLF_DSC_LAW_H
#define BLF_DSC_LAW_H

#ifdef __cplusplus
extern "C" {
#endif

#define BLF_DSC_JOINTS @N@
#define BLF_DSC_SAMPLE_TIME @SAMPLE_TIME@ /* s: update the law at this period */
#define BLF_DSC_GAP @GAP@ /* s: after as long without a state, stop the arm */

/* What `blf_dsc_update` returns, as a sum.  Each but the last is a reason to stop. */
enum {
  BLF_DSC_SUSPECT = @SUSPECT@, /* not finite, past the limit of a torque, or of the error */
  BLF_DSC_OUTSIDE = @OUTSIDE@, /* an error outside its bound */
  BLF_DSC_INVALID = @INVALID@, /* a state, time or reference that cannot be, and is not used */
  BLF_DSC_NO_EFFECT = @NO_EFFECT@, /* commands do not reach the arm, or it is held */
  BLF_DSC_CONTRADICTION = @CONTRADICTION@, /* velocities are not those of the positions */
  BLF_DSC_OSCILLATES = @OSCILLATES@, /* the arm oscillates */
  BLF_DSC_NOT_SENSORS = @NOT_SENSORS@ /* the load observer is left out from now on */
};

typedef struct blf_dsc_law blf_dsc_law;

/* Read the settings `blf_dsc_law.bin` and begin; return NULL, or what is wrong.
 *
 * It allocates all memory, twice @MEGABYTES@ MB, and takes some 0.1 s: call it before the loop.
 */
const char *blf_dsc_load(const char *path, blf_dsc_law **law);

/* Return to the initial state: nothing is learned, and no torque acts.
 *
 * It copies @MEGABYTES@ MB: call it before the loop, at an arm that rests in its brakes or drives.
 * The first torque is not limited in rate.
 */
void blf_dsc_begin(blf_dsc_law *law);

/* Compute the torques for a joint state; return its flags.
 *
 * t          time since `blf_dsc_begin` [s]: 0 at the first state
 * dt         time since the last state [s], below BLF_DSC_GAP; at the first state
 *            BLF_DSC_SAMPLE_TIME
 * state      positions [rad], velocities [rad/s], and efforts [N m], as `robot.effort` of the
 *            configuration describes them; NaN for efforts that are not measured
 * reference  positions [rad], velocities [rad/s] and accelerations [rad/s^2] at time t: smooth,
 *            within the limits of the arm, and at the first state where the arm is
 * torque     of this state [N m]; unchanged if BLF_DSC_INVALID is returned
 *
 * Call it once for each state, in one thread at a time, and `blf_dsc_advance` after it: an update that
 * follows another is invalid.  It allocates nothing, waits for nothing and calls no system.
 */
int blf_dsc_update(blf_dsc_law *law, double t, double dt, const double *state,
                   const double *reference, double *torque);

/* Learn from the last update, whose torques [N m] have left as `sent`; return 0, or BLF_DSC_INVALID
 * without an update, or if they are not finite.
 *
 * No torque waits for it: call it after sending.  Of a Panda on a busy virtual core, the update takes
 * 12 us, at most 40; learning 17 us, every 50th time 0.15 ms, and 0.8 ms once, when the window is first
 * full.  example.c measures both on yours.
 */
int blf_dsc_advance(blf_dsc_law *law, const double *sent);

void blf_dsc_free(blf_dsc_law *law);

#ifdef __cplusplus
}
#endif

#endif

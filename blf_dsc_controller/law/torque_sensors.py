# SPDX-License-Identifier: Apache-2.0
"""Whether the load observer may go on: else it is left out for good.

Commissioning, or a preset, has established that efforts are torques of joint sensors at the links.
That may not hold for ever, or for another arm: a sensor may be stuck, dead, or in another unit,
efforts may be commands or currents of motors, encoders may be at the motors, and gears may be
softer than they were.  The load observer then is feedback that nobody designed.  With U the
response of the drives, M_l the inertia of the links of the model, L its pole, and k and D those
of a gear,

    r = L / (s + L) (tau_J - M_l s^2 y)

    efforts are commands:  tau_J = U tau     a loop of gain up to 1 around the law, and more
                                             where the gear resonates and M_l s^2 y turns
    y is of the motor:     tau_J = M_l s^2 y (D s + k) / (M_l s^2 + D s + k)
                                             the gear's resonance, with M_l behind it

are stable only with an L of some rad/s.  So r fades out for good where

- *it oscillates* (`oscillation`, of r instead of the error), or the arm does: r is left out before
  the arm is reported to oscillate, unless that is violent.
- *efforts do not follow*: drives with a loop around sensors make of them what is commanded,
  whatever load or contact is behind.  An effort that is off by `_OFF_TORQUE` of the torque limit
  leaves r out while that lasts, and if it lasts while the arm follows its reference, for
  good: the command has reached the arm.  Otherwise it may not have (`effect`).
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law import oscillation
from blf_dsc_controller.law.lag import filter_gain

NONE, OSCILLATING, OFF = range(3)
"""What is wrong with r, for good, if anything."""

# s, with which r is left out or comes back: it may grow threefold in 10 ms
_FADE = 0.005
_FADED = 1e-6  # of r
_OSCILLATION_TORQUE = 0.0125  # of the torque limit: a quarter of an oscillation of r
_OFF_TORQUE = 0.1  # of the torque limit
_OFF_TIME = 0.05  # s
_FOLLOWED_SPEED = 0.25  # of the speed of the reference


class State(NamedTuple):
    """What is kept from one sample to the next."""

    fault: Cell  # one of NONE to OFF
    joint: Cell  # that has it
    # N m, of the last interval behind L: the torque commanded
    command: Annotated[Array, 'n * observer.enabled']
    off_time: Annotated[Array, 'n * observer.enabled']  # s, since efforts are off
    oscillation: oscillation.State  # of r


class Workspace(NamedTuple):
    """Scratch of one sample."""

    # N m, efforts less commands
    differences: Annotated[Array, 'n * observer.enabled']
    threshold: Annotated[Array, 'n * observer.enabled']  # N m, of a wave of r
    zeros: Annotated[Array, 'n * observer.enabled']


@inner
def begin(state: State, torque: Array) -> None:
    """Begin to watch r, a `torque` (n,) [N m]."""
    oscillation.begin(state.oscillation, torque, torque)


@inner
def follow_applied(
    state: State, row: Array, m: int, bandwidth: float, dt: float
) -> None:
    """Pass the applied torque of the last interval, at m of `row`, through the pole L.

    `bandwidth` is L [rad/s], `dt` [s] the length of the interval.
    """
    gain = filter_gain(1.0 / bandwidth, dt)
    for i in range(state.command.size):
        state.command[i] += gain * (row[i, m] - state.command[i])


@inner
def note_fault(state: State, fault: float, i: int) -> None:
    """Keep the first `fault`, and the joint i that has it."""
    if state.fault[0] == NONE:
        state.fault[0] = fault
        state.joint[0] = i


@inner
def watch_oscillation(
    state: State, workspace: Workspace, limit: Array, torque: Array, dt: float
) -> None:
    """Detect whether r oscillates.

    `torque` is r (n,) [N m], `limit` (n,) [N m] the torque limit.
    """
    for i in range(torque.size):
        workspace.threshold[i] = _OSCILLATION_TORQUE * limit[i]
    oscillation.watch(
        state.oscillation,
        workspace.zeros,
        torque,
        torque,
        workspace.zeros,
        workspace.threshold,
        dt,
    )
    for i in range(torque.size):
        if oscillation.oscillates(state.oscillation, i):
            note_fault(state, OSCILLATING, i)


@inner
def leave_out_oscillating(state: State, arm: oscillation.State) -> None:
    """Leave r out for good if the `arm` oscillates."""
    for i in range(state.off_time.size):
        if oscillation.oscillates(arm, i):
            note_fault(state, OSCILLATING, i)


@inner
def watch_following(
    state: State, workspace: Workspace, limit: Array, dq: Array, dqr: Array, dt: float
) -> bool:
    """Detect whether efforts are off for good; return whether they are off now, which may pass.

    The arm follows its reference where dq and dqr (n,) [rad/s] are about equal.  `limit` (n,)
    [N m] is the torque limit.
    """
    error_square = speed_square = 0.0
    for i in range(limit.size):
        error_square += (dq[i] - dqr[i]) ** 2
        speed_square += dqr[i] ** 2
    follows = error_square < _FOLLOWED_SPEED * _FOLLOWED_SPEED * speed_square
    is_off = False
    for i in range(limit.size):
        differs = abs(workspace.differences[i]) > _OFF_TORQUE * limit[i]
        is_off = is_off or differs
        state.off_time[i] = state.off_time[i] + dt if differs and follows else 0.0
        if state.off_time[i] > _OFF_TIME:
            note_fault(state, OFF, i)
    return is_off


@inner
def is_fading(faded: Array) -> bool:
    """Whether r is being left out, or comes back: it may be wrong."""
    return bool(0.0 < faded[0] < 1.0)


@inner
def fade(state: State, faded: Array, is_off: bool, dt: float) -> None:
    """Fade r out while the efforts are in doubt, or in again, over `dt` [s].

    `faded` is the fraction of r that is left out, modified in place; a zero stays exact.
    """
    target = 1.0 if is_off or state.fault[0] != NONE else 0.0
    if faded[0] != target:
        faded[0] += filter_gain(_FADE, dt) * (target - faded[0])
        if abs(faded[0] - target) < _FADED:
            faded[0] = target

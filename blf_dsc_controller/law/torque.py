# SPDX-License-Identifier: Apache-2.0
"""Saturation, and conversion between torques of the law and commands of the drives.

*Drives.*  A law computes with the whole torque of a joint.  A drive may add the torque that holds
the arm against gravity itself, by its own model of the arm and of the payload that it knows:

    whole torque = command + G_d(q)

`find_added` computes G_d(q); `saturate` subtracts it from the output, and
`find_applied` adds it to the torque of the last interval.  Friction that a drive
compensates appears on neither side: the friction columns then describe what is left of
it (`Robot.friction`).  A drive that adds nothing has no columns here, and all sums are
with zero, which changes no bit.

*Saturation* is in level and rate.  The level limit holds for the whole torque of the joint, which
is what its motor tolerates, and for the command alone, which is what its driver may cut: the two
differ by what the drive adds.  The rate is that of the command, and not limited at the first
sample, unless another torque acts by then (`Controller.take_over`).  The level limit takes
precedence, for example if it is lowered below the last torque.

*What the rate limit holds back.*  A torque that always moves towards its demand still climbs to it
while the demand falls already: it lags behind, the more the larger the motion, and a loop that has
met its limit once may run away.  So the torque moves as its demand does, within the limit, and the
difference is released at a fraction r of the limit:

    |held - held'| <= r R dt,      torque = demand - held', within R dt of the last

It turns round as soon as the demand moves back faster than r R.  For a sinusoid the lag thus stays
below asin r, 30 degrees, whatever the amplitude: the limit lowers the gain of the loop instead.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.arms.serial_chain import SerialChain, fill_regressor
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law.clipping import clip

_RELEASED_RATE = 0.5  # r

LEVEL_CUT = 1.0
RATE_CUT = 2.0


class Settings(NamedTuple):
    """The parameters `torque.*`, and the model of what the drives add."""

    limit: Annotated[Array, 'n']  # N m
    rate_limit: Annotated[Array, 'n']  # N m/s; 0: none
    # 1: measured efforts contain what the drive adds, 0: they do not
    effort_is_whole: int
    drive: int  # columns of the gravity that the drive adds; 0: it adds none
    drive_size: int  # of drive_chain
    # `Bodies` of the drive's model, with its memory
    drive_chain: Annotated[Array, 'torque.drive_size']
    # masses [kg] and moments [kg m] of the drive's model
    drive_inertias: Annotated[Array, 'torque.drive']


class State(NamedTuple):
    """What saturation keeps from one sample to the next."""

    added: Annotated[Array, 'n']  # G_d at the last one, N m
    # demand beyond the torque, that the rate limit has held back, N m
    held_back: Annotated[Array, 'n']
    takes_over: Cell  # 1: the last torque acts already when the first sample comes
    # number of samples in which the torque was cut at its limit
    level_cuts: Annotated[Array, 'n']
    # number of samples in which it was cut at its rate limit
    rate_cuts: Annotated[Array, 'n']


class Workspace(NamedTuple):
    """Values of one sample."""

    added: Annotated[Array, 'n']  # G_d, torque that the drive adds to the command, N m
    # how the torque was cut: 0, LEVEL_CUT, RATE_CUT, or their sum
    cuts: Annotated[Array, 'n']
    columns: Annotated[Array, 'n', 'torque.drive']  # of the gravity that the drive adds
    zeros: Annotated[Array, 'n']


@inner
def find_added(settings: Settings, workspace: Workspace, q: Array) -> None:
    """Compute G_d(q) (n,) [N m], what the drives add, at q (n,) [rad], as `workspace.added`."""
    if settings.drive == 0:
        return
    added, zeros = workspace.added, workspace.zeros
    fill_regressor(settings.drive_chain, q, zeros, zeros, zeros, workspace.columns)
    for i in range(q.size):
        added[i] = 0.0
        for j in range(settings.drive):
            added[i] += workspace.columns[i, j] * settings.drive_inertias[j]


@inner
def find_applied(
    state: State, workspace: Workspace, command: Array, applied: Array
) -> None:
    """Write the mean whole torque of the last interval to `applied` (n,) [N m].

    It is the last `command` (n,) and the mean of G_d at both ends.
    """
    for i in range(applied.size):
        applied[i] = command[i] + 0.5 * (state.added[i] + workspace.added[i])
        state.added[i] = workspace.added[i]


def added_torque(settings: Settings, q: Array) -> Array:
    """Return G_d(q) (n,) [N m] at a position q (n,)."""
    if settings.drive == 0:
        return np.zeros(q.size)
    chain = SerialChain(q.size, settings.drive, settings.drive_chain)
    (H,) = regressors_at(chain, q[np.newaxis], *np.zeros((3, 1, q.size)))
    return np.asarray(H @ settings.drive_inertias)


@inner
def slow_down(demand: float, last: float, held: float, step: float) -> float:
    """Return the torque [N m] for a demand [N m], limited in rate.

    It is at most `step` from `last`, and less what is `held` back, of which r `step` is released.
    """
    released = clip(held, -_RELEASED_RATE * step, _RELEASED_RATE * step)
    return clip(demand - (held - released), last - step, last + step)


@inner
def saturate(
    settings: Settings,
    state: State,
    workspace: Workspace,
    demand: Array,
    last: Array,
    has_last: bool,
    dt: float,
    torque: Array,
) -> None:
    """Limit the `demand` (n,) [N m] in level and rate; write the command (n,) [N m] to `torque`.

    `workspace.cuts` says which limit cut it.

    Args:
        last: last command (n,) [N m].
        has_last: whether there is one, `dt` [s] ago; else the rate is not limited.
    """
    added, cuts = workspace.added, workspace.cuts
    for i in range(demand.size):
        top = settings.limit[i]
        low = max(-top, added[i] - top)
        high = min(top, added[i] + top)
        whole = clip(demand[i], low, high)
        cuts[i] = 0.0
        if whole != demand[i]:
            cuts[i] = LEVEL_CUT
            state.level_cuts[i] += 1.0
        if settings.rate_limit[i] > 0.0 and has_last:
            step = settings.rate_limit[i] * dt
            slowed = slow_down(whole, last[i] + added[i], state.held_back[i], step)
            if slowed != whole:
                cuts[i] += RATE_CUT
                state.rate_cuts[i] += 1.0
            slowed = clip(slowed, low, high)
            state.held_back[i] = whole - slowed
            whole = slowed
        else:
            state.held_back[i] = 0.0
        torque[i] = whole - added[i]


@inner
def is_cut(workspace: Workspace) -> bool:
    """Whether a torque of this sample was cut by a limit."""
    is_any = False
    for cut in workspace.cuts:
        is_any = is_any or cut > 0.0
    return is_any

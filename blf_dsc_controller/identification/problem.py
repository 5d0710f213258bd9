# SPDX-License-Identifier: Apache-2.0
"""A recording of an arm with its URDF, ready to be fitted: rows, windows, and the prior."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.base_parameters import BaseParameters, base_parameters
from blf_dsc_controller.arms.serial_chain import ROTOR
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.clipping import without_clipped
from blf_dsc_controller.identification.joint_alone import Alone, fit_alone
from blf_dsc_controller.identification.mounting import other_mounting
from blf_dsc_controller.identification.pick_up import carried_load, without_changes
from blf_dsc_controller.identification.prior import Prior, prior_of
from blf_dsc_controller.identification.recording import Recording
from blf_dsc_controller.identification.signs import Signs, likely_signs
from blf_dsc_controller.identification.values import base_matrix
from blf_dsc_controller.identification.windows import (
    STILL,
    Carried,
    Rows,
    Split,
    rows_of,
    split,
)
from blf_dsc_controller.run import Floats

Effort = Literal['torque', 'without-gravity', 'command']
"""What efforts are."""

_SHORTEST = 5.0  # s
_TINY = 1e-6  # N m or N, least torque that scales a prior
_BETTER = 0.5  # times the cost, at most, with a mounting that is not the given one


class Problem(NamedTuple):
    """What is fitted: torques of the rows, by values whose prior is that of the URDF."""

    chain: Chain
    parameters: BaseParameters
    rows: Rows
    windows: Split
    G: Floats  # (p + 6 n + 14, 17 n + 14) of `base_matrix`
    prior: Prior  # of all terms
    P: Floats  # (p,) base parameters of the URDF
    reversed: NDArray[np.bool_]  # (n,) joints whose efforts had the opposite sign
    # (3,) m/s^2 in the base, that explains the torques far better than the given one
    other_gravity: Floats | None
    carried: Carried | None  # when there is a load; None: it is none of the unknowns


def problem_of(
    recording: Recording,
    robot: Robot,
    effort: Effort,
    picked_up: float | None,
    *,
    find_signs: bool,
) -> Problem:
    """Return the problem of a recording; arguments and errors are those of `identify_arm`."""
    if recording.duration < _SHORTEST:
        raise BlfDscError(
            f'the recording lasts {recording.duration:.3g} s; record at least {_SHORTEST:g} s'
        )
    problem = _as_recorded(recording, robot, effort, load=picked_up is not None)
    if effort != 'without-gravity':
        problem = _checked(problem, recording, robot, effort, find_signs=find_signs)
    return problem if picked_up is None else _with_load(problem, picked_up)


def _as_recorded(
    recording: Recording, robot: Robot, effort: Effort, *, load: bool
) -> Problem:
    """Return the problem with the signs as they are recorded."""
    chain = robot.chain(recording.joints)
    n = len(chain.joints)
    parameters = base_parameters(chain, robot.gravity)
    P = parameters.of(chain.inertias, robot.rotors(chain))
    rows = rows_of(recording, parameters.model)
    windows = split(rows)
    rows = without_clipped(rows)
    if effort == 'without-gravity':
        rows = rows.with_torque(lambda at: rows.torque[at] + rows.gravity_torque(P, at))
    largest = np.maximum(rows.largest_torque, _TINY)
    speed = np.maximum(rows.speed, STILL)
    return Problem(
        chain=chain,
        parameters=parameters,
        rows=rows,
        windows=windows,
        G=base_matrix(parameters, n),
        prior=prior_of(robot, chain, largest, speed, load=load),
        P=P,
        reversed=np.zeros(n, dtype=bool),
        other_gravity=None,
        carried=None,
    )


def _checked(
    problem: Problem,
    recording: Recording,
    robot: Robot,
    effort: Effort,
    *,
    find_signs: bool,
) -> Problem:
    """Return the problem with the right signs, and gravity if it is not the given one."""
    alone = _alone(problem, find_signs=find_signs)
    gravity = other_mounting(
        problem.rows,
        problem.windows.fit,
        problem.chain,
        problem.P,
        np.array(robot.gravity),
        alone,
    )
    signs = np.ones(len(problem.chain.joints))
    if gravity is not None:
        elsewhere = replace(robot, gravity=tuple(gravity.tolist()))
        other = _as_recorded(recording, elsewhere, effort, load=False)
        signs_there = _better_signs(
            problem, alone, other, _alone(other, find_signs=find_signs)
        )
        if signs_there is not None:
            signs = signs_there
            problem = problem._replace(other_gravity=gravity)
    if problem.other_gravity is None and find_signs:
        signs, _ = likely_signs(alone, problem.G, problem.prior)
    torque = problem.rows.torque
    rows = problem.rows.with_torque(lambda at: torque[at] * signs)
    return problem._replace(rows=rows, reversed=signs < 0.0)


def _better_signs(
    problem: Problem, alone: Alone, other: Problem, alone_there: Alone
) -> Signs | None:
    """Return the signs with which another problem explains the torques far better, or None."""
    residual = np.minimum(alone.residual, alone_there.residual)
    _, cost = likely_signs(alone._replace(residual=residual), problem.G, problem.prior)
    signs, cost_there = likely_signs(
        alone_there._replace(residual=residual), other.G, other.prior
    )
    return signs if cost_there < _BETTER * cost else None


def _alone(problem: Problem, *, find_signs: bool) -> Alone:
    """Return the fits of each joint alone; given signs are right."""
    alone = fit_alone(problem.rows, problem.windows.fit, problem.G, problem.prior)
    return alone if find_signs else alone._replace(friction=np.ones(alone.torque.size))


def _with_load(problem: Problem, picked_up: float) -> Problem:
    """Return the problem with a load that is picked up at that time [s]; NaN: find it."""
    last_body = problem.parameters.K[:, -(ROTOR + 1) : -1]
    rows = problem.rows._replace(load=last_body)
    carried = Carried(picked_up)
    windows = problem.windows
    if np.isnan(picked_up):
        carried = carried_load(rows, windows, problem.G, problem.prior)
        windows = without_changes(windows, rows, carried)
    rows = rows._replace(carried=carried)
    return problem._replace(rows=rows, windows=windows, carried=carried)

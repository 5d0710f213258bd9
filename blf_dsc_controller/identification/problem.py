# SPDX-License-Identifier: Apache-2.0
"""A recording of an arm with its URDF, ready to be fitted: rows, windows, and the prior."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from blf_dsc_controller.arms.base_parameters import BaseParameters, base_parameters
from blf_dsc_controller.arms.serial_chain import ROTOR
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.clipping import without_clipped
from blf_dsc_controller.identification.joint_alone import fit_alone
from blf_dsc_controller.identification.mounting import other_mounting
from blf_dsc_controller.identification.pick_up import carried_load, without_changes
from blf_dsc_controller.identification.prior import Prior, prior_of
from blf_dsc_controller.identification.recording import Flags, Recording
from blf_dsc_controller.identification.signs import likely_signs
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


class Problem(NamedTuple):
    """What is fitted: torques of the rows, by values whose prior is that of the URDF."""

    recording: Recording
    chain: Chain
    parameters: BaseParameters
    rows: Rows
    windows: Split
    prior: Prior  # of all terms
    P: Floats  # (p,) base parameters of the URDF
    reversed: Flags  # (n,) joints whose efforts had the opposite sign
    # (3,) m/s^2 in the base, that seems to be in the torques, if not the given one
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
    chain = robot.chain(recording.joints)
    parameters = base_parameters(chain, robot.gravity)
    P = parameters.of(chain.inertias, robot.rotors(chain))
    rows = rows_of(recording, parameters.model)
    windows = split(rows)
    rows = without_clipped(rows)
    if effort == 'without-gravity':
        rows = rows.with_torque(lambda at: rows.torque[at] + rows.gravity_torque(P, at))
    largest = np.maximum(rows.largest_torque, _TINY)
    speed = np.maximum(rows.speed, STILL)
    load = picked_up is not None
    problem = Problem(
        recording=recording,
        chain=chain,
        parameters=parameters,
        rows=rows,
        windows=windows,
        prior=prior_of(robot, chain, parameters, largest, speed, load=load),
        P=P,
        reversed=np.zeros(len(chain.joints), dtype=bool),
        other_gravity=None,
        carried=None,
    )
    if effort != 'without-gravity':
        problem = _checked(problem, np.array(robot.gravity), find_signs=find_signs)
    return problem if picked_up is None else _with_load(problem, picked_up)


def _checked(problem: Problem, gravity: Floats, *, find_signs: bool) -> Problem:
    """Return the problem with the most likely signs, and gravity if it may be another one."""
    rows, fit = problem.rows, problem.windows.fit
    signs = np.ones(len(problem.chain.joints))
    alone = fit_alone(rows, fit, problem.prior)
    if find_signs:
        signs = likely_signs(alone, problem.prior)
    else:
        alone = alone._replace(friction=signs)
    other = other_mounting(rows, fit, problem.chain, problem.P, gravity, alone)
    right = rows.with_torque(lambda at: rows.torque[at] * signs)
    return problem._replace(rows=right, reversed=signs < 0.0, other_gravity=other)


def _with_load(problem: Problem, picked_up: float) -> Problem:
    """Return the problem with a load that is picked up at that time [s]; NaN: find it."""
    last_body = problem.parameters.K[:, -(ROTOR + 1) : -1]
    rows = problem.rows._replace(load=last_body)
    carried = Carried(picked_up)
    windows = problem.windows
    if np.isnan(picked_up):
        carried = carried_load(rows, windows, problem.prior)
        windows = without_changes(windows, rows, carried)
    rows = rows._replace(carried=carried)
    return problem._replace(rows=rows, windows=windows, carried=carried)

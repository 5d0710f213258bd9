# SPDX-License-Identifier: Apache-2.0
"""A recording of an arm with its URDF, ready to be fitted: rows, windows, and the prior."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.base_parameters import BaseParameters, base_parameters
from blf_dsc_controller.arms.serial_chain import ROTOR
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.pick_up import pick_up_time
from blf_dsc_controller.identification.plausibility import (
    gravity_share,
    reversed_joints,
)
from blf_dsc_controller.identification.prior import Prior, prior_of
from blf_dsc_controller.identification.recording import Recording
from blf_dsc_controller.identification.values import base_matrix
from blf_dsc_controller.identification.windows import STILL, Rows, Split, rows_of, split
from blf_dsc_controller.run import Floats

Effort = Literal['torque', 'without-gravity', 'command']
"""What efforts are."""

_SHORTEST = 5.0  # s
_TINY = 1e-6  # N m or N, least torque that scales a prior


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
    picked_up: float | None  # s, when the load is picked up

    @property
    def gravity(self) -> float:
        """Share of the URDF's gravity in the torques; NaN if it would hardly show."""
        return gravity_share(self.rows, self.windows.fit, self.P)


def problem_of(
    recording: Recording,
    robot: Robot,
    effort: Effort,
    picked_up: float | None,
    *,
    find_signs: bool,
) -> Problem:
    """Return the problem of a recording; arguments and errors are those of `identify_arm`."""
    chain = robot.chain(recording.joints)
    n = len(chain.joints)
    parameters = base_parameters(chain, robot.gravity)
    if recording.duration < _SHORTEST:
        raise BlfDscError(
            f'the bag holds {recording.duration:.3g} s; record at least {_SHORTEST:g} s'
        )
    rows = rows_of(recording, parameters.model)
    windows = split(rows)
    P = parameters.of(chain.inertias, robot.rotors(chain))
    opposite = np.zeros(n, dtype=bool)
    if effort == 'without-gravity':
        rows = rows.with_torque(lambda at: rows.torque[at] + rows.gravity_torque(P, at))
    elif find_signs:
        opposite = reversed_joints(rows, windows.fit, P)
        signs = np.where(opposite, -1.0, 1.0)
        rows = rows.with_torque(lambda at: rows.torque[at] * signs)
    largest = np.maximum(rows.largest_torque, _TINY)
    speed = np.maximum(rows.speed, STILL)
    prior = prior_of(robot, chain, largest, speed, load=picked_up is not None)
    G = base_matrix(parameters, n)
    problem = Problem(
        chain, parameters, rows, windows, G, prior, P, opposite, picked_up
    )
    if picked_up is None:
        return problem
    return _with_load(problem, picked_up)


def _with_load(problem: Problem, picked_up: float) -> Problem:
    """Return the problem with a load that is picked up at that time [s]; NaN: find it."""
    last_body = problem.parameters.K[:, -(ROTOR + 1) : -1]
    rows = problem.rows._replace(load=last_body)
    if np.isnan(picked_up):
        picked_up = pick_up_time(rows, problem.windows.fit, problem.G, problem.prior)
    return problem._replace(rows=rows._replace(loaded=picked_up), picked_up=picked_up)

# SPDX-License-Identifier: Apache-2.0
"""Warnings about bodies and ranges of a URDF that no arm has, as by other units."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from blf_dsc_controller.arms.inertia import pseudo_inertia
from blf_dsc_controller.arms.urdf import Chain, Joint

_LONGEST = 10.0  # m, reach of an arm
_SMALLEST = 0.003  # m, radius of gyration of a body that has a mass worth naming
_LIGHT = 0.05  # kg
_NEGATIVE = -0.05  # times the largest second moment of a body, the least one
_TURNS = 4.0  # of a joint, from one limit to the other


def body_warnings(chain: Chain) -> Iterator[str]:
    """Yield what is wrong with lengths, ranges, masses and inertias, each with what to look at."""
    if chain.reach > _LONGEST:
        yield (
            f'robot.urdf: the arm is {chain.reach:.3g} m long from its first joint to the tip: '
            'are its lengths in m?'
        )
    for joint in chain.joints:
        turns = (joint.upper - joint.lower) / math.tau
        if joint.kind == 'revolute' and _TURNS < turns < math.inf:
            yield (
                f'robot.urdf: {joint.name} turns {turns:.3g} times from limit to limit: are its '
                'limits in rad?'
            )
        yield from _of_inertia(joint)


def _of_inertia(joint: Joint) -> Iterator[str]:
    """Yield what is wrong with the mass and inertia of what a joint moves."""
    J = pseudo_inertia(joint.inertia)
    mass = J[3, 3]
    if mass < _LIGHT:
        return
    centre = J[:3, 3] / mass
    moments = np.linalg.eigvalsh(J[:3, :3] - mass * np.outer(centre, centre))
    radius = math.sqrt(max(moments.sum(), 0.0) / mass)
    if radius < _SMALLEST:
        yield (
            f'robot.urdf: what {joint.name} moves has {mass:.3g} kg within {1e3 * radius:.2g} mm '
            'of its centre: are masses in kg, and inertias in kg m^2 and given?'
        )
    elif moments[0] < _NEGATIVE * moments[-1]:
        yield (
            f'robot.urdf: no body has the inertia of what {joint.name} moves: one of its '
            'principal moments is larger than the other two together. Look at the inertia of '
            'its links, also at the order of ixx, ixy, ...'
        )

# SPDX-License-Identifier: Apache-2.0
"""An identified arm as parameters `robot.*` of this package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.values import ROTOR_INERTIA
from blf_dsc_controller.run import Floats

_DIGITS = 6  # significant


def robot_parameters(found: Identified, robot: Robot, urdf: Path) -> dict[str, Any]:
    """Return the parameters by dotted name, with the corrected URDF at this path."""
    viscous, coulomb = found.dynamics
    values: dict[str, Any] = {
        'urdf': str(urdf.resolve()),
        'base': found.chain.base,
        'tip': found.chain.tip,
        'gravity': tuple(robot.gravity),
        'rotor_inertia': _rounded(found.parts.terms[ROTOR_INERTIA]),
        'viscous': _rounded(viscous),
        'coulomb': _rounded(coulomb),
    }
    compliance = found.compliance
    if compliance and compliance.is_twist and compliance.is_known.all():
        values['joint_stiffness'] = _rounded(compliance.stiffness[0])
    parameters = {f'robot.{name}': value for name, value in values.items()}
    return {'joints': tuple(found.joints), **parameters}


def _rounded(values: Floats) -> tuple[float, ...]:
    return tuple(float(f'{value:.{_DIGITS}g}') for value in values)

# SPDX-License-Identifier: Apache-2.0
"""The parameters of runs with soft gains: of motions, of moves between them, and of a proof."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import BESIDE
from blf_dsc_controller.arms.tuning import gains_of
from blf_dsc_controller.commissioning.motion import Excitation
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.factory.gains import law_gains

Floats = NDArray[np.float64]

_WIDE_BOUND = 0.1  # rad, bound of the errors


def shaking_parameters(
    config: ControllerConfig, excitation: Excitation, posture: Floats
) -> dict[str, object]:
    """Return the parameters that hold an arm by its own gains and excite it.

    The law learns nothing, so that it is the same at the end as at the beginning.  Torques limit
    the motion, not accelerations: those of fast tones are high, but hardly move a light wrist.
    """
    limit = np.maximum(config.limits.acceleration, excitation.acceleration)
    return (
        undisturbed_parameters(config)
        | excitation.reference(posture)
        | {
            'learning.enabled': False,
            'limits.acceleration': limit.tolist(),
            'safety.oscillation': 'warn',  # up to a fifth of a limit tones look alike
        }
    )


def undisturbed_parameters(config: ControllerConfig) -> dict[str, object]:
    """Return the parameters of a run with soft gains that goes on as planned, or stops.

    The bounds are wide, loads are not declared, and a contact stops an arm that would react to it.
    The integral is slow, since coarse encoders make a quick one swing.
    """
    wide = np.maximum(law_gains(config).initial_bound, _WIDE_BOUND)
    values: dict[str, object] = {
        'barrier.bound': wide.tolist(),
        'safety.oscillation': 'stop',
        'disturbance.gain': _slow_integral(config).tolist(),
    }
    if config.barrier.bounds_tool:
        values |= {'barrier.tool_bound': 0.0, 'barrier.tool_angle_bound': 0.0}
    if config.load.tell_drive:
        values |= {'load.tell_drive': False, 'load.service': ''}
    if config.contact.reaction != 'none':
        values['contact.reaction'] = 'stop'
    return values


def _slow_integral(config: ControllerConfig) -> Floats:
    """Return gamma (n,) [N m/rad] as beside another integral, or less if it is less."""
    usual = np.array(config.disturbance.gain)
    arm, _ = design_of(config)
    if arm.joints is None:
        return usual
    beside = arm._replace(joints=arm.joints._replace(integral_fraction=BESIDE))
    slow = np.array(gains_of(beside).integral)
    return np.asarray(np.minimum(usual, slow))

# SPDX-License-Identifier: Apache-2.0
"""How strongly an arm is shaken: as little as shows its margin through the noise.

Noise is counted against the modulus margin, and falls as the torque of the motion grows.  A
first, weak motion shows how much it takes; where that is much, the posture is measured again
with the torque that makes it little, as far as `MOST` allows.  Where friction damps a joint
more than its gains do, it is measured again with swings that keep its joints sliding: one that
sticks shows its friction, of which a steady motion has none.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.commissioning.choice import SLOWEST, Loops
from blf_dsc_controller.commissioning.commissioning import measuring_gains
from blf_dsc_controller.commissioning.findings import rubs
from blf_dsc_controller.commissioning.motion import lines_in
from blf_dsc_controller.commissioning.response import HiddenError, response_of
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.run import Run

MOST = 4.0
"""Times the torque of the first motion, at most."""

LITTLE = 0.1
"""Of the modulus margin, that noise may take."""


def strength(run: Run, config: ControllerConfig) -> float:
    """Return the factor, from 1 to `MOST`, on the torque of a motion that hides little.

    Raises BlfDscError if it is no whole run of the motion.
    """
    try:
        response = response_of(run, lines_in(config), config.sample_time)
    except HiddenError:
        return MOST
    arm, _ = design_of(config)
    P = arm.parameters.of(arm.chain.inertias, arm.rotors)
    (M,) = inertia_matrices(arm.parameters.model, P, response.posture[None])
    loops = Loops((response,), np.diagonal(M), config.sample_time)
    ((value, doubt),) = loops.singular_values(measuring_gains(arm))
    counted = response.seen & (response.frequency >= SLOWEST)
    taken = value[counted].min() - (value - doubt)[counted].min()
    return float(np.clip(taken / LITTLE, 1.0, MOST))


def rubs_in(run: Run, config: ControllerConfig) -> bool:
    """Whether friction damps a joint more than its gains do in a run of a motion.

    Raises BlfDscError if it is no whole run of the motion.
    """
    try:
        response = response_of(run, lines_in(config), config.sample_time)
    except HiddenError:
        return False
    arm, _ = design_of(config)
    return rubs(response, measuring_gains(arm).damping)

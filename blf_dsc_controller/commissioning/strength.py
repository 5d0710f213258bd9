# SPDX-License-Identifier: Apache-2.0
"""The torque of the motion: the least that shows the modulus margin through the noise.

Noise is counted against the modulus margin, and falls as the torque of the motion grows.  A
first, weak motion shows how much it takes; where that is much, the posture is measured again
with the torque that makes it little, as far as `MOST` allows.  Where friction damps a joint
more than its gains do, it is measured again with swings that keep its joints sliding.  A joint
that sticks shows damping by friction that a steady motion does not have.

An arm that oscillates with the gains of its measurement stops before it does so with a quarter of
its torque limits (`safety.oscillation: warn`).  One that nearly oscillates makes noise that no
torque overcomes, and the controller reports an oscillation.  Either is measured again with half of
these gains, as often as needed: its response does not depend on them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.commissioning.findings import rubs
from blf_dsc_controller.commissioning.margin import BARELY, Loops
from blf_dsc_controller.commissioning.motion import lines_in
from blf_dsc_controller.commissioning.planned import measuring_gains
from blf_dsc_controller.commissioning.response import HiddenError, response_of
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.run import Run

MOST = 4.0
"""Times the torque of the first motion, at most."""

LITTLE = 0.1
"""Of the modulus margin, that noise may take."""


class Shown(NamedTuple):
    """What a run of a motion shows through noise and friction."""

    factor: float  # from 1 to `MOST`, on the torque of a motion that hides little
    rubs: bool  # friction damps a joint more than its gains do
    rings: bool  # noise hides much, and the arm oscillates with these gains, or nearly


def shown_by(run: Run, config: ControllerConfig) -> Shown:
    """Return what a run of a motion shows.

    Raises BlfDscError if it is no whole run of the motion.
    """
    try:
        response = response_of(run, lines_in(config), config.sample_time)
    except HiddenError:
        return Shown(MOST, rubs=False, rings=False)
    arm, _ = design_of(config)
    P = arm.parameters.of(arm.chain.inertias, arm.rotors)
    (M,) = inertia_matrices(arm.parameters.model, P, response.posture[None])
    gains = measuring_gains(config)
    loops = Loops((response,), np.diagonal(M), config.sample_time)
    clean = loops.margin(gains, noise=False).value
    taken = clean - loops.margin(gains).value
    return Shown(
        factor=float(np.clip(taken / LITTLE, 1.0, MOST)),
        rubs=rubs(response, gains.damping),
        rings=bool(run.oscillations) and taken > LITTLE and clean < BARELY,
    )

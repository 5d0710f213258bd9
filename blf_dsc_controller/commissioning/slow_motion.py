# SPDX-License-Identifier: Apache-2.0
"""A slow motion that does not repeat: in its torques `blf_dsc identify` finds torque ripple.

A ripple returns at the same positions.  Where a motion repeats, so does whatever friction, drives
and model err by, and each N of a ripple fits some of it: of random FR3s without ripple, most show
some in 15 s of a motion of 5 s.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig

SECONDS = 60.0
"""Time [s] in which such a motion shows the ripple of most joints."""

_PACE = 0.5  # of the tones
_APART = 0.3  # by which the pace of tones differs at most
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)  # whose multiples have no period


def slow_frequencies(config: ControllerConfig) -> tuple[float, ...]:
    """Return `reference.frequency` [rad/s] of half the pace, of tones with no period.

    Positions keep the range of the reference, but joints meet at others; velocities are 0.65
    times those of the tones, at most.  Empty, unless the reference is a sum of sinusoids.
    """
    if config.reference.type != 'sinusoids':
        return ()
    rates = np.array(config.reference.frequency)
    pace = _PACE * (1.0 + _APART * (_GOLDEN * np.arange(rates.size) % 1.0))
    return tuple(float(f'{rate:.3g}') for rate in pace * rates)

# SPDX-License-Identifier: Apache-2.0
"""Stability margins of the gains derived from a URDF, for each joint alone, linearised."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.arm_comparison.contenders import joint_inertia
from blf_dsc_controller.configuration.params_file import load_loop

OMEGA = np.logspace(0.0, 3.3, 20_000)  # rad/s
POLE, DRIVE = 400.0, 0.002  # pole of the velocity filter, rad/s; time constant of the drive, s


def margins(preset, joint, slope):
    """Phase margin [degrees] and upward gain margin of a joint where the barrier has this slope."""
    loop = load_loop(preset)
    law, T = loop.controller, loop.controller.sample_time
    m = joint_inertia(law)[joint]
    s = 1j * OMEGA
    k = law.surface.gain[joint] / 2.0 + law.surface.mu[joint]
    surface_filter = 1.0 / (1.0 + law.surface.time_constant * s)  # equation (13)
    xi2 = s / (1.0 + s / POLE) + k * surface_filter
    damping = law.feedback.damping_rate + law.disturbance.gain[joint] / m / s
    delay = np.exp(-1.5 * T * s) / (1.0 + DRIVE * s)
    L = delay * (damping * xi2 + k * s * surface_filter + slope / m) / s**2
    crossing = np.flatnonzero(np.abs(L) >= 1.0)[-1]
    phase = np.degrees(np.unwrap(np.angle(-L)))
    phase -= 360.0 * np.round(phase[crossing] / 360.0)
    phase_crossing = np.flatnonzero((phase[:-1] > 0.0) & (phase[1:] <= 0.0))[-1]
    return phase[crossing], 1.0 / np.abs(L[phase_crossing])


@pytest.mark.parametrize(('preset', 'joints'), [('panda', 7), ('ur5e', 6)])
def test_every_joint_has_stability_margins_with_default_gains(preset, joints):
    barrier = load_loop(preset).controller.barrier
    for joint in range(joints):
        phase, gain = margins(preset, joint, barrier.weight[joint])
        assert phase > 15.0
        assert gain > 1.7
        phase, gain = margins(preset, joint, barrier.slope_limit[joint])
        assert phase > 5.0
        assert gain > 1.3

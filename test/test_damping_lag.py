# SPDX-License-Identifier: Apache-2.0
"""Damping that lags (`feedback.joint_damping_lag`): in the law, and on elastic arms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import blf_dsc_controller as blf
from benchmark import random_arms
from blf_dsc_controller.arms.linear_loop import law_responses
from blf_dsc_controller.warnings.expected_errors import linear_feedback

T = 0.001  # s
LATE = 100.0  # s, when bounds have narrowed
LAG = {'feedback.joint_damping_lag': [0.003] * 6}
HELD = {
    'reference.type': 'hold',
    'learning.enabled': False,
}
SHAKEN = 3  # the joint


@pytest.fixture
def config():
    """Return a UR5e at rest that learns nothing and whose damping lags."""
    return blf.change(blf.load_loop('ur5e').controller, HELD | LAG)


def amplitude(values, s):
    """Return the complex amplitude of e^(s t) in values (k,), beside a drift."""
    t = T * np.arange(len(values))
    wave = np.exp(s * t)
    columns = np.column_stack((wave.real, -wave.imag, np.ones_like(t), t))
    found = np.linalg.lstsq(columns, values, rcond=None)[0]
    return complex(found[0], found[1])


def of_joints(*lags):
    """Return the parameter of lags of joints [s]."""
    return {'feedback.joint_damping_lag': list(lags)}


@pytest.mark.parametrize('hertz', [8.0, 25.0, 40.0])
@pytest.mark.parametrize('of_velocity', [False, True])
@pytest.mark.parametrize(
    'lags',
    [
        {},
        of_joints(0.0, 0.0, 0.0, 0.005, 0.0, 0.0),
        of_joints(0.005, 0.005, 0.005, 0.0, 0.0, 0.0),
    ],
)
def test_the_law_has_the_frequency_response_of_its_linear_form(
    config, hertz, of_velocity, lags
):
    """One joint of the compiled law is shaken by 1 urad, or by 1 mrad/s."""
    config = blf.change(config, lags)
    law = blf.controller_of(config)
    qr, n = np.array(config.reference.offset), 6
    s = 2j * np.pi * hertz
    size = 1e-3 if of_velocity else 1e-6
    torques = []
    for k in range(1000):
        measurement = np.concatenate((qr, np.zeros(2 * n)))
        measurement[n * of_velocity + SHAKEN] += size * np.exp(s * k * T).real
        law.update(LATE + k * T, T, measurement)
        feedback = law.signals.demand - law.signals.model_torque
        torques.append(feedback[SHAKEN])
    settings = law.settings
    form = linear_feedback(settings, np.eye(n)[None], settings.barrier.weight)
    C = law_responses(form, T, np.array([s]))[of_velocity][0, 0]
    found = amplitude(np.array(torques[500:]), s) * np.exp(-s * 500 * T)
    assert found / size == pytest.approx(-C[SHAKEN, SHAKEN], rel=1e-5)


@pytest.mark.parametrize(('given', 'reports'), [({}, True), (LAG, False)])
def test_an_arm_that_oscillates_with_the_published_gains_is_calm(given, reports):
    """Arm 442 of the study; it stops 1.6 s after the pick-up, at 26 Hz."""
    study = random_arms.study_of('ur5e')
    plant = replace(random_arms.arm_of(study, 442), duration=7.8)
    record = blf.simulate(blf.change(study.controller, given), plant)
    assert bool(record.run().stops) == reports

# SPDX-License-Identifier: Apache-2.0
"""Damping that lags (`feedback.joint_damping_lag`): in the law, and on elastic arms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmark import random_arms
from blf_dsc_controller.arms.linear_loop import law_responses
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.supervision.expected_errors import linear_feedback
from blf_dsc_controller.supervision.retuning import apply_bumpless

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
    return change(load_loop('ur5e').controller, HELD | LAG)


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
    config = change(config, lags)
    law = controller_of(config)
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


def test_joints_have_the_torques_of_laws_that_have_their_lag_at_all_joints(config):
    """Bit for bit, for a motion in which all joints move."""
    rng = np.random.default_rng(1)
    measured = np.concatenate((config.reference.offset, np.zeros(12)))
    moved = measured + 1e-4 * rng.standard_normal((200, 18))

    def torques(lags):
        law = controller_of(change(config, lags))
        return np.array(
            [law.update(LATE + k * T, T, row).copy() for k, row in enumerate(moved)]
        )

    some = torques(of_joints(0.003, 0.0, 0.005, 0.0, 0.0, 0.003))
    for lag, joints in ((0.003, [0, 5]), (0.0, [1, 3, 4]), (0.005, [2])):
        alike = torques({'feedback.joint_damping_lag': [lag] * 6})
        np.testing.assert_array_equal(some[:, joints], alike[:, joints])
        others = np.delete(np.arange(6), joints)
        assert (some[1:, others] != alike[1:, others]).any(axis=0).all()
    same = torques(of_joints(*(0.003,) * 6))
    np.testing.assert_array_equal(
        same, torques({'feedback.joint_damping_lag': [0.003] * 6})
    )


def test_the_lag_begins_anew_with_the_first_sample_of_a_start(config):
    """A reset, or a law that takes over again, damps what it finds."""
    law = controller_of(config)
    qr = np.array(config.reference.offset)
    rest, moving = np.zeros(12), np.concatenate((np.full(6, 0.1), np.zeros(6)))
    first = law.update(0.0, T, np.concatenate((qr, moving))).copy()
    for k in range(1, 5):
        law.update(k * T, T, np.concatenate((qr, rest)))
    assert np.abs(law.state.feedback.late).min() > 0.01  # still late
    law.reset()
    again = law.update(0.0, T, np.concatenate((qr, moving)))
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(law.state.feedback.late, law.signals.xi2)
    law.update(T, T, np.concatenate((qr, rest)))
    assert np.abs(law.state.feedback.late - law.signals.xi2).min() > 0.01
    law.state.samples[0] = 0.0  # as `Takeover.rejoin` does
    law.update(2 * T, T, np.concatenate((qr, rest)))
    np.testing.assert_array_equal(law.state.feedback.late, law.signals.xi2)


def test_gains_that_change_leave_no_part_of_a_jump_behind(config):
    """xi2 jumps with the rate of the surface; its lag is to follow at once."""
    law = controller_of(config)
    qr = np.array(config.reference.offset)
    off = np.concatenate((qr + 2e-3, np.zeros(12)))
    for k in range(200):
        law.update(k * T, T, off)
    before = law.signals.xi2.copy()
    wider = [1.2 * each for each in config.barrier.bound]
    apply_bumpless(law, change(config, {'barrier.bound': wider}), 0.199, off)
    law.update(0.2, T, off)
    assert np.abs(law.signals.xi2 - before).min() > 1e-3
    np.testing.assert_allclose(law.state.feedback.late, law.signals.xi2, atol=1e-5)


@pytest.mark.parametrize(('given', 'reports'), [({}, True), (LAG, False)])
def test_an_arm_that_oscillates_with_the_published_gains_is_calm(given, reports):
    """Arm 442 of the study; it stops 1.6 s after the pick-up, at 26 Hz."""
    study = random_arms.study_of('ur5e')
    plant = replace(random_arms.arm_of(study, 442), duration=7.8)
    record = simulate(change(study.controller, given), plant)
    assert bool(record.run().stops) == reports

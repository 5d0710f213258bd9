# SPDX-License-Identifier: Apache-2.0
"""Actuators: delay by whole samples, torque limit, lag and noise, and the reported effort."""

import numpy as np
import pytest
from plants import START, commands, plant, run

SAMPLES = 40


@pytest.mark.parametrize('delay', [0, 1, 3, SAMPLES + 1])
def test_command_is_applied_exactly_delay_samples_later(delay):
    torques = commands(SAMPLES)
    late, prompt = plant(delay=delay), plant()
    shifted = np.vstack([np.zeros((delay, 2)), torques])[:SAMPLES]
    assert (run(late, torques) == run(prompt, shifted)).all()
    assert (late.truth() == prompt.truth()).all()


@pytest.mark.parametrize('delay', [0, 2])
def test_effort_is_the_torque_of_the_last_interval(delay):
    torques = commands(SAMPLES)
    effort = run(plant(delay=delay), torques)[:, 4:]
    assert (effort[: delay + 1] == 0).all()
    assert (effort[delay + 1 :] == torques[: SAMPLES - delay - 1]).all()


@pytest.mark.parametrize('delay', [0, 2])
def test_torque_beyond_the_limit_of_its_joint_is_cut(delay):
    torques, limit = commands(SAMPLES), np.array([5.0, 1.5])
    cut = np.clip(torques, -limit, limit)
    assert (cut != torques).any(axis=0).all()
    limited = run(plant(delay=delay, torque_limit=limit), torques)
    assert (limited == run(plant(delay=delay), cut)).all()


def test_zero_torque_limit_means_no_limit():
    torques = 1e3 * commands(3)
    effort = run(plant(torque_limit=(0.0, 7.0)), torques)[1:, 4:]
    assert (effort[:, 0] == torques[:-1, 0]).all()
    assert (np.abs(effort[:, 1]) == 7.0).all()


def test_lagging_drive_has_a_first_order_step_response():
    """The lag follows the limit; a sample reports the mean torque of its interval."""
    tau, step = 2e-3, np.array([4.0, -9.0])
    effort = run(plant(time_constant=tau, torque_limit=(0.0, 6.0)), np.tile(step, (20, 1)))[1:, 4:]
    t = 1e-3 * np.arange(20)
    mean = np.diff(t + tau * np.exp(-t / tau)) / 1e-3
    np.testing.assert_allclose(effort, mean[:, None] * [4.0, -6.0], rtol=1e-12)


def test_drive_noise_is_proportional_to_the_torque_and_repeatable():
    torques = np.tile([5.0, -2.0], (4000, 1))
    effort = run(plant(torque_noise=0.01, seed=4), torques)
    error = effort[1:, 4:] / torques[1:] - 1.0
    np.testing.assert_allclose(error.std(axis=0), 0.01, rtol=0.05)
    assert abs(np.corrcoef(error.T)[0, 1]) < 0.07
    np.testing.assert_array_equal(effort, run(plant(torque_noise=0.01, seed=4), torques))


def test_drive_noise_does_not_change_the_order_of_encoder_noise():
    """Both come from one generator: first the encoders, then the drives."""
    arm = plant(position_noise=1e-5, torque_noise=0.01, seed=4)
    arm.measure()
    drawn = np.random.Generator(np.random.PCG64(np.random.SeedSequence(4))).standard_normal(6)
    np.testing.assert_array_equal(arm.measure()[:2], np.array(START) + 1e-5 * drawn[:2])
    arm.step(np.array([1.0, 2.0]))
    np.testing.assert_array_equal(arm.measure()[4:], [1.0, 2.0] * (1.0 + 0.01 * drawn[4:]))

# SPDX-License-Identifier: Apache-2.0
"""A commanded torque arrives late by whole samples and within its limit, and is reported so."""

import numpy as np
import pytest
from plants import commands, plant, run

SAMPLES = 40


@pytest.mark.parametrize('delay', [0, 1, 3, SAMPLES + 1])
def test_a_command_is_applied_exactly_delay_samples_later(delay):
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
def test_a_torque_beyond_its_joints_limit_is_cut(delay):
    torques, limit = commands(SAMPLES), np.array([5.0, 1.5])
    cut = np.clip(torques, -limit, limit)
    assert (cut != torques).any(axis=0).all()
    limited = run(plant(delay=delay, torque_limit=limit), torques)
    assert (limited == run(plant(delay=delay), cut)).all()


def test_a_limit_of_zero_is_none():
    torques = 1e3 * commands(3)
    effort = run(plant(torque_limit=(0.0, 7.0)), torques)[1:, 4:]
    assert (effort[:, 0] == torques[:-1, 0]).all()
    assert (np.abs(effort[:, 1]) == 7.0).all()

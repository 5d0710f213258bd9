# SPDX-License-Identifier: Apache-2.0
"""The damping of a stop puts no energy into a motion, by itself and on random arms."""

from __future__ import annotations

import numpy as np
import pytest

from benchmark import random_arms
from blf_dsc_controller.law.sensor import FILTER
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.supervision.dissipating import dissipating
from blf_dsc_controller.supervision.last_state import LastState

T = 1e-3  # s
LATE = 5  # samples until a torque acts and shows
RATE = 1.0 / FILTER  # 1/s, configured damping over the assumed inertia
NONE = np.zeros(1)


def braked(lighter, *, limited, seconds=1.0):
    """Return the speeds (k,) [rad/s] of a joint that a stop brakes from 1 rad/s, without `Swing`.

    Its inertia is the assumed one over `lighter`.
    """
    last = LastState(1)
    speed, q = 1.0, 0.0
    last.take(FIRST_STAMP, np.array([0.0, speed, 0.0]), np.array([speed]))
    torques = [0.0] * LATE
    seen = []
    for k in range(1, round(seconds / T)):
        q += T * speed
        measurement = np.array([q, speed, 0.0])
        last.take_usable(FIRST_STAMP + k * 10**6, measurement, 50.0, T)
        v = dissipating(last, NONE, NONE) if limited else last.slow
        torques.append(-RATE * float(v[0]))
        speed += T * lighter * torques.pop(0)
        seen.append(speed)
    return np.array(seen)


@pytest.mark.parametrize('lighter', [0.5, 1.0, 4.0])
def test_joint_gets_no_faster_and_rests(lighter):
    speeds = np.abs(braked(lighter, limited=True))
    assert speeds.max() <= 1.0
    assert speeds[-100:].max() < 0.02


@pytest.mark.parametrize('lighter', [1.0, 2.0])
def test_joint_swings_back_less_than_by_a_velocity_that_is_late(lighter):
    late, limited = (-braked(lighter, limited=each).min() for each in (False, True))
    assert limited < 0.5 * late


def test_joint_of_an_eighth_of_the_inertia_shakes_far_less_than_by_a_velocity_that_is_late():
    """By that, growing, at 78 rad/s after a second."""
    late, limited = (np.abs(braked(8.0, limited=each)).max() for each in (False, True))
    assert late > 50.0
    assert limited < 2.0


@pytest.mark.parametrize(
    ('slow', 'fast', 'noise', 'step', 'expected'),
    [
        (2.0, 3.0, 0.0, 0.0, 2.0),  # what is late is less
        (3.0, 2.0, 0.0, 0.0, 2.05),
        (-3.0, -2.0, 0.0, 0.0, -2.05),
        (3.0, -2.0, 0.0, 0.0, 0.05),  # against the motion
        (-3.0, 2.0, 0.0, 0.0, -0.05),
        (3.0, -2.0, 1e-6, 0.0, 1.0),  # three standard deviations over 3 ms
        (3.0, -2.0, 0.0, 6e-4, 0.4),  # two steps
        (3.0, -2.0, np.inf, 0.0, 3.0),  # of which nothing is known
    ],
)
def test_velocity_to_damp_is_no_more_than_the_motion(slow, fast, noise, step, expected):
    last = LastState(1)
    last.slow[:], last.fast[:] = slow, fast
    found = dissipating(last, np.array([noise]), np.array([step]))
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize(('sigma', 'step'), [(3.8e-4, 0.0), (0.0, 3.8e-4)])
def test_noise_and_steps_of_an_encoder_take_no_damping_away(sigma, step):
    """A joint that sinks at 0.1 rad/s."""
    random = np.random.default_rng(0)
    last = LastState(1)
    slow, damped = [], []
    for k in range(1000):
        q = 0.1 * k * T + random.normal(0.0, sigma)
        if step:
            q = step * np.round(q / step)
        last.take_usable(FIRST_STAMP + k * 10**6, np.array([q, 0.1, 0.0]), 50.0, T)
        slow.append(last.slow[0])
        damped.append(dissipating(last, np.array([sigma**2]), np.array([step]))[0])
    assert np.mean(damped) > 0.99 * np.mean(slow)


ARMS = {
    'UR5e': ('ur5e', 0),
    'FR3': ('fr3', 9),
}
FROM_LAW = 0.02  # s, in which what the law has sent before still acts


@pytest.mark.parametrize('arm', ARMS)
def test_stop_of_an_arm_that_nobody_foresaw_makes_no_link_faster(arm):
    """By the velocity that is late, by 1.6 times and by 1.05; at most a tenth is noise."""
    name, number = ARMS[arm]
    study = random_arms.study_of(name, 'wide')
    plant = random_arms.arm_of(study, number)
    with np.errstate(all='ignore'):
        record = simulate(study.controller, plant, after_stop=0.3)
    n = len(plant.joints)
    t = 1e-9 * record.stamps - record.stopped
    speed = np.abs(record.truths[:, -n:]).max(axis=1)
    assert speed[t > FROM_LAW].max() < 1.1 * speed[t < 0.0].max()

# SPDX-License-Identifier: Apache-2.0
"""The hold of the watchdog does not shake arms that a stop does not shake."""

from __future__ import annotations

import numpy as np
import pytest

from benchmark import random_arms
from blf_dsc_controller import load_loop
from blf_dsc_controller.configuration.files import share_folder
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.sensor_noise import SensorNoise
from blf_dsc_controller.supervision.supervisor import Phase
from blf_dsc_controller.supervision.torque_watchdog import TorqueWatchdog
from sim_plant.plant import plant_of

TIMEOUT = 0.05  # s
# s after the death of the controller, from which on the arm rests; its last torque, which
# the drives hold for 52 ms, makes a wrist of an FR3 as fast as 60 rad/s
HELD = 1.2
SLOW = 0.15  # rad/s, as after a stop
# with all of the damping each shook on by 7 to 19 rad/s
ARMS = {
    'UR5e, encoders at the motors, torque loop': ('ur5e', 0),
    'UR5e, encoders at the links, torque loop': ('ur5e', 9),
    'another UR5e': ('ur5e', 14),
    'FR3, encoders at the motors, torque loop': ('fr3', 0),
    'another FR3': ('fr3', 6),
}


def killed(study, config, late=0.0):
    """Kill the controller of an arm `late` [s] after its stop; the drives hold its last torque.

    Return the speeds (k,) [rad/s] of the fastest joint from there on, and the watchdog.
    """
    given = study.controller
    guard, arm = Guard(given), plant_of(config)
    line = TorqueWatchdog(given, TIMEOUT)
    guard.starting.activate()
    T, n = given.sample_time, len(given.joints)
    torque, speeds, stop = np.zeros(n), [], None
    for k in range(round(2.2 / T)):
        stamp = FIRST_STAMP + k * given.sample_time_ns
        measurement = arm.measure().copy()
        if stop is None or k < stop + round(late / T):
            torque = guard.update(stamp, measurement).copy()
            guard.perceive()
            line.take_torque(torque, k * T)
            if stop is None and guard.supervisor.phase is Phase.SAFE_STOP:
                stop = k
        else:
            speeds.append(np.abs(arm.truth()[-n:]).max())
        line.take_state(stamp, measurement, k * T)
        taken = line.poll(k * T)
        arm.step(torque if taken is None else taken)
        if len(speeds) * T > 1.5:
            break
    return np.array(speeds), line


@pytest.mark.parametrize('arm', ARMS)
def test_arm_that_nobody_foresaw_comes_to_rest_when_its_controller_dies(arm):
    name, number = ARMS[arm]
    study = random_arms.study_of(name, 'wide')
    with np.errstate(all='ignore'):
        speeds, line = killed(study, random_arms.arm_of(study, number))
    assert line.takeovers == 1
    assert speeds[round(HELD / study.controller.sample_time) :].max() < SLOW


def test_controller_that_dies_while_its_stop_takes_the_damping_down_changes_nothing():
    study = random_arms.study_of('ur5e', 'wide')
    with np.errstate(all='ignore'):
        speeds, line = killed(study, random_arms.arm_of(study, 0), late=0.1)
    assert line.takeovers == 1
    assert speeds[round(HELD / study.controller.sample_time) :].max() < SLOW


def test_watchdog_names_each_joint_that_swings_once_in_a_takeover():
    study = random_arms.study_of('fr3', 'wide')
    with np.errstate(all='ignore'):
        _, line = killed(study, random_arms.arm_of(study, 0))
    text = line.name_swings()
    assert text.startswith("joint 'fr3_joint7' swings under the damping of the stop")
    assert line.name_swings() == ''


def held(sigma, frequency=0.0, amplitude=0.0):
    """Return a watchdog that has seen the states of an arm for 1 s, 0.6 s without a torque.

    `sigma` [rad] is the noise of its positions, which swing by `amplitude` [rad].
    """
    config = load_loop(share_folder() / 'config' / 'fr3.yaml').controller
    n = len(config.joints)
    line = TorqueWatchdog(config, TIMEOUT)
    random = np.random.default_rng(0)
    T = config.sample_time
    for k in range(round(1.0 / T)):
        q = random.normal(0.0, sigma, n)
        q += amplitude * np.sin(2.0 * np.pi * frequency * k * T)
        stamp = FIRST_STAMP + k * config.sample_time_ns
        line.take_state(stamp, np.concatenate((q, np.full(2 * n, np.nan))), k * T)
        if k * T < 0.4:
            line.take_torque(np.zeros(n), k * T)
        line.poll(k * T)
    assert line.active
    return line


def test_noise_of_an_encoder_passes_for_no_swing_and_a_swing_is_one():
    """Of an arm that measures no velocities; the noise is a hundred times that of 20 bits."""
    assert held(sigma=3.8e-4).name_swings() == ''
    assert 'joint7' in held(sigma=1e-5, frequency=25.0, amplitude=2e-3).name_swings()


def test_noise_of_positions_is_measured_without_those_that_are_missing_or_repeated():
    random = np.random.default_rng(0)
    kept, whole = SensorNoise(2), SensorNoise(2)
    for k in range(3000):
        q = random.normal(0.0, 1e-3, 2)
        for each in (kept, whole):
            each.take(q, 1e-3, 1e-3)
        if k % 7 == 0:
            kept.take(q, 0.0, 1e-3)
            kept.take(np.array([0.5, np.nan]), 1e-3, 1e-3)
    np.testing.assert_array_equal(kept.noise, whole.noise)
    np.testing.assert_allclose(kept.noise, 1e-6, rtol=0.3)  # over 0.5 s
    kept.take(np.ones(2), 0.5, 1e-3)  # after a gap, whose motion is no noise
    np.testing.assert_array_equal(kept.noise, whole.noise)

# SPDX-License-Identifier: Apache-2.0
"""Velocities that are plausible but not those of the positions stop the arm, which then rests."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from fault_table import MILLISECOND, Rig
from nights import at_night
from scenario import Scenario, changed

import blf_dsc_controller as blf

STUCK = changed(1, dq=lambda _: 0.0)
REVERSED = changed(1, dq=lambda dq: -dq)
ALL_REVERSED = changed(dq=lambda dq: -dq)


@pytest.mark.parametrize(
    ('spoil', 'at', 'travel'),
    [
        (STUCK, 0.0, 0.25),
        (REVERSED, 2.0, 0.5),
        *at_night((STUCK, 2.0, 0.5), (REVERSED, 0.0, 0.25)),
    ],
)
def test_fr3_with_a_wrong_velocity_of_joint_2_comes_to_rest(spoil, at, travel):
    """Damped by those velocities, it moved by 7 to 13 rad in the safe stop, at up to 11 rad/s."""
    arm = Scenario('fr3')
    if at > 0.0:
        arm.run(at)
    before = arm.run(8.0, spoil=spoil, until=lambda: not arm.is_running)
    after = arm.run(3.0, spoil=spoil)
    assert "the velocity of joint 'fr3_joint2' is" in arm.text
    assert 'its positions change by' in arm.text
    assert 'a sensor is stuck' in arm.text
    assert np.abs(after.q - before.q[-1]).max() < travel
    assert after.speed[-1].max() < 0.02


def late_velocities(samples):
    """Deliver velocities so many samples later, with the positions of their time."""
    held = []

    def spoil(state):
        held.append(state.dq)
        return [replace(state, dq=held.pop(0) if len(held) > samples else held[0])]

    return spoil


@pytest.mark.parametrize('late', [4, 8])
def test_late_velocities_are_named_with_their_milliseconds(late):
    """Beside those of the filter of the preset, 2.5 ms; it was a stuck sensor, or high gains."""
    arm = Scenario('panda')
    arm.run(4.0, spoil=late_velocities(late), until=lambda: not arm.is_running)
    assert 'robot.lag' in arm.text
    (told,) = re.findall(r'velocities come about (\S+) ms after', arm.text)
    assert float(told) == pytest.approx(late + 2.5, abs=0.5)


def test_velocities_that_are_always_0_name_the_remedy_also_of_an_arm_in_motion():
    """Of a driver that sends zeros from the start; one that sends others has a fault."""
    texts = []
    for factor in (0.0, -1.0):
        arm = Scenario('recommended')
        arm.run(0.5, spoil=changed(dq=lambda dq, by=factor: by * dq))
        assert 'its positions change by' in arm.text
        texts.append(arm.text)
    remedy = 'set safety.velocity to estimated'
    assert [remedy in text for text in texts] == [True, False]


def test_velocities_are_those_of_the_positions_after_the_stop_and_a_reset():
    arm = Scenario('recommended', {'safety.torque': 'hold_gravity'})
    arm.run(0.2)
    arm.run(0.3, spoil=ALL_REVERSED)
    assert arm.reason == 'velocity not plausible'
    arm.controller.reset()
    arm.run(4.0, spoil=ALL_REVERSED)  # an approach, too
    assert arm.controller.phase is blf.Phase.TRACKING


@pytest.mark.parametrize('entry', [None, 0, 2])  # a position, a velocity
def test_wrong_velocity_is_found_before_the_start(entry):
    """In motion, by the states that are held back until the rate is known.

    A value that is not finite stays out of the averages, in which it would stay for ever.
    """
    rig = Rig()
    for k in range(60):
        q = np.full(2, 1.0 + 5e-4 * k)  # 0.5 rad/s
        measurement = np.array([*q, 0.0, 0.5, 0.0, 0.0])  # joint 1 is wrong
        if k == 5 and entry is not None:
            measurement[entry] = np.nan
        rig.guard.observe(rig.base + k * MILLISECOND, measurement)
    assert str(rig.supervisor.reason) == 'velocity not plausible'
    assert not rig.guard.commanding
    remedy = 'if the hardware measures none, set safety.velocity to estimated'
    assert remedy in rig.supervisor.text


@pytest.mark.parametrize('preset', ['recommended', 'noisy', 'panda', 'ur5e_driver'])
def test_noise_lag_and_steps_of_sensors_contradict_nothing(preset):
    """Filtered and differenced velocities, quantised positions, all that the presets have."""
    coarse = {
        'sensor.resolution': 1e-4,
        'sensor.position_noise': 1e-5,
        'sensor.velocity_noise': 0.02,
    }
    arm = Scenario(preset, {'safety.error_ratio': 0.0}, plant=coarse)
    arm.run(2000 * arm.T)
    assert 'velocity' not in arm.text


GAPS = {
    'one in ten of 30 ms': lambda draw: 30 if draw.random() < 0.1 else 1,
    'half of 2 to 5 ms': lambda draw: draw.integers(1, 6),
    'up to 90 ms': lambda draw: draw.choice([1, 1, 1, 1, 20, 90]),
}


def moving(frequency, gaps, factor):
    """Return whether velocities of an arm that swings by hand are found to be wrong.

    It is not in command; its states come after gaps [ms], with a factor on the velocities.
    """
    arm = Scenario('recommended')
    arm.controller.stop()
    draw = np.random.default_rng(1)
    t = 0.0
    for _ in range(3000):
        t += 1e-3 * GAPS[gaps](draw)
        phase = 2.0 * np.pi * frequency * t
        q = 0.2 * np.sin(phase) / (2.0 * np.pi * frequency) if frequency else 0.2 * t
        dq = factor * 0.2 * np.cos(phase)
        arm.controller.update(1.0 + t, np.full(2, q), np.full(2, dq))
    return 'its positions change by' in arm.text


@pytest.mark.parametrize('frequency', [0.0, 0.5, 10.0])
@pytest.mark.parametrize('gaps', GAPS)
def test_states_that_are_lost_contradict_nothing(gaps, frequency):
    """The arm is healthy: at constant velocity, swinging, or shaken by the lost states."""
    assert not moving(frequency, gaps, 1.0)


@pytest.mark.parametrize('factor', [0.0, -1.0])
def test_wrong_velocity_is_found_although_states_are_lost(factor):
    assert moving(0.3, 'one in ten of 30 ms', factor)

# SPDX-License-Identifier: Apache-2.0
"""Velocities that are plausible but not those of the positions stop the arm, which then rests."""

from __future__ import annotations

import numpy as np
import pytest
from fault_table import MILLISECOND, Rig
from plants import rigid_gears
from test_supervision_effect import stopped_by

from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.supervision.supervisor import Phase, Reason


def stuck(_, dq):
    dq[1] = 0.0


def reversed_sign(_, dq):
    dq[1] *= -1.0


@pytest.mark.parametrize(
    ('spoil', 'at', 'travel'),
    [
        (stuck, 0.0, 0.25),
        (stuck, 2.0, 0.5),
        (reversed_sign, 0.0, 0.25),
        (reversed_sign, 2.0, 0.5),
    ],
)
def test_fr3_with_a_wrong_velocity_of_joint_2_comes_to_rest(spoil, at, travel):
    """Damped by those velocities, it moved by 7 to 13 rad in the safe stop, at up to 11 rad/s."""
    loop = load_loop('fr3')
    plant = change(loop.plant, {'duration': 0.0})
    guard, q, dq, _, stop = stopped_by(loop.controller, plant, spoil, at=at)
    assert "the velocity of joint 'fr3_joint2' is" in guard.supervisor.text
    assert 'its positions change by' in guard.supervisor.text
    assert np.abs(q[stop:] - q[stop]).max() < travel
    assert np.abs(dq[-1]).max() < 0.02


def test_wrist_does_not_drift_after_its_wrong_velocity_has_broken_the_bound():
    """It went on at 0.36 rad/s: by 0.16 N m of a disturbance that was none."""
    loop = load_loop('fr3', rigid_gears(7, 0.01))
    plant = change(loop.plant, {'duration': 0.0})

    def spoil(_, dq):
        dq[6] *= -1.0

    guard, q, dq, _, stop = stopped_by(loop.controller, plant, spoil, at=5.0)
    assert guard.supervisor.reason is Reason.OUTSIDE_BOUND
    assert "the velocity of joint 'fr3_joint7' is" in guard.supervisor.text
    assert np.abs(q[stop:] - q[stop]).max() < 0.4
    assert np.abs(dq[-1]).max() < 0.02


def test_velocities_that_are_always_0_name_the_remedy_also_of_an_arm_in_motion():
    """Of a driver that sends zeros from the start; one that sends others has a fault."""
    texts = []
    for factor in (0.0, -1.0):
        rig = Rig()
        rig.sense = lambda state, by=factor: [state.raw(dq=by * state.dq)]
        rig.step(500)
        assert 'its positions change by' in rig.supervisor.text
        texts.append(rig.supervisor.text)
    remedy = 'set safety.velocity to estimated'
    assert [remedy in text for text in texts] == [True, False]


def test_velocities_are_those_of_the_positions_after_the_stop_and_a_reset():
    rig = Rig({'safety.torque': 'hold_gravity'})
    rig.step(200)
    rig.sense = lambda state: [state.raw(dq=-state.dq)]
    rig.step(300)
    assert rig.supervisor.reason is Reason.VELOCITY
    rig.clear_fault()
    rig.sense = lambda state: [state.raw(dq=-state.dq)]
    rig.step(500)
    assert rig.supervisor.phase is Phase.TRACKING


def test_wrong_velocity_does_not_decide_how_much_the_safe_torque_damps():
    """What it showed of the rotors is forgotten with it: D is for the inertia of before."""
    rig = Rig({'safety.torque': 'damping'})
    rig.step(200)
    rig.guard.fail('a test')
    scale = rig.guard.safe_torque.scale
    before = scale.copy()
    scale[:] = 0.1
    rig.sense = lambda state: [state.raw(dq=-state.dq)]
    rig.step(300)
    assert 'its positions change by' in rig.supervisor.text
    np.testing.assert_array_equal(scale, before)


def test_wrong_velocity_is_found_before_the_start():
    """In motion, by the states that are held back until the rate is known."""
    rig = Rig()
    n = 2
    for k in range(30):
        q = np.full(n, 1.0 + 5e-4 * k)  # 0.5 rad/s
        measurement = np.concatenate((q, np.zeros(2 * n)))
        rig.guard.observe(rig.base + k * MILLISECOND, measurement)
    assert rig.supervisor.reason is Reason.VELOCITY
    assert not rig.guard.commanding
    remedy = 'if the hardware measures none, set safety.velocity to estimated'
    assert remedy in rig.supervisor.text


@pytest.mark.parametrize('entry', [0, 2])  # a position, a velocity
def test_wrong_velocity_is_found_although_a_state_lacks_a_value(entry):
    """One that is not finite stays out of the averages, in which it would stay for ever."""
    rig = Rig()
    for k in range(60):
        q = np.full(2, 1.0 + 5e-4 * k)  # 0.5 rad/s
        measurement = np.array([*q, 0.0, 0.5, 0.0, 0.0])  # joint 1 is wrong
        if k == 5:
            measurement[entry] = np.nan
        rig.guard.observe(rig.base + k * MILLISECOND, measurement)
    assert rig.supervisor.reason is Reason.VELOCITY


@pytest.mark.parametrize('preset', ['recommended', 'noisy', 'panda', 'ur5e_driver'])
def test_noise_lag_and_steps_of_sensors_contradict_nothing(preset):
    """Filtered and differenced velocities, quantised positions, all that the presets have."""
    loop = load_loop(preset)
    T = loop.controller.sample_time
    coarse = {
        'sensor.resolution': 1e-4,
        'sensor.position_noise': 1e-5,
        'sensor.velocity_noise': 0.02,
    }

    record = simulate(
        change(loop.controller, {'safety.error_ratio': 0.0}),
        change(loop.plant, coarse | {'duration': 2000 * T}),
    )
    assert all(stop.reason != 'velocity not plausible' for stop in record.run().stops)


def test_change_to_velocities_of_the_positions_is_no_acceleration():
    """Which would pass for a load of 0.03 of the torque limit."""
    guard = Rig({'safety.torque': 'hold_gravity', 'safety.error_ratio': 0.0}).guard
    moving = np.array([0.3, -0.2])
    for k in range(200):
        q = 1.0 + 1e-3 * k * moving
        measurement = np.concatenate((q, -moving, np.zeros(2)))
        guard.update(1_000_000_000 + k * MILLISECOND, measurement)
        if guard.supervisor.reason is Reason.VELOCITY:
            break
    assert guard.supervisor.reason is Reason.VELOCITY
    last = guard.safe_torque.last
    np.testing.assert_allclose(last.dq, moving, rtol=1e-6)
    np.testing.assert_allclose(last.ddq, 0.0, atol=1e-6)


GAPS = {
    'one in ten of 30 ms': lambda random: 0.030 if random.random() < 0.1 else 0.001,
    'half of 2 to 5 ms': lambda random: 1e-3 * random.integers(1, 6),
    'up to 90 ms': lambda random: 1e-3 * random.choice([1, 1, 1, 1, 20, 90]),
}


@pytest.mark.parametrize('frequency', [0.0, 0.5, 10.0])
@pytest.mark.parametrize('gaps', GAPS)
def test_states_that_are_lost_contradict_nothing(gaps, frequency):
    """The arm is healthy: at constant velocity, swinging, or shaken by the lost states."""
    controller = controller_of(load_loop('recommended').controller)
    random = np.random.default_rng(1)
    t = 0.0
    for _ in range(3000):
        dt = GAPS[gaps](random)
        t += dt
        phase = 2.0 * np.pi * frequency * t
        q = 0.2 * np.sin(phase) / (2.0 * np.pi * frequency) if frequency else 0.2 * t
        measurement = np.repeat([q, 0.2 * np.cos(phase), 0.0], 2)
        assert not controller.compare_velocities(dt, measurement), t


@pytest.mark.parametrize('factor', [0.0, -1.0])
def test_wrong_velocity_is_found_although_states_are_lost(factor):
    controller = controller_of(load_loop('recommended').controller)
    random = np.random.default_rng(1)
    t = 0.0
    found = []
    while t < 1.0 and not any(found):
        dt = GAPS['one in ten of 30 ms'](random)
        t += dt
        q = 0.2 * np.sin(2.0 * t) / 2.0
        measurement = np.repeat([q, factor * 0.2 * np.cos(2.0 * t), 0.0], 2)
        found.append(controller.compare_velocities(dt, measurement))
    assert t < 0.5

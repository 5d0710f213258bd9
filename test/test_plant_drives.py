# SPDX-License-Identifier: Apache-2.0
"""The simulated plant as drivers of real arms behave: compensation, reflex stop, odd states."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from random_arm import CONFIG

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.law.telemetry import PlantTelemetry
from blf_dsc_controller.messages.codecs import JointStateDecoder
from sim_plant.plant import plant_of

PANDA = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}
HELD = {'robot.drive_compensates': 'gravity'}
NO_FRICTION = {'disturbance.viscous': [0.0] * 7, 'disturbance.coulomb': [0.0] * 7}
POSITION = [0.3, -0.4, 0.5, -1.8, 0.2, 1.9, 0.7]


def panda(*given):
    merged = {**PANDA, 'initial.position': POSITION}
    for each in given:
        merged |= each
    return plant_of(build(PlantConfig, merged))


def test_drives_hold_the_arm_without_any_command():
    plant = panda(HELD, NO_FRICTION)
    q = plant.measure()[:7].copy()
    for _ in range(1000):
        plant.step(np.zeros(7))
    np.testing.assert_allclose(plant.measure()[:7], q, atol=1e-9)


def test_drives_with_another_model_let_the_arm_sag_by_the_difference():
    plant = panda(HELD, NO_FRICTION, {'drive.mass_factor': 0.9})
    model = pinocchio.buildModelFromXML((CONFIG / 'panda.urdf').read_text())
    q = np.append(POSITION, np.zeros(model.nq - 7))
    G = pinocchio.computeGeneralizedGravity(model, model.createData(), q)[:7]
    np.testing.assert_allclose(plant.measure()[14:], 0.9 * G, atol=1e-6)
    for _ in range(100):
        plant.step(np.zeros(7))
    assert np.abs(plant.measure()[:7] - POSITION).max() > 1e-3


def test_told_payload_is_held_and_effort_shows_it_if_it_is_the_whole():
    told = {'robot.drive_payload': 2.0}
    loaded = {'load.payload': 2.0}
    plant = panda(HELD, NO_FRICTION, told, loaded)
    for _ in range(200):
        plant.step(np.zeros(7))
    np.testing.assert_allclose(plant.measure()[:7], POSITION, atol=1e-9)
    assert np.abs(plant.measure()[14:]).max() > 30.0
    relative = panda(HELD, NO_FRICTION, told, loaded, {'robot.effort': 'commanded'})
    assert not relative.measure()[14:].any()


def test_drives_overcome_their_share_of_friction():
    friction = {'disturbance.viscous': [1.0] * 7, 'disturbance.coulomb': [0.0] * 7}
    given = {'robot.drive_compensates': 'gravity_and_friction', 'initial.velocity': [0.2] * 7}
    slowed = {}
    for share in (0.0, 1.0):
        plant = panda(given, friction, {'drive.friction': share, 'robot.gravity': [0.0, 0.0, 0.0]})
        plant.step(np.zeros(7))
        slowed[share] = 0.2 - plant.measure()[13]
    frictionless = panda(
        given, NO_FRICTION, {'drive.friction': 0.0, 'robot.gravity': [0.0, 0.0, 0.0]}
    )
    frictionless.step(np.zeros(7))
    assert slowed[0.0] > 1e-3
    assert slowed[1.0] == pytest.approx(0.2 - frictionless.measure()[13], abs=0.05 * slowed[0.0])


@pytest.mark.parametrize(('step', 'stops'), [(0.99, False), (1.01, True)])
def test_reflex_stops_the_arm_after_a_jump_of_the_command_until_a_reset(step, stops):
    """1000 N m/s at 1 kHz: 1 N m from command to command, the first from none."""
    plant = panda(HELD, NO_FRICTION, {'actuator.reflex_rate': 1000.0})
    for k in range(1, 6):
        plant.measure()
        plant.step(np.full(7, k * step))
    assert plant.is_stopped is stops
    plant.step(np.full(7, 5 * step))
    before = plant.measure().copy()
    plant.step(np.full(7, 5 * step))
    stands_still = bool(np.all(plant.measure()[:7] == before[:7]))
    assert stands_still is stops
    plant.reset()
    assert not plant.is_stopped


def test_repeated_reading_has_all_values_of_the_last_one_and_a_new_stamp():
    noisy = {'sensor.position_noise': 1e-5, 'sensor.velocity': 'differenced'}
    usual, repeating = panda(noisy), panda(noisy, {'sensor.repeat_every': 3})
    rows = []
    for plant in (usual, repeating):
        rows.append([])
        for _ in range(10):
            rows[-1].append(plant.measure()[:14].copy())
            plant.step(np.zeros(7))
    every = np.array(rows[1])
    for k in range(1, 10):
        assert np.array_equal(every[k], every[k - 1]) == (k % 3 == 0)
    assert not any(np.array_equal(rows[0][k], rows[0][k - 1]) for k in range(1, 10))


def test_joint_states_may_have_another_order_and_other_joints():
    joints, names = ('a', 'b'), ('finger', 'b', 'a')
    telemetry = PlantTelemetry(joints, (), names)
    measurement = np.arange(1.0, 7.0)
    _, raw = telemetry.joint_states(5, measurement)
    decoder = JointStateDecoder(joints)
    assert decoder.decode(raw) == 5
    np.testing.assert_array_equal(decoder.values, measurement)
    others = JointStateDecoder(names)
    others.decode(raw)
    np.testing.assert_array_equal(others.position, [0.0, 2.0, 1.0])


@pytest.mark.parametrize('missing', ['invalid', 'absent'])
def test_incomplete_states_have_positions_only(missing):
    telemetry = PlantTelemetry(('a', 'b'), ())
    _, raw = telemetry.incomplete_states(7, np.arange(6.0), missing)
    decoder = JointStateDecoder(('a', 'b'), ('position',))
    assert decoder.decode(raw) == 7
    np.testing.assert_array_equal(decoder.position, [0.0, 1.0])
    assert np.isnan(decoder.values[2:]).all()


@pytest.mark.parametrize(
    ('given', 'problem'),
    [
        ({'drive.friction': 1.5} | HELD, 'drive.friction: got 1.5, but it must be at least 0'),
        ({'drive.mass_factor': 0.9}, 'drive: without robot.drive_compensates the drives need no'),
        ({'actuator.reflex_rate': -1.0}, 'actuator.reflex_rate: got -1.0, but it must be at least'),
        ({'actuator.without_command': 'keep'}, "got 'keep', but it must be one of zero, brake, h"),
        ({'sensor.repeat_every': -1}, 'sensor.repeat_every: got -1, but it must be at least 0'),
        ({'sensor.incomplete': 'zero'}, "got 'zero', but it must be one of invalid, absent"),
        ({'sensor.incomplete_states': 101}, 'incomplete_states: got 101, but it must be at least'),
        (
            {'sensor.published_joints': ['panda_joint1', 'gripper']},
            'sensor.published_joints: panda_joint2, .* of `joints` is missing',
        ),
        (
            {'sensor.published_joints': [f'panda_joint{i}' for i in range(1, 8)] + ['a', 'a']},
            'sensor.published_joints: a name is repeated',
        ),
    ],
)
def test_mistakes_give_one_line(given, problem):
    with pytest.raises(ConfigurationError, match=problem) as raised:
        build(PlantConfig, PANDA | given)
    assert len(raised.value.problems) == 1

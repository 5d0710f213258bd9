# SPDX-License-Identifier: Apache-2.0
"""The simulated plant as drivers of real arms behave: compensation, reflex stop, odd states."""

from __future__ import annotations

import numpy as np
import pinocchio
import pytest
from plants import PERIOD, START, commands, plant, run
from random_arm import CONFIG

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.law.telemetry import PlantTelemetry
from blf_dsc_controller.messages.codecs import JointStateDecoder
from sim_plant.plant import plant_of
from sim_plant.sensors import draw, generator

PANDA = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}
HELD = {'robot.drive_compensates': 'gravity'}
NO_FRICTION = {'disturbance.viscous': [0.0] * 7, 'disturbance.coulomb': [0.0] * 7}
POSITION = [0.3, -0.4, 0.5, -1.8, 0.2, 1.9, 0.7]


def panda(*given):
    merged = {**PANDA, 'initial.position': POSITION}
    for each in given:
        merged |= each
    return plant_of(build(PlantConfig, merged))


def waited(plant, samples):
    """Positions after some samples without a command."""
    for _ in range(samples):
        plant.step(np.zeros(7))
    return plant.measure()[:7]


def test_drives_with_another_model_let_the_arm_sag_by_the_difference():
    plant = panda(HELD, NO_FRICTION, {'drive.mass_factor': 0.9})
    model = pinocchio.buildModelFromXML((CONFIG / 'panda.urdf').read_text())
    q = np.append(POSITION, np.zeros(model.nq - 7))
    G = pinocchio.computeGeneralizedGravity(model, model.createData(), q)[:7]
    np.testing.assert_allclose(plant.measure()[14:], 0.9 * G, atol=1e-6)
    assert np.abs(waited(plant, 100) - POSITION).max() > 1e-3


@pytest.mark.parametrize(('payload', 'effort'), [(0.0, 20.0), (2.0, 30.0)])
def test_drives_hold_the_arm_and_a_told_payload_without_any_command(payload, effort):
    """The effort shows it if it is the whole."""
    loaded = {'robot.drive_payload': payload, 'load.payload': payload}
    plant = panda(HELD, NO_FRICTION, loaded)
    np.testing.assert_allclose(waited(plant, 500), POSITION, atol=1e-9)
    assert np.abs(plant.measure()[14:]).max() > effort
    relative = panda(HELD, NO_FRICTION, loaded, {'robot.effort': 'commanded'})
    assert not relative.measure()[14:].any()


def test_drives_overcome_their_share_of_friction():
    given = {'robot.drive_compensates': 'gravity_and_friction', 'initial.velocity': [0.2] * 7}
    slowed = []
    for viscous, share in ((0.0, 0.0), (1.0, 0.0), (1.0, 0.5), (1.0, 1.0)):
        friction = {'disturbance.viscous': [viscous] * 7, 'drive.friction': share}
        plant = panda(given, NO_FRICTION, friction, {'robot.gravity': [0.0, 0.0, 0.0]})
        plant.step(np.zeros(7))
        slowed.append(0.2 - plant.measure()[13])
    by_friction = np.subtract(slowed[1:], slowed[0])
    assert by_friction[0] > 1e-3
    assert by_friction / by_friction[0] == pytest.approx([1.0, 0.5, 0.0], abs=0.05)


@pytest.mark.parametrize(
    ('step', 'rate', 'stops'), [(0.99, 0.0, False), (1.01, 0.0, True), (1.01, 1000.0, False)]
)
def test_reflex_stops_the_arm_after_a_jump_of_the_torque_until_a_reset(step, rate, stops):
    """1000 N m/s at 1 kHz: 1 N m from torque to torque, the first from none."""
    given = {'actuator.reflex_rate': 1000.0, 'actuator.rate_limit': rate}
    plant = panda(HELD, NO_FRICTION, given)
    for k in range(1, 7):
        before = plant.measure().copy()
        plant.step(np.full(7, min(k, 5) * step))
    assert plant.is_stopped is stops
    assert np.all(plant.measure()[:7] == before[:7]) == stops
    plant.reset()
    assert not plant.is_stopped


def test_repeated_reading_has_all_values_of_the_last_one():
    noisy = {'sensor.position_noise': 1e-5, 'sensor.velocity': 'differenced'}
    for every in (0, 3):
        plant, rows = panda(noisy, {'sensor.repeat_every': every}), []
        for _ in range(10):
            rows.append(plant.measure()[:14].copy())
            plant.step(np.zeros(7))
        repeated = [k for k in range(1, 10) if np.array_equal(rows[k], rows[k - 1])]
        assert repeated == ([3, 6, 9] if every else [])


def test_joint_states_may_have_another_order_and_other_joints():
    joints, names, measurement = ('a', 'b'), ('finger', 'b', 'a'), np.arange(1.0, 7.0)
    _, raw = PlantTelemetry(joints, (), names).joint_states(5, measurement)
    ours, others = JointStateDecoder(joints), JointStateDecoder(names)
    assert ours.decode(raw) == others.decode(raw) == 5
    np.testing.assert_array_equal(ours.values, measurement)
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
        ({'events.payload': [0.1]}, 'events.payload: got 1 entry, but 0 are needed'),
        (
            {'events.begin': [1.0], 'events.force': [1.0, 2.0]},
            r'events.force: got 2 entries, but 3 are needed \(1 of events.begin times 3\)',
        ),
        ({'load.torque': [1.0]}, 'load.torque: got 1 entry, but 7 are needed'),
        ({'robot.tip': ''}, 'robot.urdf: neither a tip nor joints were given'),
        ({'joints': ['panda_joint1']}, 'the moving joints from base to tip are'),
        ({'robot.urdf': '', 'truth.mass_factor': 1.1}, 'truth: it applies only to a URDF'),
        ({'robot.urdf': '', 'actuator.ripple': 0.1}, 'actuator.ripple: .* give actuator.torque_'),
        ({'drive.mass_factor': 0.9}, 'drive: without robot.drive_compensates the drives need no'),
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


SAMPLES = 40


@pytest.mark.parametrize('delay', [0, 1, 3, SAMPLES + 1])
def test_command_is_applied_exactly_delay_samples_later(delay):
    torques = commands(SAMPLES)
    late, prompt = plant(delay=delay), plant()
    shifted = np.vstack([np.zeros((delay, 2)), torques])[:SAMPLES]
    assert (run(late, torques) == run(prompt, shifted)).all()
    assert (late.truth() == prompt.truth()).all()


@pytest.mark.parametrize('delay', [0, 2])
def test_torque_beyond_the_limit_of_its_joint_is_cut(delay):
    torques, limit = commands(SAMPLES), np.array([5.0, 1.5])
    cut = np.clip(torques, -limit, limit)
    assert (cut != torques).any(axis=0).all()
    limited = run(plant(delay=delay, torque_limit=limit), torques)
    assert (limited == run(plant(delay=delay), cut)).all()


def test_driver_lets_a_command_change_at_its_rate_only():
    torques, passed = commands(SAMPLES), [np.zeros(2)]
    for torque in torques[:-1]:
        passed.append(passed[-1] + np.clip(torque - passed[-1], -0.3, 0.3))
    np.testing.assert_allclose(run(plant(rate_limit=300.0), torques)[:, 4:], passed, rtol=1e-12)


def test_lagging_drive_has_a_first_order_step_response():
    """The lag follows the limit; a sample reports the mean torque of its interval."""
    tau, step = 2e-3, np.array([4.0, -9.0])
    effort = run(plant(time_constant=tau, torque_limit=(0.0, 6.0)), np.tile(step, (20, 1)))[1:, 4:]
    t = 1e-3 * np.arange(20)
    mean = np.diff(t + tau * np.exp(-t / tau)) / 1e-3
    np.testing.assert_allclose(effort, mean[:, None] * [4.0, -6.0], rtol=1e-12)


def test_drive_noise_is_proportional_to_the_torque_and_drawn_after_that_of_the_encoders():
    torques = np.tile([5.0, -2.0], (4000, 1))
    effort = run(plant(torque_noise=0.01, seed=4), torques)
    error = effort[1:, 4:] / torques[1:] - 1.0
    np.testing.assert_allclose(error.std(axis=0), 0.01, rtol=0.05)
    assert abs(np.corrcoef(error.T)[0, 1]) < 0.07
    arm, numbers = plant(position_noise=1e-5, torque_noise=0.01, seed=4), np.empty(1000)
    draw(generator(4), numbers)  # compiled
    drawn = np.random.Generator(np.random.PCG64(np.random.SeedSequence(4))).standard_normal(1000)
    np.testing.assert_array_equal(numbers, drawn)
    np.testing.assert_array_equal(arm.measure()[:2], np.array(START) + 1e-5 * drawn[:2])
    arm.step(np.array([1.0, 2.0]))
    np.testing.assert_array_equal(arm.measure()[4:], [1.0, 2.0] * (1.0 + 0.01 * drawn[4:6]))


def true_states(samples, **changes):
    """Noise-free states (samples, 4) under the usual torques."""
    arm, rows = plant(**changes), np.empty((samples, 4))
    for row, torque in zip(rows, commands(samples), strict=True):
        row[:] = arm.truth()[5:]
        arm.step(torque)
    return rows


def test_ideal_sensor_measures_the_true_state_without_random_numbers():
    arm = plant()
    before = arm.rng.bit_generator.state
    assert (run(arm, commands(50))[:, :4] == true_states(50)).all()
    assert arm.rng.bit_generator.state == before


def test_noise_has_the_configured_standard_deviation():
    samples = 2000
    read = run(plant(position_noise=1e-5, velocity_noise=1e-3), commands(samples))
    noise = read[:, :4] - true_states(samples)
    error = 1 / np.sqrt(2 * samples)  # standard error of a sample deviation, relative
    assert noise.std(axis=0) == pytest.approx([1e-5, 1e-5, 1e-3, 1e-3], rel=4 * error)
    assert np.abs(noise.mean(axis=0) / noise.std(axis=0)).max() < 4 / np.sqrt(samples)
    off_diagonal = np.corrcoef(noise.T) - np.eye(4)
    assert np.abs(off_diagonal).max() < 4 / np.sqrt(samples)


def test_quantised_position_is_the_nearest_multiple_of_the_resolution():
    resolution = 2 * np.pi / 2**14
    read = run(plant(resolution=resolution), commands(200))[:, :2]
    assert read / resolution == pytest.approx(np.rint(read / resolution), abs=1e-9)
    # half a count, and the rounding of the division
    error = np.abs(read - true_states(200)[:, :2])
    assert resolution / 4 < error.max() <= resolution / 2 * (1 + 1e-9)


@pytest.mark.parametrize('every', [1, 7])
def test_differenced_velocity_is_that_of_the_measured_positions(every):
    """Also where samples are skipped."""
    noisy = {'sensor.velocity': 'differenced', 'position_noise': 1e-5, 'resolution': 1e-5}
    arm = plant(velocity=(0.4, -0.3), **noisy)
    read = [arm.measure().copy()]
    for k, torque in enumerate(commands(49), start=1):
        arm.step(torque)
        if k % every == 0:
            read.append(arm.measure().copy())
    read = np.array(read)
    assert read[0, 2:4].tolist() == [0.4, -0.3]
    expected = np.diff(read[:, :2], axis=0) / (every * PERIOD)
    assert read[1:, 2:4] == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize('source', ['measured', 'differenced'])
def test_velocity_is_low_pass_filtered_with_its_pole(source):
    options = {'sensor.velocity': source, 'position_noise': 1e-5, 'velocity_noise': 1e-3}
    raw = run(plant(**options), commands(30))[:, 2:4]
    read = run(plant(velocity_pole=400.0, **options), commands(30))[:, 2:4]
    expected = raw.copy()
    for k in range(1, 30):
        expected[k] = raw[k] + np.exp(-0.4) * (expected[k - 1] - raw[k])
    np.testing.assert_allclose(read, expected, rtol=1e-13)


@pytest.mark.parametrize('source', ['measured', 'differenced'])
def test_reading_a_sample_twice_gives_the_same_values(source):
    once, twice = (plant(position_noise=1e-5, **{'sensor.velocity': source}) for _ in range(2))
    for torque in commands(20):
        twice.measure()
        assert (once.measure() == twice.measure()).all()
        once.step(torque)
        twice.step(torque)

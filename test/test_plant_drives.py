# SPDX-License-Identifier: Apache-2.0
"""The plant of an arm from a URDF: truth, events, drives, odd states.

Its encoders and drives.
"""

from __future__ import annotations

import numpy as np
import pytest
from plants import PERIOD, QUIET, commands, plant

from blf_dsc_controller import PlantConfig
from blf_dsc_controller.configuration.schema import build
from sim_plant.plant import plant_of

PANDA = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}
HELD = {'robot.drive_compensates': 'gravity'}
NO_FRICTION = {'disturbance.viscous': [0.0] * 7, 'disturbance.coulomb': [0.0] * 7}
POSITION = [0.3, -0.4, 0.5, -1.8, 0.2, 1.9, 0.7]


def panda(given):
    return plant_of(panda_config({'initial.position': POSITION} | given))


def panda_config(given):
    return build(PlantConfig, PANDA | given)


@pytest.mark.parametrize(
    ('step', 'rate', 'stops'),
    [(0.99, 0.0, False), (1.01, 0.0, True), (1.01, 1000.0, False)],
)
def test_reflex_stops_the_arm_after_a_jump_of_the_torque_until_a_reset(
    step, rate, stops
):
    """1000 N m/s at 1 kHz: 1 N m from torque to torque, the first from none."""
    given = {'actuator.reflex_rate': 1000.0, 'actuator.rate_limit': rate}
    plant = panda(HELD | NO_FRICTION | given)
    for k in range(1, 7):
        before = plant.measure().copy()
        plant.step(np.full(7, min(k, 5) * step))
    assert plant.is_stopped is stops
    assert np.all(plant.measure()[:7] == before[:7]) == stops
    plant.reset()
    assert not plant.is_stopped


SAMPLES = 60
OPTIONS = {  # without any imperfection, and with some
    'delay': (0, 1, 3, SAMPLES + 1),
    'torque_limit': ((0.0, 0.0), (5.0, 1.5), (0.0, 6.0)),
    'rate_limit': (0.0, 300.0),
    'time_constant': (0.0, 5e-4, 2e-3),
    'torque_noise': (0.0, 0.01),
    'position_noise': (0.0, 1e-5),
    'velocity_noise': (0.0, 1e-3),
    'resolution': (0.0, 1e-5, 2.0 * np.pi / 2**14),
    'velocity_pole': (0.0, 400.0),
    'repeat_every': (0, 3, 7),
    'sensor.velocity': ('measured', 'differenced'),
    'sensor.offset': (QUIET, (0.01, -0.02)),
    'eccentricity': (QUIET, (2e-3, 1e-3)),
}


def applied(torques, noise, given):
    """Torques at the joints (samples, 2): limited in rate, late, limited, lagging, noisy."""
    step, limit = (
        np.where(each, each, np.inf) for each in (rate_of(given), given['torque_limit'])
    )
    last = np.zeros(2)
    found = np.zeros((given['delay'] + len(torques), 2))
    for row, torque in zip(found[given['delay'] :], torques, strict=True):
        row[:] = last = last + np.clip(torque - last, -step, step)
    found = np.clip(found[: len(torques)], -limit, limit)
    if tau := given['time_constant']:  # the mean of an exponential over a sample
        motor = np.zeros(2)
        decay = np.exp(-PERIOD / tau)
        for k, torque in enumerate(found.copy()):
            lacking = motor - torque
            motor = torque + decay * lacking
            found[k] += tau / PERIOD * (1.0 - decay) * lacking
    return found * (1.0 + given['torque_noise'] * noise)


def rate_of(given):
    return np.full(2, given['rate_limit'] * PERIOD)


def is_new(k, given):
    return k == 0 or given['repeat_every'] == 0 or k % given['repeat_every'] != 0


def readings(true, noise, reads, given):
    """Readings [q, dq] (reads, 4) of the true states (samples, 4)."""
    rows, last = [], None  # sample of the last reading that was new
    for k in reads:
        if is_new(k, given):
            q = (
                true[k, :2]
                + given['eccentricity'] * np.sin(true[k, :2])
                + given['sensor.offset']
                + given['position_noise'] * noise[k, :2]
            )
            if step := given['resolution']:
                q = np.rint(q / step) * step
            dq = true[k, 2:]
            if given['sensor.velocity'] == 'measured':
                dq = dq + given['velocity_noise'] * noise[k, 2:]
            elif last is not None:
                dq = (q - rows[-1][:2]) / ((k - last) * PERIOD)
            if given['velocity_pole'] and last is not None:
                old = np.exp(-given['velocity_pole'] * (k - last) * PERIOD)
                dq = dq + old * (rows[-1][2:] - dq)
            last, reading = k, np.concatenate((q, dq))
        rows.append(reading)
    return np.array(rows)


@pytest.mark.parametrize('seed', range(40))
def test_readings_and_torques_are_those_of_encoders_and_drives_in_plain_numpy(seed):
    """Also where a sample is read twice, or not at all.

    The arm moves by the torques reported.
    """
    drawn = np.random.default_rng(seed)
    given = {
        name: values[drawn.integers(len(values))] for name, values in OPTIONS.items()
    }
    reads = range(0, SAMPLES, [1, 1, 4][seed % 3])
    torques = commands(SAMPLES)
    start = (0.4, -0.3)
    if seed == 0:
        given = {name: values[0] for name, values in OPTIONS.items()}
    arm = plant(seed=seed, velocity=start, **given)
    random = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    true = np.zeros((SAMPLES, 4))
    noise = np.zeros((SAMPLES, 6))
    found = []
    for k, torque in enumerate(torques):
        if k in reads:
            if is_new(k, given) and (
                given['position_noise'] or given['velocity_noise']
            ):
                noise[k:, :4] = random.standard_normal(4)
            if is_new(k, given) and given['torque_noise']:
                noise[k:, 4:] = random.standard_normal(2)
            found.append(arm.measure().copy())
            np.testing.assert_array_equal(arm.measure(), found[-1])
        true[k] = arm.truth()[5:]
        arm.step(torque)
    assert arm.rng.bit_generator.state == random.bit_generator.state
    moved = applied(torques, noise[:, 4:], given)
    efforts = np.vstack((QUIET, moved))[reads]
    expected = np.hstack((readings(true, noise[:, :4], reads, given), efforts))
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
    ideal = plant(velocity=start)
    for state, torque in zip(true, moved, strict=True):
        np.testing.assert_allclose(ideal.truth()[5:], state, rtol=1e-11, atol=1e-12)
        ideal.step(torque)

# SPDX-License-Identifier: Apache-2.0
"""The sampled plant: its integrator against scipy, disturbances, events, and repeatable runs."""

from __future__ import annotations

import numpy as np
import pytest
from paper_case import NO_DISTURBANCE
from plain_law import R, dynamics
from plants import (
    ARM,
    ROUGH,
    START,
    commands,
    configuration,
    energies,
    run,
)
from scipy.integrate import RK45
from scipy.interpolate import CubicSpline

from blf_dsc_controller import PlantConfig
from blf_dsc_controller.configuration.schema import build
from sim_plant.plant import plant_of
from sim_plant.settings import plant_settings

TORQUE = np.array([-6.0, -2.0])


def torque_of(config, t, q, dq):
    """The disturbance in plain numpy: friction has the sign of the velocity, and more near rest."""
    load = plant_settings(config).disturbance
    near_rest = 1.0 + load.stribeck * np.exp(-((dq / load.stribeck_velocity) ** 2))
    friction = load.viscous * dq + load.coulomb * near_rest * np.tanh(
        dq / load.coulomb_velocity
    )
    ripple = load.ripple * np.sin(load.ripple_frequency * q)
    sine = load.amplitude * np.sin(load.frequency * t + load.phase)
    return load.constant + sine + friction + ripple


def test_dopri5_step_matches_scipys_rk45():
    """Of the equations of motion in plain numpy; the disturbance is evaluated in the step, too."""
    h = 0.05
    every = ROUGH | {'ripple': 0.1, 'torque_limit': (20.0, 10.0)}
    config = configuration(velocity=(0.5, -1.0), sample_time=h, **every)
    arm = plant_of(config)

    def slope(t, x):
        q, dq = x.reshape(2, 2)
        M, C, G = dynamics((1.0, 0.32, 0.4), R, q, dq)
        load = torque_of(config, t, q, dq)
        return np.concatenate((dq, np.linalg.solve(M, TORQUE - C @ dq - G - load)))

    start = np.array([*START, 0.5, -1.0])
    rk45 = RK45(slope, 0.0, start, 1.0, first_step=h, rtol=1e9, atol=1e9)
    rk45.step()
    P, load = np.split(arm.truth()[:5], [3])
    assert pytest.approx([1.0, 0.32, 0.4]) == P
    np.testing.assert_allclose(load, torque_of(config, 0.0, *start.reshape(2, 2)))
    arm.step(TORQUE)
    np.testing.assert_allclose(arm.truth()[5:], rk45.y, rtol=1e-13)


SAMPLES = 40
AT = 13  # sample at which the arm changes
ALL_KINDS = {
    'events.begin': [0.005, 0.015],
    'events.duration': [0.02, 0.0],
    'events.ramp': [0.004, 0.003],
    'events.payload': [0.3, 0.2],
    'events.sloshing': [0.0, 0.4],
    'events.force': [3.0, 0.0, -2.0, 0.0, 1.0, 4.0],
    'events.torque': [1.0, -2.0, 0.5, 0.0],
    'events.viscous': [0.1, 0.2, 0.0, 0.3],
    'events.coulomb': [0.0, 0.2, 0.1, 0.0],
    'events.offset': [1e-4, 0.0, -2e-4, 1e-4],
}


OFFSET = {'sensor.offset': [0.01, -0.02]}


@pytest.mark.parametrize(
    ('events', 'lasting'),
    [
        ({'payload': [0.25]}, {'arm.m2': 0.75}),
        ({'payload': [0.25]}, {'load.payload': 0.25}),
        (
            {'payload': [0.25]},
            {'events.begin': [0.0, 0.0], 'events.payload': [0.125, 0.125]},
        ),
        ({'torque': [2.0, -1.0]}, {'disturbance.constant': [-1.9, 1.1]}),
        ({'torque': [2.0, -1.0]}, {'load.torque': [2.0, -1.0]}),
        ({'force': [1.0, 0.0, -2.0]}, {'load.force': [1.0, 0.0, -2.0]}),
        ({'viscous': [0.1, 0.2]}, {'disturbance.viscous': [0.1, 0.2]}),
        ({'coulomb': [0.1, 0.2]}, {'disturbance.coulomb': [0.1, 0.2]}),
        ({'offset': OFFSET['sensor.offset']}, OFFSET),
    ],
)
def test_event_is_equivalent_to_changing_the_plant_at_its_time(events, lasting):
    given = {f'events.{name}': value for name, value in events.items()}
    scheduled = plant_of(build(PlantConfig, {'events.begin': [AT * 1e-3], **given}))
    changed = plant_of(PlantConfig())
    unchanged = plant_of(PlantConfig())
    torques = commands(SAMPLES)
    before = [run(arm, torques[:AT]) for arm in (scheduled, changed, unchanged)]
    changed.truth()  # what acts in this sample is summed once
    changed.change(plant_settings(build(PlantConfig, lasting)))
    after = [run(arm, torques[AT:]) for arm in (scheduled, changed, unchanged)]
    for same in (before, after):
        np.testing.assert_array_equal(*same[:2])
    np.testing.assert_array_equal(scheduled.truth(), changed.truth())
    assert np.any(after[2] != after[0])


OMEGA, MASS = 12.0, 0.4  # rad/s, kg


def sloshing(samples, **events):
    """State x (samples, 10) of an arm that falls, carrying a sloshing load from the start."""
    given = {'begin': [0.0], 'sloshing': [MASS], 'sloshing_frequency': OMEGA} | events
    events = {f'events.{name}': value for name, value in given.items()}
    arm = plant_of(build(PlantConfig, NO_DISTURBANCE | events))
    rows = np.empty((samples, 10))
    for row in rows:
        arm.measure()
        row[:] = arm._now.x
        arm.step(np.zeros(2))
    return rows


def spring_of(x):
    """Stretch [m] and its rate [m/s] of the spring at the states x (samples, 10)."""
    tips, rates = np.empty((2, len(x), 3))
    jacobian = np.empty((3, 2))
    for row, position, rate in zip(x, tips, rates, strict=True):
        ARM.fill_tip(row[:2], position, jacobian)
        rate[:] = jacobian @ row[2:4]
    return x[:, 4:7] - tips, x[:, 7:10] - rates


@pytest.mark.parametrize('zeta', [0.0, 0.3])
def test_energy_of_arm_and_sloshing_load_changes_by_what_its_damper_takes(zeta):
    """d/dt [E_arm + m v^2 / 2 + m g z + m omega^2 |y - x|^2 / 2] = -2 m zeta omega |v - dx|^2."""
    x = sloshing(2000, sloshing_damping=zeta)
    stretch, rate = spring_of(x)
    energy = np.array([sum(energies(ARM, row[:2], row[2:4])) for row in x])
    energy += MASS * (0.5 * np.sum(x[:, 7:10] ** 2, axis=1) + ARM.g * x[:, 6])
    energy += 0.5 * MASS * OMEGA**2 * np.sum(stretch**2, axis=1)
    power = 2.0 * MASS * zeta * OMEGA * np.sum(rate**2, axis=1)
    times = 1e-3 * np.arange(power.size)
    taken = CubicSpline(times, power).antiderivative()(times)
    assert np.ptp(energies(ARM, x[0, :2], x[0, 2:4])) > 1.0
    assert np.abs(stretch).max() > 0.05
    assert taken[-1] > 0.1 or zeta == 0.0
    np.testing.assert_allclose(energy + taken, energy[0], atol=1e-7)

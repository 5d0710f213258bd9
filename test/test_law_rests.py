# SPDX-License-Identifier: Apache-2.0
"""Motions with rests, and friction unlike the assumed one: only true changes and loads.

Links are up to 30 % heavier or lighter than the URDF's.  Friction is drawn for each joint, 0.2 to
1.8 times what the law assumes, with up to 0.7 more at low speed.  A load is picked up half-way.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest

from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, load_loop
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.law.weighing import DEVIATION, MASS
from blf_dsc_controller.messages.journal import Journal
from blf_dsc_controller.reference.trajectory import (
    Trajectory,
    TrajectoryPoint,
    plan_trajectory,
)
from blf_dsc_controller.simulation.compiled_loop import CompiledLoop, Span
from blf_dsc_controller.simulation.loop import new_record
from sim_plant.plant import plant_of

DURATION, PICK_UP, RAMP = 32.0, 16.0, 0.2  # s
LOAD = 2.0  # kg
FRICTION = 0.2, 1.8  # times the assumed one
STRIBECK_SPEED = 0.02, 0.2  # rad/s
RANGE = 0.6  # rad, of postures about that of the preset
TIME, HELD, WEIGHED, INTERVAL = range(4)


class Found(NamedTuple):
    """What a run says."""

    changes: np.ndarray  # s
    readings: (
        np.ndarray
    )  # (k, 4): TIME [s], HELD, WEIGHED and half of the INTERVAL [kg]


def moved(q, goal, speed):
    """Yield the points of a motion with trapezoidal velocities: seconds, position, velocity."""
    way = goal - q
    seconds = float(np.abs(way).max()) / speed
    ramp = min(0.25, seconds)
    velocity = way / seconds
    yield ramp, q + 0.5 * ramp * velocity, velocity
    if seconds > ramp:
        yield seconds - ramp, goal - 0.5 * ramp * velocity, velocity
    yield ramp, goal, 0.0 * velocity


def rested(q, seconds):
    yield seconds, q, 0.0 * q


def trapezoids(random, home):
    q = home
    while True:
        goal = home + random.uniform(-RANGE, RANGE, home.size)
        yield from moved(q, goal, random.uniform(0.2, 1.0))
        q = goal
        yield from rested(q, random.uniform(0.2, 2.0))


def pick(random, home):
    """Yield cycles of pick and place: down and up at two places, with short rests."""
    above = home + random.uniform(-RANGE, RANGE, (2, home.size))
    below = above + random.uniform(-0.25, 0.25, (2, home.size))
    fast, slow = random.uniform(0.5, 1.0), random.uniform(0.1, 0.3)
    wait = random.uniform(0.2, 1.0)
    q = home
    while True:
        for up, down in zip(above, below, strict=True):
            for goal, speed in ((up, fast), (down, slow), (up, slow)):
                yield from moved(q, goal, speed)
                q = goal
                yield from rested(q, wait)


def insertion(random, home):
    """Yield fast motions to a posture, and slow ones from there and back."""
    q = home
    while True:
        goal = home + random.uniform(-RANGE, RANGE, home.size)
        yield from moved(q, goal, random.uniform(0.3, 0.8))
        speed, seconds = random.uniform(0.005, 0.03), random.uniform(2.0, 4.0)
        inside = goal + speed * seconds * random.uniform(-1.0, 1.0, home.size)
        for q, end, rate in ((goal, inside, speed), (inside, goal, 4.0 * speed)):
            yield from rested(q, random.uniform(0.3, 1.0))
            yield from moved(q, end, rate)
        q = goal
        yield from rested(q, random.uniform(0.3, 1.0))


MOTIONS = {'trapezoids': trapezoids, 'pick': pick, 'insertion': insertion}


def trajectory_of(config, motion, seed, duration):
    """Return a motion about the centre of a preset's reference."""
    time, n = 2.0, len(config.joints)
    home = np.array(config.reference.offset)
    points = [TrajectoryPoint(time, tuple(home), (0.0,) * n)]
    for seconds, q, dq in MOTIONS[motion](np.random.default_rng(seed), home):
        time += seconds
        points.append(TrajectoryPoint(time, tuple(q), tuple(dq)))
        if time > duration:
            return Trajectory(config.joints, tuple(points), 0.0)
    raise AssertionError


def loop_of(arm, seed, load, duration, picked_up, **more):
    """Return an arm with links and friction of its own, and `more` of `disturbance`."""
    random = np.random.default_rng(seed)
    usual = load_loop(arm).plant.disturbance

    def varied(values):
        return (random.uniform(*FRICTION, len(values)) * values).tolist()

    held = [load] if load else []
    plant = {
        'duration': duration,
        'seed': seed,
        'truth.seed': 1000 + seed,
        'truth.mass_deviation': 0.3,
        'truth.centre_deviation': 0.01,
        'disturbance.viscous': varied(usual.viscous),
        'disturbance.coulomb': varied(usual.coulomb),
        'disturbance.stribeck': float(random.uniform(0.0, 0.7)),
        'disturbance.stribeck_velocity': float(
            np.exp(random.uniform(*np.log(STRIBECK_SPEED)))
        ),
        'sensor.incomplete_states': 0,
        'events.begin': [picked_up] * len(held),
        'events.duration': [0.0] * len(held),
        'events.ramp': [RAMP] * len(held),
        'events.payload': held,
    }
    plant |= {f'disturbance.{name}': value for name, value in more.items()}
    return load_loop(arm, {PLANT: plant, CONTROLLER: {'contact.enabled': True}})


def run_of(arm, motion, seed, load, duration=DURATION, picked_up=PICK_UP, **friction):
    """Run the law along a motion, or that of the preset, without supervision."""
    loop = loop_of(arm, seed, load, duration, picked_up, **friction)
    config = loop.controller
    if motion in MOTIONS:
        holding = dataclasses.replace(config.reference, type='hold')
        config = dataclasses.replace(config, reference=holding)
    record = new_record(controller_of(config), config, loop.plant, Journal())
    plant = plant_of(loop.plant)
    controller = record.controller
    begin(controller, config, *plant.measure().reshape(3, -1)[:2])
    if motion in MOTIONS:
        trajectory = trajectory_of(config, motion, seed, duration)
        planned = plan_trajectory(trajectory, controller.reference_vector, 0.0, config)
        controller.reference_vector = planned.vector
    span = Span(0, record.stamps.size - 1, is_end=True, observed=True)
    CompiledLoop(controller, plant).run(span, record.rows_to_fill())

    samples = sample_columns(record.samples, controller.settings)
    t = record.stamps * 1e-9
    changes = t[1:][np.diff(samples.changes[:, 0]) > 0.0]
    every = round(0.1 / config.sample_time)
    mass, half = samples.load[::every, [MASS, DEVIATION]].T
    times = t[::every]
    truth = np.where(times < picked_up, 0.0, load)
    clear = (times < picked_up) | (times > picked_up + 1.0) | (load == 0.0)
    known = clear & np.isfinite(mass)
    return Found(changes, np.stack((times, truth, mass, half), axis=1)[known])


def outside(readings):
    """Return which readings (k, 4) have an interval that does not hold the truth."""
    off = np.abs(readings[:, WEIGHED] - readings[:, HELD])
    return off > readings[:, INTERVAL]


def test_insertion_by_an_arm_whose_friction_is_unknown_is_no_change():
    """Eight changes were found in 32 s, and 38 % of the weights were outside their intervals."""
    run = run_of('ur5e_rigid', 'insertion', 10, 0.0)
    assert run.changes.size == 0
    assert len(run.readings) > 100
    assert outside(run.readings).mean() <= 0.05


@pytest.mark.parametrize(
    ('seed', 'motion'), [(13, 'pick'), (101, 'trapezoids'), (208, 'pick')]
)
def test_first_stop_of_an_arm_whose_drives_are_heavier_than_guessed_is_no_change(
    seed, motion
):
    """Five times as heavy.  A change was found at 2.1 s, as the arm stopped and moved on."""
    preset = load_loop('ur5e')
    guess, truth = preset.controller.robot, preset.plant.truth.rotor_inertia
    chain = guess.chain(preset.controller.joints)
    np.testing.assert_allclose(truth, 5.0 * guess.rotors(chain))
    assert run_of('ur5e', motion, seed, 0.0, duration=3.0).changes.size == 0


def test_load_of_such_an_arm_is_found_although_it_has_moved_for_a_second_only():
    """1.5 kg.  No change was found within 3.5 s: the wrong drives had raised the noise."""
    run = run_of('ur5e', 'sinusoids', 1, 1.5, duration=2.5, picked_up=1.0)
    assert run.changes == pytest.approx([1.3], abs=0.1)


def test_true_load_is_found_as_soon_in_the_same_insertion():
    """It was found after 0.13 s, among seven changes that were none."""
    run = run_of('ur5e_rigid', 'insertion', 10, LOAD)
    assert run.changes == pytest.approx([PICK_UP + 0.2], abs=0.2)
    held = run.readings[run.readings[:, TIME] > PICK_UP + 5.0]
    assert len(held) > 50
    assert not outside(held).any()
    assert np.median(held[:, WEIGHED]) == pytest.approx(LOAD, abs=0.2)


def test_load_is_weighed_though_gears_lose_15_percent_of_the_torque_they_carry():
    """57 % of the weights were outside of their intervals, by up to six times these."""
    run = run_of('panda', 'trapezoids', 1, 2.0, load_share=0.15)
    assert len(run.readings) > 200
    assert outside(run.readings).mean() <= 0.05
    assert np.median(run.readings[-50:, INTERVAL]) < 0.05  # kg: no wider than before


def test_load_is_weighed_though_friction_falls_by_40_percent():
    """It was 2.61 +- 0.40 kg after 8 s."""
    friction = {'warm_factor': 0.6, 'warm_time': 10.0}
    run = run_of('ur5e', 'trapezoids', 1, 2.0, **friction)
    held = run.readings[run.readings[:, TIME] > PICK_UP]
    assert len(held) > 100
    assert outside(held).mean() <= 0.05

# SPDX-License-Identifier: Apache-2.0
"""Torque ripple that `identify` finds, and that which is not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from random_arm import recording_of, reference_of

from blf_dsc_controller import load_loop
from blf_dsc_controller.configuration.nodes import PLANT
from blf_dsc_controller.identification.identify import ripples_left
from blf_dsc_controller.identification.problem import problem_of
from blf_dsc_controller.identification.regression import fitted
from blf_dsc_controller.identification.ripple import (
    NOTHING,
    listed_cycles,
)
from sim_plant.plant import plant_of

LOAD = {'begin': [10.0], 'duration': [100.0], 'payload': [3.0]}


SECONDS = 20.0
EVERY = 4  # samples of 1 ms
SHARE = 0.008  # of the rated torque
RAMP = 2.0  # s, in which the motion begins
GAINS = 8.0, 0.48  # 1/rad and s/rad, times the effort


def found_in_recording(recording, robot, load=None):
    """Return what is found; a load comes at that time [s].

    Friction is fitted as viscous and Coulomb friction: terms are not selected, which takes long.
    """
    problem = problem_of(recording, robot, 'torque', load, find_signs=False)
    prior = problem.prior.only([])
    fit = fitted(problem.rows, problem.windows.moving, problem.G, prior)
    return ripples_left(problem, np.zeros(len(recording.joints)), fit)


def amplitudes_of(config):
    """Return the amplitude (n,) [N m] of each ripple."""
    return SHARE * np.array(config.actuator.torque_limit)


def moved(config, cycles, reference, pace):
    """Return states (k, 3, n) of a PD on a motion, with ripples of N `cycles` at the motors."""
    chain = config.robot.chain(config.joints)
    T = config.sample_time
    motion = reference.at(pace * np.arange(round(SECONDS / T)) * T)
    start = motion[0, 0]
    initial = replace(config.initial, position=tuple(start.tolist()))
    plant = plant_of(replace(config, initial=initial))
    efforts = np.array([min(joint.effort, 100.0) for joint in chain.joints])
    states = np.zeros((len(motion), 3, efforts.size))
    amplitudes = amplitudes_of(config)
    ripple = np.zeros(efforts.size)
    for k, (position, velocity, _) in enumerate(motion):
        q, dq, effort = plant.measure().reshape(3, -1)
        states[k] = q, dq, effort + ripple
        waves = [
            np.sin(np.multiply(own, at)) for own, at in zip(cycles, q, strict=True)
        ]
        ripple = amplitudes * [each.sum() for each in waves]
        begun = min(1.0, k * T / RAMP)
        error = start + begun * (position - start) - q
        p, d = GAINS
        plant.step(efforts * (p * error + d * (begun * pace * velocity - dq)) - ripple)
    return states


def found_in(
    cycles, preset='ur5e', *, seed=0, pace=1.0, reach=1.0, events=None, load=None
):
    """Return what is found of an arm with N of each joint, and the true amplitudes."""
    plant = {'actuator.ripple': 0.0, 'truth.seed': seed}
    for name in ('begin', 'duration', 'payload'):
        plant[f'events.{name}'] = (events or {}).get(name, [])
    config = load_loop(preset, {PLANT: plant}).plant
    reference = reference_of(config.robot.chain(config.joints), seed)
    reference = reference._replace(amplitude=reach * reference.amplitude)
    true = [cycles[i % len(cycles)] for i in range(len(config.joints))]
    states = moved(config, true, reference, pace)[::EVERY]
    recording = recording_of(states, config.joints, EVERY * config.sample_time)
    return found_in_recording(recording, config.robot, load), amplitudes_of(config)


def check(found, amplitudes, cycles):
    """Check that all joints have these ripples, and no others."""
    for i, (own, amplitude) in enumerate(zip(found, amplitudes, strict=True)):
        true = cycles[i % len(cycles)]
        assert sorted(each.cycles for each in own.found) == pytest.approx(
            true, rel=0.02
        )
        for each in own.found:
            assert each.amplitude == pytest.approx(amplitude, rel=0.4)


@pytest.mark.parametrize(
    ('preset', 'cycles', 'pace'),
    [
        ('ur5e', [[12.5]], 1.0),
        ('ur5e', [[20.0, 50.0]], 1.0),
        ('ur5e', [[20.0], [50.0]], 1.0),
        ('ur5e', [[100.0]], 1.0),
        ('panda', [[30.0]], 1.0),
    ],
)
def test_ripples_are_found(preset, cycles, pace):
    found, amplitudes = found_in(cycles, preset, pace=pace)
    check(found, amplitudes, cycles)
    every = sorted({N for own in cycles for N in own})
    assert sorted(listed_cycles(found)) == pytest.approx(every, rel=5e-3)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('preset', ['ur5e', 'panda'])
def test_no_ripple_is_claimed_where_there_is_none(preset, seed):
    found, amplitudes = found_in([[]], preset, seed=seed)
    assert not any(own.found for own in found)
    assert listed_cycles(found) == ()
    assert all(own.is_known for own in found)
    least = np.array([own.least for own in found])
    assert (least < 2.0 * amplitudes).all()


def test_a_load_that_is_picked_up_does_not_hide_a_ripple():
    found, amplitudes = found_in([[30.0]], events=LOAD, load=10.0)
    check(found, amplitudes, [[30.0]])


def test_an_arm_that_hardly_moves_shows_no_ripple():
    found, _ = found_in([[30.0]], reach=0.02)
    assert found == (NOTHING,) * 6

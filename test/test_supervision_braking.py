# SPDX-License-Identifier: Apache-2.0
"""The damping of a stop brakes all joints, and none drags another along."""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import CONFIG

from blf_dsc_controller import load_loop
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.supervision.braking import braking_matrix
from blf_dsc_controller.supervision.guard import Guard
from sim_plant.plant import plant_of

PANDA = load_loop(CONFIG / 'panda_rigid.yaml').controller


@pytest.fixture(scope='module')
def settings():
    return settings_of_config(PANDA)


def inertia(settings, q):
    P = settings.initial_estimate[: settings.p]
    return inertia_matrices(settings.model, P, q[np.newaxis])[0]


@pytest.mark.parametrize('seed', range(5))
def test_braking_takes_energy_out_of_any_motion(settings, seed):
    """And each joint's own damping is as configured."""
    draw = np.random.default_rng(seed)
    q = draw.uniform(-1.5, 1.5, settings.n)
    damping = 10.0 ** draw.uniform(-1.0, 1.5, settings.n)
    D = braking_matrix(settings, damping, q)
    np.testing.assert_allclose(D, D.T, atol=1e-12)
    np.testing.assert_allclose(np.diagonal(D), damping)
    assert np.linalg.eigvalsh(D).min() > 0.0


def test_joints_with_one_rate_brake_each_by_itself(settings):
    draw = np.random.default_rng(0)
    q, v = draw.uniform(-1.5, 1.5, (2, settings.n))
    M = inertia(settings, q)
    D = braking_matrix(settings, 8.0 * np.diagonal(M), q)
    np.testing.assert_allclose(np.linalg.solve(M, D @ v), 8.0 * v, rtol=1e-9)


def test_slower_joint_in_front_acts_on_a_faster_one_as_its_own_braking_does(settings):
    """The torque on the wrist that the deceleration of the shoulder asks for, and no more."""
    q = np.linspace(-0.5, 0.5, settings.n)
    M = inertia(settings, q)
    rate = np.linspace(5.0, 30.0, settings.n)  # 1/s, shoulder to wrist
    D = braking_matrix(settings, rate * np.diagonal(M), q)
    np.testing.assert_allclose(D[1:, 0], 5.0 * M[1:, 0])
    np.testing.assert_allclose(D[0, 1:], 5.0 * M[0, 1:])


def test_without_an_estimate_each_joint_brakes_alone():
    unknown = settings_of_config(
        change(ControllerConfig(), {'learning.initial_estimate': [0.0, 0.0, 0.0]})
    )
    D = braking_matrix(unknown, np.array([2.0, 1.0]), np.zeros(2))
    np.testing.assert_array_equal(D, [[2.0, 0.0], [0.0, 1.0]])


def test_no_joint_of_a_panda_gets_much_faster_in_a_stop():
    """In motion with 2 kg, at twelve moments of its motion.

    With the damping of each joint alone, a wrist got 0.40 rad/s faster.
    """
    loop = load_loop(CONFIG / 'panda_rigid.yaml')
    n = len(loop.controller.joints)
    load = {'events.begin': [0.5], 'events.duration': [60.0], 'events.payload': [2.0]}
    excess = []
    for moment in np.linspace(2.0, 4.5, 12):  # s, half of its period
        plant = plant_of(change(loop.plant, load))
        guard = Guard(loop.controller)
        guard.starting.activate()

        def run(seconds, plant=plant, guard=guard):
            speeds = []
            for _ in range(round(seconds / loop.controller.sample_time)):
                stamp = 10**9 + plant.elapsed_ns
                plant.step(guard.update(stamp, plant.measure().copy()))
                speeds.append(np.abs(plant.truth()[-n:]))
            return np.array(speeds)

        before = run(moment)[-200:].max(axis=0)
        guard.update(10**9 + plant.elapsed_ns, np.full(3 * n, np.nan))
        assert not guard.supervisor.running
        excess.append((run(0.5).max(axis=0) - before).max())
    assert max(excess) < 0.2

# SPDX-License-Identifier: Apache-2.0
"""The damping of a stop brakes all joints, and none drags another along."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller import ControllerConfig, change, load_loop
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law import columns
from blf_dsc_controller.supervision.braking import (
    braking_matrix,
    known_inertia,
    within_gap,
)
from blf_dsc_controller.supervision.model_torque import friction_torque

PANDA = load_loop('panda_rigid').controller


@pytest.fixture(scope='module')
def settings():
    return settings_of_config(PANDA)


def inertia(settings, q):
    P = settings.initial_estimate[: settings.p]
    return inertia_matrices(settings.model, P, q[np.newaxis])[0]


@pytest.mark.parametrize('gap', [0.03, 0.05, 0.11])
@pytest.mark.parametrize('seed', range(3))
def test_damping_that_is_held_for_a_gap_reverses_no_motion_of_the_model(
    settings, gap, seed
):
    draw = np.random.default_rng(seed)
    q = draw.uniform(-1.5, 1.5, settings.n)
    M = inertia(settings, q)
    damping = draw.uniform(5.0, 40.0, settings.n) * np.diagonal(M)
    coupled = braking_matrix(M, damping, gap)
    alone = np.diag(within_gap(M, damping, gap))
    for D in (coupled, alone):
        kept = np.linalg.eigvals(np.eye(settings.n) - gap * np.linalg.solve(M, D))
        assert kept.real.min() > -1e-9
        assert kept.real.max() <= 1.0
    borne = np.minimum(damping, np.diagonal(M) / 0.03)
    np.testing.assert_allclose(within_gap(M, damping, 0.0), borne)


def test_without_an_estimate_each_joint_brakes_alone():
    unknown = settings_of_config(
        change(ControllerConfig(), {'two_link.initial_estimate': [0.0, 0.0, 0.0]})
    )
    D = braking_matrix(known_inertia(unknown, np.zeros(2)), np.array([2.0, 1.0]))
    np.testing.assert_array_equal(D, [[2.0, 0.0], [0.0, 1.0]])


def test_friction_in_a_stop_is_what_the_columns_of_the_law_have_besides_those_at_rest():
    """Where a column was forgotten, 5 N m of friction were held as a load."""
    settings = settings_of_config(load_loop('ur5e').controller)
    of = settings.columns
    assert columns.LOAD_FRICTION in of.kinds
    draw = np.random.default_rng(0)
    dq, tau = draw.uniform(-1.0, 1.0, (2, settings.n))
    estimate = draw.uniform(0.1, 1.0, settings.m)

    def torque(velocity):
        row = np.zeros((settings.n, settings.m))
        for i in range(settings.n):
            sign = np.tanh(velocity[i] / of.coulomb_velocity)
            at = columns.Point(0.3, 0.0, velocity[i], sign, tau[i])
            columns.fill(of, columns.ALL, i, at, row)
        return row @ estimate

    expected = torque(dq) - torque(np.zeros(settings.n))
    found = friction_torque(settings, estimate, dq, tau)
    np.testing.assert_allclose(found, expected, rtol=1e-12)

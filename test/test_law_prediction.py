# SPDX-License-Identifier: Apache-2.0
"""The filtered regressor: X theta = u on simulated motion up to T^2, and the columns recover d."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest
from arbitrary_case import arbitrary
from closed_loop_case import (
    P,
    closed_loop,
    controller,
    plant,
    quick,
    recommended,
    record,
)

from blf_dsc_controller.law import prediction
from blf_dsc_controller.law.settings import EFFORT

BIAS = (0.3, -0.2)


@pytest.mark.parametrize(('n', 'p'), [(1, 1), (2, 3), (3, 4)])
def test_both_sides_are_filtered_by_two_exact_poles(n, p):
    """Against the recursion written out, for any n and p: the same pole twice."""
    settings, state, signals = arbitrary(5, n, p)
    random = np.random.default_rng(6)
    first, second = state.filter1.copy(), state.filter2.copy()
    for _ in range(50):
        dt = random.uniform(5e-4, 2e-3)
        torque = random.normal(size=n)
        Yp, rest = state.momentum.copy(), state.rest.copy()
        signals.momentum[:] = random.normal(size=(n, p))
        signals.rest[:] = random.normal(size=(n, settings.m))

        prediction.filter_row(settings, state, signals, dt, torque)
        prediction.remember(settings, state, signals)

        X = (rest + signals.rest) / 2.0
        X[:, :p] += (signals.momentum - Yp) / dt
        gain = 1.0 - exp(-settings.pole * dt)
        first = first + gain * (np.column_stack([X, torque]) - first)
        second = second + gain * (first - second)
        np.testing.assert_allclose(signals.row, second, atol=1e-9)  # the quotient is about 1e3


def filtered_rows(sample_time, duration=2.0):
    """Rows [X | u] of the arm swinging about its lowest point under held, varying torques."""
    law = controller(recommended(torque_source=EFFORT))
    arm = plant(sample_time=sample_time, start=(-1.2, 0.4), constant=BIAS, amplitude=(0.0, 0.0))
    rows = []
    for k in range(round(duration / sample_time)):
        t = k * sample_time
        law.update(t, sample_time, arm.measure())  # its torque is not used
        arm.step(np.array([2.0 * np.sin(3.0 * t), 1.5 * np.cos(5.0 * t)]))
        rows.append(law.signals.row.copy())
    return np.array(rows[1:])


def test_bias_columns_are_a_unit_torque_for_each_joint():
    """The filtered constant columns are the step response of both poles."""
    rows = filtered_rows(1e-3)
    passed = 1.0 - np.exp(-10.0) * (1.0 + 10.0)  # of a step after 1 s, up to the pole's T
    np.testing.assert_allclose(rows[999, :, 3:5], passed * np.eye(2), atol=1e-4)
    np.testing.assert_allclose(rows[-1, :, 3:5], np.eye(2), atol=1e-6)


def test_filtered_identity_holds_up_to_the_square_of_the_sample_time():
    theta = np.concatenate([P, BIAS])
    error = []
    for sample_time in (4e-3, 2e-3, 1e-3):
        rows = filtered_rows(sample_time)
        error.append(np.abs(rows[:, :, :-1] @ theta - rows[:, :, -1]).max())

    order = np.log2(np.divide(error[:-1], error[1:]))
    np.testing.assert_allclose(order, 2.0, atol=0.1)
    # The trapezoid's T^2 / 12 times (Yr P)'', up to some 400 N m/s^2 in this swing.
    assert error[-1] < 1e-6 / 12.0 * 500.0


def test_bias_column_absorbs_a_constant_disturbance():
    rows = filtered_rows(1e-3)
    X, u = rows[:, :, :-1].reshape(-1, 5), rows[:, :, -1].ravel()

    with_columns = np.linalg.lstsq(X, u)[0]
    without = np.linalg.lstsq(X[:, :3], u)[0]

    np.testing.assert_allclose(with_columns, [*P, *BIAS], atol=2e-6)  # the trapezoid's error
    assert np.abs(without - P).max() > 0.01


def test_loop_learns_the_parameters_and_the_constant_disturbance():
    law = controller(recommended())
    arm = plant(constant=BIAS, amplitude=(0.0, 0.0))
    record(law, arm, 8.0)
    np.testing.assert_allclose(law.state.estimate, [*P, *BIAS], atol=1e-3)


def identity_error(torque_source):
    """Largest error of X theta = u while the actuator is three samples late."""
    law = controller(quick(torque_source=torque_source))
    arm = plant(delay=3, constant=BIAS, amplitude=(0.0, 0.0))
    theta = np.concatenate([P, BIAS])
    worst = 0.0
    for _ in closed_loop(law, arm, 1.0):
        worst = max(worst, np.abs(law.signals.row @ [*theta, -1.0]).max())
    return worst


def test_learning_uses_the_applied_torque():
    """With 'effort' the identity holds despite an actuator delay, with 'command' it does not."""
    of_command = identity_error(0)
    of_effort = identity_error(EFFORT)
    assert of_effort < 0.01
    assert of_command > 10.0 * of_effort


def test_learning_from_the_command_uses_the_saturated_torque():
    """The controller knows its own limit: the identity holds while the torque is cut."""
    law = controller(quick(torque_limit=np.array([8.5, 20.0])))
    arm = plant(constant=BIAS, amplitude=(0.0, 0.0))
    theta = np.concatenate([P, BIAS])
    worst, cut = 0.0, 0
    for _ in closed_loop(law, arm, 1.0):
        cut += law.signals.torque[0] != law.signals.demand[0]
        worst = max(worst, np.abs(law.signals.row @ [*theta, -1.0]).max())
    assert cut > 10
    assert worst < 0.01

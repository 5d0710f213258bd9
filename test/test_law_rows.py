# SPDX-License-Identifier: Apache-2.0
"""The parts that a row, the feedback and d^3 are made of, each alone."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest
from law_part import part

from blf_dsc_controller.law import disturbance, feedback, prediction, surface

N, P, M = 2, 3, 4  # joints, parameters, entries of theta
DT = 1e-3  # s
ROW = prediction.Settings(
    prediction=prediction.FILTERED,
    filter_pole=20.0,
    motion_scale=0.05,
    lag=0.0,
    omega=100.0,
    row_weight=np.array([1.0, 0.5]),
)


def scratch():
    """Values of one sample."""
    return part(prediction.Work, n=N, m=M, p=P)


def empty():
    """State before the first row."""
    return part(prediction.State, n=N, m=M, p=P)


def test_row_of_an_interval_has_the_change_of_the_momentum_and_the_mean_of_the_rest():
    """X = (Yp_k - Yp_{k-1}) / T + (Yr_k + Yr_{k-1}) / 2, and the torque of the interval."""
    random = np.random.default_rng(0)
    before, now = random.normal(size=(2, N, P)), random.normal(size=(2, N, M))
    state, work = empty(), scratch()
    row = work.Xu
    work.Yp[:], work.Yr[:] = before[0], now[0]
    prediction.keep_regressors(state, work)
    state.late[1] = 7.0, 8.0
    work.Yp[:], work.Yr[:] = before[1], now[1]
    prediction.fill_interval(state, work, DT)
    expected = (now[0] + now[1]) / 2.0
    expected[:, :P] += (before[1] - before[0]) / DT
    np.testing.assert_allclose(row[:, :M], expected, rtol=1e-12)
    assert row[:, M].tolist() == [7.0, 8.0]


def test_constant_row_passes_both_poles_and_is_weighted():
    """After k samples 1 - (1 + k g) (1 - g)^k of it has passed, with the gain g of each pole."""
    state, gain = empty(), 1.0 - exp(-ROW.filter_pole * DT)
    for k in range(1, 100):
        work = scratch()
        work.Xu[:] = 1.0
        prediction.pass_poles(ROW, state, work, np.array([1e6, 0.0]), DT)
        left = (1.0 - gain) ** k * (1.0 + k * gain)
        np.testing.assert_allclose(state.filter2, 1.0 - left, rtol=1e-9)
        assert not work.Xu[1].any()  # a joint at rest
    prediction.forget(state)
    assert not state.filter1.any()
    assert not state.filter2.any()


@pytest.mark.parametrize(
    ('dqr', 'scale', 'joint', 'weight'),
    [
        (0.0, 0.05, 0, 0.0),
        (0.05, 0.05, 0, 0.5**0.5),
        (-0.05, 0.05, 1, 0.5 * 0.5**0.5),
        (0.0, 0.0, 1, 0.5),  # off
        (1e3, 0.05, 0, 1.0),
    ],
)
def test_row_of_a_joint_that_hardly_moves_counts_less(dqr, scale, joint, weight):
    of = ROW._replace(motion_scale=scale)
    assert prediction.motion_weight(of, dqr, joint) == pytest.approx(weight)


@pytest.mark.parametrize('lag', [0.0, 0.01])
def test_applied_torque_passes_half_of_the_lag_twice(lag):
    """Once the motion has begun; a step has then passed by 1 - (1 + k g) (1 - g)^k."""
    state, of = empty(), ROW._replace(lag=lag)
    prediction.delay_torque(of, state, np.zeros(N), True, DT)  # noqa: FBT003
    gain = 1.0 - exp(-DT / (0.5 * lag)) if lag else 1.0
    for k in range(1, 30):
        prediction.delay_torque(of, state, np.ones(N), False, DT)  # noqa: FBT003
        left = (1.0 - gain) ** k * (1.0 + k * gain)
        np.testing.assert_allclose(state.late[1], 1.0 - left, atol=1e-12)
    prediction.delay_torque(of, state, np.full(N, 5.0), True, DT)  # noqa: FBT003
    np.testing.assert_array_equal(state.late, 5.0)


@pytest.mark.parametrize(
    ('ddq', 'dq', 'dalpha2', 'alpha2', 'expected'),
    [
        ([0.0], [0.0], [0.0], [0.0], 1.0),  # at rest
        ([2.0], [1.0], [2.0], [1.0], 1.0),  # on the surface
        ([2.0], [1.0], [1.0], [0.5], (2.0 + 0.5 + 1.0) / 6.0),
    ],
)
def test_lambda_of_equation_24(ddq, dq, dalpha2, alpha2, expected):
    given = map(np.array, (ddq, dq, dalpha2, alpha2))
    assert prediction.lambda_of(*given) == pytest.approx(expected)


FEEDBACK = feedback.Settings(
    gain=np.array([10.0, 20.0]),
    robust_gain=np.array([0.0, 300.0]),
    damping_rate=5.0,
    follows_inertia=0,
    decoupled=0,
    damping_lag=np.zeros(2),
    lags=0,
)


@pytest.mark.parametrize(
    ('xi1', 'xi2', 'joint', 'torque'),
    [
        (0.1, 0.005, 0, -0.05),  # K_p alone
        (0.001, 0.005, 1, -0.1 - 0.3 * 0.5),  # half of the layer of 0.01 rad/s
        (-0.001, -0.5, 1, 10.0 + 0.3),  # past it
    ],
)
def test_feedback_is_damping_and_the_robust_term_of_28(xi1, xi2, joint, torque):
    found = feedback.joint_torque(FEEDBACK, xi1, xi2, xi2, 0.01, joint)
    assert found == pytest.approx(torque)


@pytest.mark.parametrize(
    ('late', 'joint', 'torque'),
    [(0.0, 0, 0.0), (-0.01, 0, 0.1), (-0.01, 1, 0.2 - 0.3 * 0.5)],
)
def test_the_robust_term_does_not_lag(late, joint, torque):
    found = feedback.joint_torque(FEEDBACK, 0.001, 0.005, late, 0.01, joint)
    assert found == pytest.approx(torque)


@pytest.mark.parametrize(
    ('lags', 'begins', 'samples', 'share'),
    [
        ([0.0, 0.0], False, 1, 1.0),  # no lag
        ([0.003, 0.003], True, 1, 1.0),  # it begins with the first sample
        ([0.003, 0.003], False, 1, 1.0 - np.exp(-1.0 / 3.0)),
        ([0.003, 0.003], False, 6, 1.0 - np.exp(-2.0)),
        ([0.003, 0.0], False, 6, [1.0 - np.exp(-2.0), 1.0]),
        ([0.006, 0.003], False, 6, 1.0 - np.exp([-1.0, -2.0])),
    ],
)
def test_damping_follows_a_step_of_the_velocity_error(lags, begins, samples, share):
    of = FEEDBACK._replace(damping_lag=np.array(lags), lags=int(any(lags)))
    first, then = np.array([0.1, -0.2]), np.array([0.5, 0.2])
    state = feedback.State(late=first[: 2 * of.lags].copy())
    for _ in range(samples):
        feedback.advance(of, state, then, begins, 0.001)
    found = [feedback.damped(of, state, then, i) for i in range(2)]
    assert found == pytest.approx(first + share * (then - first))


@pytest.mark.parametrize(
    ('follows', 'expected'), [(0, [0.5, 3.5]), (1, [0.5 + 2.0, 3.5 - 8.0])]
)
def test_acceleration_has_the_damping_and_the_restoring_torque_over_the_inertia(
    follows, expected
):
    work = part(feedback.Work, n=2)
    work.restoring[:] = 1.0, -2.0
    feedback.fill_acceleration(
        FEEDBACK._replace(follows_inertia=follows),
        work,
        wanted=np.array([1.0, 3.0]),
        xi2=np.array([0.1, -0.1]),
        inertia=np.array([0.5, 0.25]),
    )
    np.testing.assert_allclose(work.acceleration, expected)


def test_known_rate_of_the_virtual_control_is_its_derivative_along_the_measured_motion():
    """By central differences of beta2 on a swinging reference and arm, without a lag."""
    of = surface.Settings(
        gain=np.array([100.0]),
        mu=np.array([20.0]),
        time_constant=0.002,
        known_rate=1,
        lag=0.0,
    )
    bound, t, h = 0.05, 0.3, 1e-6

    def qr(t):
        return 0.3 * np.sin(t), 0.3 * np.cos(t), -0.3 * np.sin(t)

    def q(t):
        return qr(t)[0] + 0.01 * np.sin(3.0 * t), qr(t)[1] + 0.03 * np.cos(3.0 * t)

    def beta2(t):
        xi1 = q(t)[0] - qr(t)[0]
        return surface.virtual_control(xi1, bound, of.gain[0], of.mu[0], qr(t)[1])

    expected = (beta2(t + h) - beta2(t - h)) / (2.0 * h)
    (position, dqr, ddqr), (measured, dq) = qr(t), q(t)
    given = measured - position, bound, 0.0, dq, dqr, ddqr, 0
    f, late = surface.known_rate(of, *given)
    assert (f, late) == (pytest.approx(expected, rel=1e-6), 0.0)
    # Where it is known that velocities are late, so is the reference that they compare with.
    f, late = surface.known_rate(of._replace(lag=0.01), *given)
    assert late == pytest.approx(0.005 * ddqr)


def test_disturbance_estimate_follows_the_error_with_leakage_and_gives_up_what_is_learned():
    of = disturbance.Settings(gain=np.array([10.0, 20.0]), leakage=0.5, bumpless=1)
    d3 = np.array([2.0, -4.0])
    work = part(disturbance.Work, n=2)
    disturbance.fill_step(of, work, d3, np.array([0.1, 0.2]), DT)
    np.testing.assert_allclose(work.step, DT * np.array([10.0 * 1.1, 20.0 * -1.8]))
    H, before = np.random.default_rng(1).normal(size=(2, 2, M))
    theta = before[0] + 0.1
    torque = H @ before[0] + d3
    disturbance.transfer_learned(d3, H, theta, before[0])
    np.testing.assert_allclose(H @ theta + d3, torque)

# SPDX-License-Identifier: Apache-2.0
"""Torque of the model: P^(0) at the state, what is learned along the reference, and their sum."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from law_part import part

from blf_dsc_controller.arms.model import arm_model
from blf_dsc_controller.law import feedback
from blf_dsc_controller.law.compensation import (
    compensated,
    compute_regressors,
    correct_feedback,
)
from blf_dsc_controller.law.prediction import FILTERED
from blf_dsc_controller.law.state import REFERENCE, STATE, Momentum

N, P, M = 2, 3, 5  # two joints, their three parameters, two columns


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.fixture
def signals(rng):
    """Return what a sample has before its torque, of any values."""
    names = ['q', 'dq', 'qr', 'dqr', 'ddqr', 'dalpha2', 'xi2', 'model_torque']
    return SimpleNamespace(
        **{name: rng.normal(size=N) for name in names},
        H=rng.normal(size=(N, M)),
        row=part(Momentum, n=N, p=P, m=M),
        feedback=part(feedback.Work, n=N),
        friction=SimpleNamespace(torque=rng.normal(size=N)),
        truth=SimpleNamespace(disturbance=rng.normal(size=N)),
    )


@pytest.fixture
def state(rng):
    return SimpleNamespace(
        alpha2=rng.normal(size=N),
        disturbance=rng.normal(size=N),
        estimate=rng.normal(size=M),
        observer=SimpleNamespace(torque=rng.normal(size=N)),
        rotors=SimpleNamespace(error=rng.normal(size=N)),
    )


def settings_with(rng, decoupled=0, compensation=REFERENCE, damping_rate=0.0, **on):
    """Return settings of an arm with two links; damping is the only feedback through inertia."""
    return SimpleNamespace(
        model=arm_model(1.0, 9.8),
        n=N,
        p=P,
        m=M,
        initial_estimate=rng.normal(size=M),
        joint_inertia=np.ones(N),
        compensation=compensation,
        row=SimpleNamespace(prediction=FILTERED),
        feedback=feedback.Settings(
            gain=np.zeros(N),
            robust_gain=np.zeros(N),
            damping_rate=damping_rate,
            follows_inertia=0,
            decoupled=decoupled,
            damping_lag=np.zeros(N),
            lags=0,
        ),
        truth=SimpleNamespace(feed_forward=on.get('known', 0)),
        observer=SimpleNamespace(enabled=on.get('observed', 0)),
    )


def regressor(model, *motion):
    """Return H (n, p) at q, dq, v, a."""
    H = np.zeros((N, M))
    model.regressor(*motion, H)
    return H[:, :P]


@pytest.mark.parametrize('decoupled', [0, 1])
@pytest.mark.parametrize('compensation', [REFERENCE, STATE])
def test_model_of_before_acts_at_the_state_and_what_is_learned_where_it_is_chosen(
    rng, state, signals, decoupled, compensation
):
    """Joints that are decoupled have no feedback in either: alpha2 is dqr there."""
    settings = settings_with(rng, decoupled, compensation, damping_rate=3.0)
    compute_regressors(settings, state, signals)
    v, a = state.alpha2, signals.dalpha2
    if decoupled:
        v, a = signals.dqr, signals.ddqr
    damped = a - 3.0 * signals.xi2
    model, q, dq = settings.model, signals.q, signals.dq
    expected = regressor(model, q, dq, v, damped) @ settings.initial_estimate[:P]
    np.testing.assert_allclose(signals.model_torque, expected, rtol=1e-14)
    along = (signals.qr, signals.dqr, signals.dqr, signals.ddqr)
    chosen = along if compensation == REFERENCE else (q, dq, v, a)
    np.testing.assert_array_equal(signals.H[:, :P], regressor(model, *chosen))


def test_measured_rotors_act_on_what_the_feedback_accelerates(rng, state, signals):
    before = signals.model_torque.copy()
    signals.feedback.acceleration[:] = rng.normal(size=N)
    correct_feedback(settings_with(rng), state, signals)
    added = state.rotors.error * (signals.feedback.acceleration - signals.ddqr)
    np.testing.assert_array_equal(signals.model_torque, before + added)


@pytest.mark.parametrize('known', [0, 1])
@pytest.mark.parametrize('observed', [0, 1])
def test_demand_is_the_sum_of_feedback_model_disturbances_and_what_is_learned(
    rng, state, signals, known, observed
):
    """Of P^ only the change since P^(0) is added, which the model has; of columns all."""
    settings = settings_with(rng, known=known, observed=observed)
    learned = state.estimate.copy()
    learned[:P] -= settings.initial_estimate[:P]
    expected = 0.5 + signals.model_torque + state.disturbance + signals.friction.torque
    expected += known * signals.truth.disturbance + observed * state.observer.torque
    expected += signals.H @ learned
    demand = [compensated(settings, state, signals, i, 0.5) for i in range(N)]
    np.testing.assert_allclose(demand, expected, rtol=1e-13)

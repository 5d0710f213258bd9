# SPDX-License-Identifier: Apache-2.0
"""A sample of the law: barrier, torque and its limits, the plain law, rows of learning."""

from __future__ import annotations

import sys
from math import exp

import numpy as np
import pytest
from closed_loop_case import (
    as_printed,
    closed_loop,
    controller,
    energies,
    plant,
    quick,
    recommended,
)
from paper_case import P
from plain_law import PlainLaw, R, regressor
from plants import QUIET

from blf_dsc_controller.configuration.law_file import load_law

BOUND = 0.002


K0 = 0.02
K = 0.0015
RATE = 2.0
NARROWING = {
    'bound': np.full(2, K),
    'initial_bound': np.full(2, K0),
    'funnel_rate': RATE,
}
START = (2.2935 + 0.015, 1.6961 - 0.012)


def bound(t):
    """k(t) and k'/k."""
    wider = (K0 - K) * exp(-RATE * t)
    return K + wider, -RATE * wider / (K + wider)


def test_lyapunov_function_decreases_while_the_bound_narrows():
    """(31) for the moving bound, with a known model and no disturbance; the loop stays within."""
    model_known = {'initial_estimate': np.array([*P, 0.0, 0.0]), 'Gamma': np.zeros(5)}
    quiet = {'gamma': np.zeros(2)}
    law = controller(recommended(**NARROWING | model_known | quiet))
    arm = plant(start=START, constant=QUIET, amplitude=QUIET)
    V, ratios = [], []
    for sample in closed_loop(law, arm, 2.0):
        np.testing.assert_allclose(law.sample.bound, bound(sample.t)[0], rtol=1e-12)
        ratios.append(np.abs(law.sample.xi1 / law.sample.bound).max())
        V.append(energies(law, sample.t).sum())
    # At the first sample alpha2 jumps to the virtual control: V2 starts there.
    assert np.diff(V).max() < 1e-6 * V[0]
    assert V[-1] < 1e-3 * V[0]
    assert ratios[0] == pytest.approx(0.75, rel=1e-3)  # 15 of 20 mrad
    assert max(ratios) < 0.8


def drawn(seed):
    """Random settings of a stable loop, every option among them, and the arm in it.

    rho = 10 keeps the rounding that an ill-conditioned Phi amplifies below 1e-11, but would spoil
    the inverse iteration, so every window counts as excited.
    """
    random = np.random.default_rng(seed)
    columns = {
        'bias': bool(random.integers(2)),
        'frequencies': [(), (2.0,)][random.integers(2)],
    }
    m = quick(**columns).m
    gains = drawn_learning(random, m) | drawn_feedback(random, m)
    start = (2.297, 1.692) if random.integers(2) else (2.293, 1.696)
    arm = {'start': start, 'delay': int(random.integers(3)), 'position_noise': 1e-6}
    arm |= {'sample_time': random.choice([1e-3, 2e-3])}
    gains |= {
        'follows_inertia': int(random.integers(2)),
        'joint_inertia': random.uniform(0.2, 0.5, 2),
        'known_rate': int(random.integers(2)),
    }
    gains['decoupled'] = int(random.integers(2)) * (1 - gains['follows_inertia'])
    return quick(**columns | gains), arm


def drawn_learning(random, m):
    """Random options and gains of learning m parameters."""
    A = random.normal(size=(m, 2 * m))
    information = A @ A.T / (2 * m) + 0.2 * np.eye(m)
    return {
        'window': int(random.choice([150, 497, 2000])),
        'row_interval': int(random.integers(1, 4)),
        'interval': int(random.integers(3, 12)),
        'learning_start': random.uniform(0.4, 0.7),
        'sigma': -1.0,
        'rho': 10.0,
        'kappa': random.choice([0.0, 2.0, 50.0]),
        'information': information,
        'variance': np.diag(np.linalg.inv(information)).copy(),
        'prior_weight': random.choice([0.0, 0.1]),
        'motion_scale': random.choice([0.0, 0.05]),
        'row_weight': random.uniform(0.3, 1.0, 2),
    }


def drawn_feedback(random, m):
    """Random gains and limits of the feedback."""

    def each(low, high, n=2):
        return random.uniform(low, high, n)

    return {
        'damping_rate': random.uniform(0.0, 20.0),
        'd2': each(0.0, 300.0),
        'eta': random.uniform(0.0, 0.5),
        'gamma': each(0.0, 60.0),
        'Gamma': each(0.2, 2.0, m),
        'radius': random.choice([0.8, 10.0]),
        'least': np.append(
            [-np.inf] * 3, np.full(m - 3, random.choice([-np.inf, -0.05]))
        ),
        'most': np.append([np.inf] * 3, np.full(m - 3, random.choice([np.inf, 0.05]))),
        'K': each(60.0, 150.0),
        'mu': each(10.0, 30.0),
        'Kp': each(10.0, 20.0),
        'weight': each(300.0, 1000.0),
        'slope_limit': each(5e3, 2e4),
        'initial_bound': BOUND + random.integers(2) * each(0.0, 0.01),
        'funnel_rate': random.uniform(0.0, 3.0),
        'time_constant': random.uniform(0.0015, 0.004),
        'pole': random.uniform(20.0, 100.0),
        'torque_limit': each(9.5, 20.0),
        'rate_limit': random.choice([0.0, 300.0], 2),
    }


def test_law_matches_the_plain_one_in_closed_loop():
    """Torque, estimate, disturbance and errors agree with the oracle in every sample."""
    met = set()
    for seed in range(24):
        settings, given = drawn(seed)
        law, arm = controller(settings), plant(**given)
        plain = PlainLaw(law.settings)
        sample = law.sample
        ours, theirs = [], []
        for now in closed_loop(law, arm, 1.5):
            reference = law.reference_at(now.t)
            torque = plain.update(
                now.t, arm.period_ns * 1e-9, *reference, now.measurement
            )
            plain.tau = sample.torque.copy()
            mine = sample.torque, sample.estimate, sample.disturbance
            ours.append(np.concatenate((*mine, sample.xi1, sample.xi2)))
            plains = torque, plain.theta, plain.disturbance, plain.xi1, plain.xi2
            theirs.append(np.concatenate(plains))
            met |= {('cut', cut) for cut in sample.cuts}
            met |= {('past the bound', bool(np.any(np.abs(sample.xi1) > sample.bound)))}
            met |= {
                ('at the ball', bool(np.linalg.norm(sample.estimate[:3]) > 0.999 * 0.8))
            }
        np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-11, err_msg=seed)
        assert law.state.latch.latched[0] == 1.0
        assert plain.latched is not None
        met |= {('window full', law.state.window.rows[0] == settings.window.length)}
    assert len(met) == 4 + 3 * 2


PAPER = sys.modules[load_law('paper').__module__]


class Filter:
    """The filter (8) of two joints, as the law file `paper` has it."""

    def __init__(self, omega):
        self.omega = omega
        self.memory = PAPER.Memory(*np.zeros((2, 2)))
        self.samples = 0

    def step(self, xi2, dt):
        """Advance it by a sample."""
        begins = self.samples == 0
        PAPER.differentiate(self.memory, xi2, self.omega, begins, dt)
        self.samples += 1


def test_row_of_lambda_follows_equation_24_in_a_closed_loop():
    law = as_printed(recommended(bias=False), omega=60.0)
    for sample in closed_loop(law, plant(), 0.5):
        q, dq, applied = sample.measurement.reshape(3, 2)
        dalpha2 = law.signals.dalpha2
        alpha2 = dq - law.signals.xi2
        x = np.array([*(dalpha2 + law.state.memory[2:]), *dq, 1.0])
        y = np.array([*dalpha2, *alpha2, 1.0])
        rest = x @ y / (x @ x) * applied
        expected = np.column_stack([regressor(R, q, dq, alpha2, dalpha2), rest])
        np.testing.assert_allclose(law.signals.row.Xu, expected, rtol=1e-9, atol=1e-9)


def error_with_filter(omega):
    """Largest error of ddq^ [rad/s^2] from 0.5 s on, where the reference has 0.3."""
    law = as_printed(recommended(bias=False), omega=omega)
    found = [
        (
            sample.measurement[2:4].copy(),
            law.signals.dalpha2 + law.state.memory[2:],
        )
        for sample in closed_loop(law, plant(), 2.0)
    ]
    velocity, ours = np.array(found).transpose(1, 0, 2)
    return np.abs(ours[1:] - np.diff(velocity, axis=0) / 1e-3)[500:].max()


def test_erratum_9_frequency_of_the_filter_must_be_large():
    """The paper prints "omega sufficiently small"; the slower (8), the worse its derivative."""
    errors = [error_with_filter(omega) for omega in (5.0, 20.0, 100.0)]
    assert np.all(np.diff(errors) < 0.0)
    assert errors[-1] < 0.03 * errors[0]


def test_erratum_21_filter_starts_at_its_input_with_zero_slope():
    """From elsewhere (8) reports a false slope of up to omega z / e, which lasts for 10 / omega.

    The paper prints hatted initial values, which are unknown before the first sample.
    """
    omega = 100.0
    dt = 1e-3
    z = 0.3
    filtered = Filter(omega)
    slopes = []
    for k in range(151):
        if k == 2:
            filtered.memory.observed[:] = 0.0  # as if z^(0) had been taken for zero
        filtered.step(np.full(2, z), dt)
        slopes.append(abs(filtered.memory.rate).max())
    assert slopes[:2] == [0.0, 0.0]
    assert max(slopes) == max(slopes[:32])
    np.testing.assert_allclose(max(slopes), omega * z / np.e, rtol=0.01)
    assert slopes[int(10.0 / omega / dt) + 2] < 2e-3 * max(slopes)

# SPDX-License-Identifier: Apache-2.0
"""The controller: its state, the laws it can be, and its settings from a configuration."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from arbitrary_case import arbitrary_settings
from closed_loop_case import REFERENCE, START, R, closed_loop, controller, plant, quick, record
from numba.core.runtime import _nrt_python, rtsys
from paper_case import EXACT, NO_DISTURBANCE, P, configured, run
from plain_law import dynamics

from blf_dsc_controller.compiled.layout import pack, sizes_of
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.law.controller import update
from blf_dsc_controller.law.factory import column_names, controller_of, settings_of_config
from blf_dsc_controller.law.settings import settings_of
from blf_dsc_controller.law.state import (
    sample_of,
    sample_size,
    signals_of,
    signals_size,
    state_of,
    state_size,
)

SHAPES = [(1, 1), (2, 3), (6, 30)]


@pytest.mark.parametrize(('n', 'p'), SHAPES)
def test_vectors_are_laid_out_without_gap_or_overlap(n, p):
    """Every setting survives packing; views of state, signals and sample cover their vectors."""
    settings = arbitrary_settings(np.random.default_rng(0), n, p)
    numbers = iter(range(1000, 10_000))
    sizes = ('n', 'p', 'm', 'tones', 'drive', 'drive_size', 'weighed', 'model')
    distinct = {
        name: np.reshape([float(next(numbers)) for _ in range(value.size)], value.shape)
        if isinstance(value, np.ndarray)
        else next(numbers) + (0 if isinstance(value, int) else 0.5)
        for name, value in settings._asdict().items()
        if name not in sizes
    }
    settings = settings._replace(**distinct)
    unpacked = settings_of(pack(settings), sizes_of(settings), settings.model)
    for name, value in settings._asdict().items():
        np.testing.assert_array_equal(getattr(unpacked, name), value, err_msg=name)
        assert isinstance(getattr(unpacked, name), type(value)), name

    settings = arbitrary_settings(np.random.default_rng(0), n, p)
    for views, size in (
        (state_of, state_size(settings)),
        (signals_of, signals_size(settings)),
        (sample_of, sample_size(settings)),
    ):
        parts = views(np.arange(float(size)), settings)
        covered = np.concatenate([part.ravel() for part in parts])
        np.testing.assert_array_equal(np.sort(covered), np.arange(size))


def test_sample_contains_what_the_update_computed():
    law = controller(quick(sigma=-1.0))
    record(law, plant(), 1.3)
    for part, names in (
        (law.signals, ('qr', 'dqr', 'xi1', 'xi2', 'torque')),
        (law.state, ('disturbance', 'estimate', 'lambda_min', 'latched')),
    ):
        for name in names:
            found = getattr(law.sample, name)
            np.testing.assert_array_equal(found, getattr(part, name), err_msg=name)
            assert np.all(found != 0.0), name


def test_loop_continues_bit_for_bit_from_a_saved_state_and_begins_anew_after_a_reset():
    """The state vector is the complete state, so another controller can continue from it too."""
    law, arm = controller(quick()), plant(noise=1e-5, differenced=True, delay=2)
    begun = arm.save()

    def torques(law, first, last, saved_arm):
        arm.restore(saved_arm)
        found = []
        for k in range(first, last):
            found.append(law.update(k * 1e-3, 1e-3, arm.measure()).copy())
            arm.step(found[-1])
        return np.array(found)

    start = torques(law, 0, 1337, begun)
    saved, saved_arm = law.save(), arm.save()
    after = torques(law, 1337, 2000, saved_arm)
    assert np.any(saved != law.state_vector)
    other = controller(quick())
    for same in (law, other):
        same.restore(saved)
        np.testing.assert_array_equal(torques(same, 1337, 2000, saved_arm), after)
    law.reset()
    np.testing.assert_array_equal(torques(law, 0, 1337, begun), start)


@numba.njit
def many_updates(model, sizes, settings, law, state, signals, measurement, sample, checks, count):
    for k in range(count):
        t = k * 1e-3
        update(model, sizes, settings, law, state, signals, t, 1e-3, measurement, sample, checks)


def test_updates_in_a_compiled_loop_allocate_nothing():
    """Passing the vectors allocates a little, independently of the number of updates."""
    law = controller(quick(window=50, learning_start=0.01, sigma=-1.0))
    measurement = np.array([*START, *np.zeros(4)])
    vectors = (
        law.settings.model,
        law.sizes,
        law.settings_vector,
        REFERENCE,
        law.state_vector,
        law.signals_vector,
    )
    arguments = (*vectors, measurement, law.sample_vector, law.checks_vector)
    many_updates(*arguments, 1)
    allocations = []
    _nrt_python.memsys_enable_stats()
    try:
        for count in (100, 5000):
            before = rtsys.get_allocation_stats()
            many_updates(*arguments, count)
            after = rtsys.get_allocation_stats()
            allocations.append((after.alloc - before.alloc, after.mi_alloc - before.mi_alloc))
    finally:
        _nrt_python.memsys_disable_stats()

    assert law.state.latched[0] == 1.0
    assert allocations[0] == allocations[1]


INTERPRETED = """
from closed_loop_case import controller, plant, quick, record
settings = quick(window=100, learning_start=0.2, sigma=-1.0)
print(*record(controller(settings), plant(), 0.4).torque[-1])
"""


def test_interpreted_kernels_compute_the_same_torque():
    """Without numba's compiler only the last bits differ (its libm, its order of operations)."""
    here = Path(__file__).parent
    environment = os.environ | {
        'NUMBA_DISABLE_JIT': '1',
        'PYTHONPATH': os.pathsep.join([str(here), str(here.parent)]),
    }
    run = subprocess.run(
        [sys.executable, '-c', INTERPRETED],
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    law = controller(quick(window=100, learning_start=0.2, sigma=-1.0))
    torque = record(law, plant(), 0.4).torque[-1]

    assert law.state.latched[0] == 1.0
    np.testing.assert_allclose(np.array(run.stdout.split(), dtype=float), torque, rtol=1e-9)


ROUNDING = 1e-10
UNEVEN = {
    'feedback.gain': [40.0, 25.0],
    'feedback.boundary_layer': 0.02,
    'learning.adaptation_gain': [0.7, 1.3, 2.1],
    'comparison.surface_gain': [60.0, 35.0],
    'comparison.position_gain': [30.0, 11.0],
    'comparison.robust_gain': [0.4, 0.2],
    'comparison.leakage': 0.05,
    'learning.window': 0.4,  # which they must not learn from
    'learning.settling_time': 0.1,
    'learning.excitation_threshold': 1e-9,
}


class PlainComparison:
    """(35) as printed, P^ by Euler steps; `slotine_li` is the same without w, mu_bar and W_c."""

    def __init__(self, config, *, bare):
        gains = config.comparison
        self.Kp = np.array(config.feedback.gain)
        self.layer = config.feedback.boundary_layer
        self.Gamma = np.array(config.learning.adaptation_gain)
        self.lambda_s = np.array(gains.surface_gain)
        self.w = np.zeros(2) if bare else np.array(gains.position_gain)
        self.mu_bar = np.zeros(2) if bare else np.array(gains.robust_gain)
        self.Wc = 0.0 if bare else gains.leakage
        self.P = np.array(config.learning.initial_estimate)

    def update(self, dt, qr, dqr, ddqr, q, dq):
        z1 = q - qr
        alpha2 = dqr - self.lambda_s * z1
        dalpha2 = ddqr - self.lambda_s * (dq - dqr)
        z2 = dq - alpha2
        parts = [dynamics(e, R, q, dq) for e in np.eye(3)]
        H = np.column_stack([M @ dalpha2 + C @ alpha2 + G for M, C, G in parts])
        sat = np.clip(z2 / self.layer, -1.0, 1.0)
        torque = H @ self.P - self.Kp * z2 - self.w * z1 - self.mu_bar * sat
        self.P = self.P - dt * self.Gamma * (H.T @ z2 + self.Wc * self.P)
        return torque


@pytest.mark.parametrize('law', ['backstepping', 'slotine_li'])
def test_comparison_laws_follow_their_equations_in_a_closed_loop(law):
    config = configured('recommended', 1.0, UNEVEN | {'law': law}).controller
    controller, plain = controller_of(config), PlainComparison(config, bare=law == 'slotine_li')
    for sample in closed_loop(controller, plant(), 1.0):
        t, (q, dq, _) = sample.t, sample.measurement.reshape(3, 2)
        qr = np.array([1.9935, 1.3961]) + 0.3 * np.cos(t)
        dqr, ddqr = np.full(2, -0.3 * np.sin(t)), np.full(2, -0.3 * np.cos(t))
        torque = plain.update(1e-3, qr, dqr, ddqr, q, dq)
        np.testing.assert_allclose(controller.signals.torque, torque, atol=ROUNDING)
        np.testing.assert_allclose(controller.state.estimate[:3], plain.P, atol=ROUNDING)
    assert np.abs(controller.state.estimate[:3] - [0.5, 0.16, 0.2]).max() > 0.05  # it did adapt
    assert controller.state.latched[0] == 1.0


def test_zero_weight_of_the_prediction_error_equals_no_learning_bit_for_bit():
    """kappa = 0 against a threshold that is never reached, beyond the latch at 6.8 s.

    Without change detection, which holds the estimate where a full window is not excited.
    """
    paper = {'learning.change_detection': False}
    off = run(configured('recommended', 10.0, paper | {'learning.weight': 0.0}))
    never = run(configured('recommended', 10.0, paper | {'learning.excitation_threshold': 1e9}))
    learning = run(configured('recommended', 10.0))

    assert (off.latched[-1], never.latched[-1]) == (1.0, 0.0)
    np.testing.assert_array_equal(off.torque, never.torque)
    np.testing.assert_array_equal(off.estimate[:, :3], never.estimate[:, :3])
    assert np.abs(learning.estimate - off.estimate)[-1, :3].max() > 0.01


FROZEN = {
    'learning.initial_estimate': list(P),
    'learning.adaptation_gain': [0.0, 0.0, 0.0],
    'disturbance.gain': [0.0, 0.0],
    'truth.feed_forward': True,
}


def test_proposed_law_with_everything_known_and_frozen_equals_model_based():
    frozen = run(configured('recommended', 10.0, EXACT | FROZEN))
    model_based = run(configured('recommended', 10.0, EXACT | {'law': 'model_based'}))
    np.testing.assert_allclose(frozen.torque, model_based.torque, atol=1e-12)
    np.testing.assert_allclose(frozen.xi1, model_based.xi1, atol=1e-15)


def error_floor(changes):
    """Largest |xi1| [rad] from 1 s on of the model-based law, which knows the disturbance."""
    loop = run(configured('model_based', 8.0, changes))
    return np.abs(loop.xi1[loop.t >= 1.0]).max(axis=0)


@pytest.mark.parametrize('time_constant', [0.002, 0.016])
@pytest.mark.parametrize(
    ('gain', 'mu', 'weight'), [(150.0, 20.0, 1000.0), (60.0, 60.0, 1.0), (0.0, 40.0, 500.0)]
)
def test_error_of_the_oracle_is_the_lag_of_the_surface_filter(time_constant, gain, mu, weight):
    """alpha2 lags beta2 by lambda alpha2', which xi1 compensates.

    It does so by (K/2 + mu) xi1 in beta2, and by w xi1 = -K_p xi2 in the torque.  The reference's
    acceleration is 0.3 rad/s^2; the held torque adds half a sample to the lag.
    """
    changes = {
        'surface.time_constant': time_constant,
        'surface.gain': [gain, gain],
        'surface.mu': [mu, mu],
        'barrier.weight': [weight, weight],
    }
    rate = gain / 2.0 + mu + weight / np.array([60.0, 20.0])
    expected = (time_constant + 0.5e-3) * 0.3 / rate
    np.testing.assert_allclose(error_floor(changes), expected, rtol=0.05)


def test_lyapunov_function_of_the_oracle_decreases_to_the_floor_of_the_lag():
    """(17): V decreases in every sample until only the barrier's energy of the lag remains."""
    loop = run(configured('model_based', 8.0))
    V = loop.lyapunov.sum(axis=1)
    lag = 1000.0 * np.sum(loop.xi1[loop.t >= 1.0] ** 2, axis=1).max()  # J, twice the energy
    above = np.flatnonzero(10.0 * lag < V)
    assert above[-1] > 50  # there is a decrease to check
    assert np.all(np.diff(V[: above[-1] + 2]) < 0.0)
    assert V[0] > 1e4 * V[loop.t >= 1.0].max()


def test_learning_finds_the_parameters():
    """With exact measurements, and a sinusoid in the disturbance that no column describes."""
    assert run(configured('recommended', 20.0, {}, NO_DISTURBANCE)).parameter_error[-1] < 1e-3
    assert run(configured('recommended', 60.0)).parameter_error[-1] < 5e-4


def test_settings_follow_the_configuration():
    """Learning waits for window and filters, tau_d + T_a of (26); columns have their own gain."""
    given = {'learning.window': 0.75, 'learning.settling_time': 0.25}
    given |= {'learning.adaptation_gain': [1.0, 2.0, 3.0], 'learning.column_gain': 5.0}
    config = build(ControllerConfig, given)
    settings, columns = settings_of_config(config), len(column_names(config))
    assert settings.learning_start == 1.0
    assert settings.window == 750
    assert columns > 0
    assert settings.Gamma.tolist() == [1.0, 2.0, 3.0, *[5.0] * columns]

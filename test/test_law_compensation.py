# SPDX-License-Identifier: Apache-2.0
"""What is learned acts along the reference: a wrong estimate cannot destabilise the loop.

Each row changes the arm in its first window or disturbs it at a frequency of the reference.
Without learning the bound is held; with it, it must be too.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from paper_case import OFF, configured, several
from scipy.linalg import expm

from blf_dsc_controller.configuration.nodes import locate
from blf_dsc_controller.law import friction
from blf_dsc_controller.law.factory import controller_of, estimate_names
from blf_dsc_controller.law.state import sample_of
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import load_study
from blf_dsc_controller.studies.report import compare_pairs
from blf_dsc_controller.studies.runs import run_chunk

AT_STATE = {'learning.compensation': 'state'}
TONE = 1.2566370614359172  # rad/s, first of the presets panda and ur5e, third of the last


def event(begin, payload, duration=0.0, ramp=0.0):
    """Return parameters of a plant that picks up a payload [kg]."""
    return several({'begin': begin, 'duration': duration, 'ramp': ramp, 'payload': payload})


SINE = {'disturbance.amplitude': [0.0] * 6 + [1.2], 'disturbance.frequency': [TONE] * 7}
COSINES = {'disturbance.amplitude': [1.5, 1.5], 'disturbance.phase': [-np.pi / 2.0] * 2}
ROWS = {
    'panda, 2 kg': ('panda', 9.0, event(2.0, 2.0)),
    'panda, 0.76 kg in 0.5 s': ('panda', 9.0, event(3.4, 0.76, ramp=0.5)),
    'ur5e, 1.26 kg put down again': ('ur5e', 12.0, event(4.14, 1.26, 3.92)),
    'panda, sine on joint7': ('panda', 12.0, SINE),
    'noisy, cosines': ('noisy', 20.0, COSINES),
}
BROKEN = ('panda, 0.76 kg in 0.5 s', 'ur5e, 1.26 kg put down again')
"""Rows in which the paper's compensation leaves the bound.

Theirs are mixtures that `residual_floor` explains; that of 2 kg contradicts its parts.
"""


def spectral_radius(T, *, learned=1.0, initial=1.0, at_state=False, delay=1):
    """Return the spectral radius of one sampled joint with the default gains of a URDF, lag 4.5 ms.

    `learned` is M^ / M, `initial` is M^(0) / M, to which the gains are proportional.  The torque is
    held, `delay` samples late, with a drive of 2 ms; the velocity is filtered at 400 rad/s.  The
    states are q, dq, torque, filtered velocity, alpha2, d^3 and, with a delay, the last command.
    """
    rate, time_constant = 0.5 / (1.5 * T + 0.0045), 0.002
    n = 6 + delay
    A = np.zeros((5, 5))
    A[0, 1] = A[1, 2] = 1.0
    A[2, [2, 4]] = -1.0 / 0.002, 1.0 / 0.002
    A[3, [1, 3]] = 400.0, -400.0
    held, x, F = expm(A * T), np.eye(n), np.zeros((n, n))
    share = 1.0 - np.exp(-T / time_constant)
    beta2 = -1.5 * rate * x[0]
    dalpha2, xi2 = share * (beta2 - x[4]) / T, x[3] - x[4]
    feedback = initial * rate * (-0.25 * rate * x[0] - 0.6 * xi2) + x[5]
    command = feedback + (learned if at_state else initial) * dalpha2
    F[:4] = held[:4, :4] @ x[:4] + np.outer(held[:4, 4], x[6] if delay else command)
    F[4] = x[4] + share * (beta2 - x[4])
    F[5] = x[5] - T * 0.4 * initial * rate**2 * xi2
    F[6:] = command
    return np.abs(np.linalg.eigvals(F)).max()


@pytest.mark.parametrize(('T', 'most'), [(1e-3, 2.65), (2e-3, 2.10), (4e-3, 1.72), (5e-3, 1.63)])
def test_learned_inertia_is_a_gain_of_the_loop_only_at_the_state(T, most):
    """The paper's form is unstable from these M^ / M on; along the reference nothing depends on it.

    What remains is the initial model, whose error is known before the start: stable from a third
    of the inertia to 1.3 times, at 1 kHz 1.8 times.
    """
    assert spectral_radius(T, learned=0.99 * most, at_state=True) < 1.0
    assert spectral_radius(T, learned=1.01 * most, at_state=True) > 1.0
    assert spectral_radius(T, learned=50.0) == spectral_radius(T)
    for initial in (0.33, 1.0, 1.8 if T == 1e-3 else 1.3):
        assert spectral_radius(T, initial=initial) < 1.0


@cache
def simulated(name, *law):
    """Run a row once, with parameters of the law as pairs; return its record."""
    preset, duration, plant = ROWS[name]
    config = configured(preset, duration, dict(law), plant)
    return simulate(config.controller, config.plant)


def run(name, law):
    return simulated(name, *law.items()).run()


@pytest.mark.parametrize('name', ROWS)
def test_learning_breaks_no_bound_that_is_kept_without_it(name):
    learning, without = run(name, {}), run(name, OFF)
    assert learning.stops == without.stops == ()
    most = np.abs(without.error).max()
    assert most < without.bound[0, 0]
    assert np.abs(learning.error).max() <= 1.3 * most


@pytest.mark.parametrize('name', BROKEN)
def test_compensation_of_the_paper_breaks_them(name):
    assert [stop.reason for stop in run(name, AT_STATE).stops] == ['error past the bound']


def test_sine_of_the_frequency_of_the_reference_is_compensated_like_a_model():
    """Mistaken for parameters, it is still cancelled along the reference."""
    late = [
        found.error[found.time > 10.0]
        for found in (run('noisy, cosines', law) for law in ({}, OFF))
    ]
    rms = [np.sqrt(np.mean(error**2, axis=0)).max() for error in late]
    assert rms[0] < 0.5 * rms[1]  # 0.012, 0.096 mrad


def test_torques_that_bang_between_their_limits_stop_the_arm():
    """In the paper's form the same sine makes the loop unstable: 47 % of the torques are cut.

    None stays at its limit for 0.5 s, but more than a fifth of the samples adds up.
    """
    found = run('noisy, cosines', AT_STATE)
    (stop,) = found.stops
    assert stop.reason == 'torque saturated'
    begin = np.flatnonzero(np.any(np.abs(found.torque) >= found.torque_limit, axis=1))[0] * 1e-3
    assert begin + 0.6 < stop.stamp * 1e-9 < begin + 3.0


def test_learned_friction_stays_friction():
    """Between a third of its initial estimate and three times that; from 0 if it is unknown.

    The first windows of the UR5e see a payload come and go, and take parts of it for friction.
    """
    record = simulated('ur5e, 1.26 kg put down again')
    settings, names = record.controller.settings, estimate_names(record.config)
    friction = [k for k, name in enumerate(names) if name.startswith(('viscous ', 'coulomb '))]
    columns = sample_of(np.arange(record.samples.shape[1]), settings).estimate[friction]
    learned, initial = record.samples[:, columns], settings.initial_estimate[friction]
    assert initial.min() > 0.0
    assert np.all((learned >= initial / 3.0) & (learned <= 3.0 * initial))
    assert np.any(learned == initial / 3.0)

    planar = configured('recommended', 1.0, {'learning.coulomb': True, 'learning.viscous': True})
    settings = controller_of(planar.controller).settings
    assert np.all(settings.least[-4:] == 0.0)
    np.testing.assert_allclose(settings.most[-4:], [0.05 * 20.0 / 1.5] * 2 + [0.05 * 20.0] * 2)


COULOMB = {'learning.coulomb': True}
BROKEN_BY_FRICTION = [
    *(('monte_carlo_ur5e', run) for run in (51, 179, 200, 274)),
    ('monte_carlo_panda', 423),
]
"""Runs in which friction learned from the window alone, 0.37 to 0.9 of 0.73 to 1.23 N m on light
drives, or partial windows that are not taken back, leave a bound that is kept without learning."""

HANGS_ON_LAST_DIGITS = 179
"""Without learning, this run kept its bound with the sines of one C library, and leaves it now."""


def test_sine_at_a_frequency_of_the_reference_is_not_learned_as_friction():
    true = 0.9  # N m, in the wrist; the controller begins with 1.1 N m
    wrist = {'coulomb': (6.0, true), 'amplitude': (0.0, 1.2), 'phase': (0.0, 5.0)}
    arm = {f'disturbance.{name}': [a] * 3 + [b] * 3 for name, (a, b) in wrist.items()}
    arm |= {'events.begin': [100.0], 'disturbance.stribeck': 0.0}
    config = configured('ur5e', 15.0, {}, arm | {'disturbance.frequency': [3.0 * TONE] * 6})
    record = simulate(config.controller, config.plant)
    assert not record.run().stops
    state = record.controller.state
    first = estimate_names(config.controller).index('coulomb wrist_1_joint')
    learned, window = (
        theta[first : first + 3] / true for theta in (state.estimate, state.solution)
    )
    np.testing.assert_allclose(learned, 1.0, atol=0.2)
    assert (np.abs(window - 1.0) > 0.6).all()


@pytest.mark.parametrize(('name', 'run'), BROKEN_BY_FRICTION)
def test_learning_breaks_no_bound_that_learned_friction_once_broke(name, run):
    study = load_study(locate(name))
    study = replace(study, settings=replace(study.settings, runs=run + 1))
    found = compare_pairs(study, run_chunk(study, run, 1))
    assert found['kept'] == {'with': 1, 'without': int(run != HANGS_ON_LAST_DIGITS)}
    assert found['above'] == []


def test_friction_is_not_forgotten_at_rest():
    """The sums age by what reversals tell, not by time."""
    law = controller_of(configured('recommended', 1.0, COULOMB).controller)
    settings, state = law.settings, law.state
    state.latched[0] = 1.0
    state.flip_sums[:] = before = [[0.4, 0.1], [1.0, 1.0]]
    for _ in range(10_000):
        friction.measure_flips(settings, state, 0.001)
    np.testing.assert_array_equal(state.flip_sums, before)
    state.latched[0] = 0.0
    friction.measure_flips(settings, state, 0.001)
    assert state.since_latch[0] == 0.0


def test_other_friction_is_learned_within_some_reversals():
    """However long the arm has moved before."""
    law = controller_of(configured('recommended', 1.0, COULOMB).controller)
    settings, state = law.settings, law.state
    state.latched[0] = 1.0
    column = friction.first_coulomb(settings)
    for k in range(30_000):
        sign, coulomb = (-1.0) ** (k // 300), 1.0 if k < 24_000 else 2.0  # N m
        state.filter2[0, [column, -1]] = sign, coulomb * sign
        friction.measure_flips(settings, state, 0.001)
    assert state.flip_sums[0, 0] / state.flip_sums[1, 0] == pytest.approx(2.0, abs=0.1)

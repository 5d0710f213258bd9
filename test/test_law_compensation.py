# SPDX-License-Identifier: Apache-2.0
"""What is learned acts along the reference: a wrong estimate cannot destabilise the loop.

Each row changes the arm in its first window or disturbs it at a frequency of the reference.
Without learning the bound is held; with it, it must be too.
"""

from __future__ import annotations

import numpy as np
import pytest
from changes import OFF
from paper_case import configured
from scipy.linalg import expm

from blf_dsc_controller.law.factory import controller_of, estimate_names
from blf_dsc_controller.law.state import sample_of
from blf_dsc_controller.simulation.loop import simulate

AT_STATE = {'learning.compensation': 'state'}
TONE = 1.2566370614359172  # rad/s, first of the presets panda and ur5e


def event(begin, payload, duration=0.0, ramp=0.0):
    """Return parameters of a plant that picks up a payload [kg]."""
    row = {'begin': begin, 'duration': duration, 'ramp': ramp, 'payload': payload}
    return {f'events.{name}': [value] for name, value in row.items()}


ROWS = {
    'panda, 2 kg': ('panda', 9.0, event(2.0, 2.0)),
    'panda, 0.76 kg in 0.5 s': ('panda', 9.0, event(3.4, 0.76, ramp=0.5)),
    'ur5e, 1.26 kg put down again': ('ur5e', 12.0, event(4.14, 1.26, 3.92)),
    'panda, sine on joint7': (
        'panda',
        12.0,
        {'disturbance.amplitude': [0.0] * 6 + [1.2], 'disturbance.frequency': [TONE] * 7},
    ),
    'noisy, cosines': (
        'noisy',
        20.0,
        {'disturbance.amplitude': [1.5, 1.5], 'disturbance.phase': [-np.pi / 2.0] * 2},
    ),
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
    held = expm(A * T)
    x = np.eye(n)
    share = 1.0 - np.exp(-T / time_constant)
    beta2 = -1.5 * rate * x[0]
    dalpha2, xi2 = share * (beta2 - x[4]) / T, x[3] - x[4]
    inertia = learned if at_state else initial
    feedback = initial * rate * (-0.25 * rate * x[0] - 0.6 * xi2) + x[5]
    command = feedback + inertia * dalpha2
    F = np.zeros((n, n))
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


def run(name, law):
    preset, duration, plant = ROWS[name]
    config = configured(preset, duration, law, plant)
    return simulate(config.controller, config.plant).run(), config.controller.barrier.bound


@pytest.mark.parametrize('name', ROWS)
def test_learning_breaks_no_bound_that_is_kept_without_it(name):
    (learning, bound), (without, _) = run(name, {}), run(name, OFF)
    assert learning.stops == without.stops == ()
    most = np.abs(without.error).max()
    assert most < bound[0]
    assert np.abs(learning.error).max() <= 1.3 * most


@pytest.mark.parametrize('name', BROKEN)
def test_compensation_of_the_paper_breaks_them(name):
    found, _ = run(name, AT_STATE)
    assert [stop.reason for stop in found.stops] == ['error past the bound']


def test_sine_of_the_frequency_of_the_reference_is_compensated_like_a_model():
    """Mistaken for parameters, it is still cancelled along the reference."""
    rms = []
    for law in ({}, OFF):
        found, _ = run('noisy, cosines', law)
        rms.append(np.sqrt(np.mean(found.error[found.time > 10.0] ** 2, axis=0)).max())
    assert rms[0] < 0.5 * rms[1]  # 0.012, 0.096 mrad


def test_torques_that_bang_between_their_limits_stop_the_arm():
    """In the paper's form the same sine makes the loop unstable: 47 % of the torques are cut.

    None stays at its limit for 0.5 s, but more than a fifth of the samples adds up.
    """
    found, _ = run('noisy, cosines', AT_STATE)
    (stop,) = found.stops
    assert stop.reason == 'torque saturated'
    begin = np.flatnonzero(np.any(np.abs(found.torque) >= found.torque_limit, axis=1))[0] * 1e-3
    assert begin + 0.6 < stop.stamp * 1e-9 < begin + 3.0


def test_learned_friction_stays_friction():
    """Between a third of its initial estimate and three times that; from 0 if it is unknown.

    The first windows of the UR5e see a payload come and go, and take parts of it for friction.
    """
    preset, duration, plant = ROWS['ur5e, 1.26 kg put down again']
    config = configured(preset, duration, {}, plant)
    names = np.array(estimate_names(config.controller))
    friction = np.flatnonzero([name.startswith(('viscous ', 'coulomb ')) for name in names])
    record = simulate(config.controller, config.plant)
    settings = record.controller.settings
    columns = sample_of(np.arange(record.samples.shape[1]), settings).estimate[friction]
    learned, initial = record.samples[:, columns], settings.initial_estimate[friction]
    assert initial.min() > 0.0
    assert np.all((learned >= initial / 3.0) & (learned <= 3.0 * initial))
    assert np.any(learned == initial / 3.0)

    planar = configured('recommended', 1.0, {'learning.coulomb': True, 'learning.viscous': True})
    settings = controller_of(planar.controller).settings
    assert np.all(settings.least[-4:] == 0.0)
    most = settings.most
    np.testing.assert_allclose(most[-4:], [0.05 * 20.0 / 1.5] * 2 + [0.05 * 20.0] * 2)

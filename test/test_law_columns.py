# SPDX-License-Identifier: Apache-2.0
"""Disturbance columns: what they recover, and which are rejected as indistinguishable."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import closed_loop, controller, plant, recommended
from paper_case import configured, run

from blf_dsc_controller.law import prediction
from blf_dsc_controller.law.factory import column_names, controller_of
from blf_dsc_controller.law.settings import LATCHES
from sim_plant.plant import plant_of


def test_columns_match_their_names():
    learning = {
        'learning.viscous': True,
        'learning.coulomb': True,
        'learning.coulomb_velocity': 0.2,
        'learning.frequencies': [1.5, 4.0],
    }
    config = configured('recommended', 1.0, learning).controller
    settings = controller_of(config).settings
    t, dq = 0.7, np.array([0.3, -0.1])
    rest = np.full((2, settings.m), np.nan)

    prediction.fill_columns(settings, t, dq, rest)

    value = {'bias': (1.0, 1.0), 'viscous': dq, 'coulomb': np.tanh(dq / 0.2)}
    for w in (1.5, 4.0):
        value[f'sin {w:g} rad/s'] = np.full(2, np.sin(w * t))
        value[f'cos {w:g} rad/s'] = np.full(2, np.cos(w * t))
    names = column_names(config)
    assert len(names) == settings.m - 3 == 2 * len(value)
    for j, name in enumerate(names):
        block, joint = name.rsplit(' ', 1)
        i = config.joints.index(joint)
        expected = np.zeros(2)
        expected[i] = value[block][i]
        np.testing.assert_allclose(rest[:, 3 + j], expected, err_msg=name)


def learned(preset, duration, learning, arm):
    """Estimates by name at the end of a run, and which columns are still estimated."""
    config = configured(preset, duration, learning, arm)
    law, simulated = controller_of(config.controller), plant_of(config.plant)
    for k in range(round(duration * 1e3)):
        law.update(k * 1e-3, 1e-3, simulated.measure())
        simulated.step(law.sample.torque)
    names = column_names(config.controller)
    active = dict(zip(names, law.state.active[3:], strict=True))
    return dict(zip(names, law.state.estimate[3:], strict=True)), active


def test_friction_columns_recover_friction():
    """A sinusoidal reference distinguishes viscous from Coulomb friction by the torque's shape."""
    arm = {
        'disturbance.constant': [0.0, 0.0],
        'disturbance.amplitude': [0.0, 0.0],
        'disturbance.viscous': [0.5, 0.2],
        'disturbance.coulomb': [0.3, 0.1],
        'disturbance.coulomb_velocity': 0.05,
    }
    learning = {
        'learning.viscous': True,
        'learning.coulomb': True,
        'learning.coulomb_velocity': 0.05,
        'learning.excitation_threshold': 1e-4,
    }
    estimate, active = learned('recommended', 20.0, learning, arm)
    assert all(active.values())
    for name, true in (('viscous', (0.5, 0.2)), ('coulomb', (0.3, 0.1)), ('bias', (0.0, 0.0))):
        for joint, value in zip(('joint1', 'joint2'), true, strict=True):
            assert estimate[f'{name} {joint}'] == pytest.approx(value, abs=2e-3)


def test_cosine_columns_are_rejected_on_the_reference_of_the_paper():
    """With exact tracking cos t on both joints is the column of P2: a1 + a2 = -0.6 cos t."""
    learning = {'learning.frequencies': [1.0], 'learning.bias': False}
    estimate, active = learned('recommended', 8.0, learning, {})
    rejected = {name for name, on in active.items() if not on}

    assert any(name.startswith('cos 1 rad/s') for name in rejected)
    assert active['sin 1 rad/s joint1'] == active['sin 1 rad/s joint2'] == 1.0
    assert all(estimate[name] == pytest.approx(0.0, abs=1e-12) for name in rejected)


def test_same_columns_are_accepted_on_a_two_tone_reference():
    """Bias and sine are the whole disturbance: only the trapezoid's T^2 and the leakage remain."""
    estimate, active = learned('two_tone', 9.0, {}, {})
    assert all(active.values())
    for joint in ('joint1', 'joint2'):
        assert estimate[f'bias {joint}'] == pytest.approx(0.1, abs=1e-3)
        assert estimate[f'sin 1 rad/s {joint}'] == pytest.approx(0.1, abs=1e-3)
        assert estimate[f'cos 1 rad/s {joint}'] == pytest.approx(0.0, abs=1e-3)
    assert run(configured('two_tone', 60.0)).parameter_error[-1] < 1e-4


def test_rejected_column_has_no_effect_on_the_others():
    """It is removed from Phi and b altogether, not merely small."""
    learning = {'learning.frequencies': [1.0], 'learning.bias': False}
    config = configured('recommended', 8.0, learning)
    law, arm = controller_of(config.controller), plant_of(config.plant)
    for k in range(7991):  # ends with an evaluation of Phi
        law.update(k * 1e-3, 1e-3, arm.measure())
        arm.step(law.sample.torque)
    on = law.state.active > 0.0
    rows = law.state.ring[:, :, :-1][:, :, on].reshape(-1, on.sum())
    u = law.state.ring[:, :, -1].ravel()
    Phi, b = rows.T @ rows / law.settings.window, rows.T @ u / law.settings.window

    np.testing.assert_allclose(law.signals.Phi[np.ix_(on, on)], Phi, atol=1e-10)
    np.testing.assert_allclose(law.signals.b[on], b, atol=1e-10)
    np.testing.assert_array_equal(law.signals.Phi[np.ix_(~on, on)], 0.0)
    np.testing.assert_array_equal(law.signals.b[~on], 0.0)
    assert not on.all()
    assert np.linalg.eigvalsh(Phi)[0] >= law.settings.sigma


def test_columns_are_not_checked_before_the_parameters_alone_are_excited():
    """An arm at rest excites nothing, so no column is rejected."""
    learning = {
        'learning.frequencies': [1.0],
        'reference.amplitude': [0.0, 0.0],
        'reference.offset': [2.2935, 1.6961],
    }
    _, active = learned('recommended', 8.0, learning, {})
    assert all(active.values())


@pytest.mark.parametrize('latch', LATCHES)
def test_latch_keeps_the_last_or_the_best_excited_window(latch):
    """As the excitation decays, `last` follows it down to sigma and `max` does not."""
    settings = recommended(
        latch=LATCHES.index(latch), window=1000, learning_start=1.0, sigma=1e-9, bias=False
    )
    law = controller(settings)
    history, best = [], 0.0
    for sample in closed_loop(law, plant(), 4.0):
        if law.state.latched[0] and sample.k % settings.interval == 0:
            best = max(best, law.state.lambda_min[0])
            history.append((law.state.latched_lambda[0], law.state.lambda_min[0], best))
    held, present, best_so_far = np.array(history).T
    np.testing.assert_array_equal(held, present if latch == 'last' else best_so_far)
    assert np.any(present < best_so_far)

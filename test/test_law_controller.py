# SPDX-License-Identifier: Apache-2.0
"""The controller: its state, the laws it can be, and its settings from a configuration."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import plants
import pytest
from closed_loop_case import closed_loop, controller, plant, quick
from command import finished
from numba.core.runtime import _nrt_python, rtsys
from paper_case import NO_DISTURBANCE, P, configured, run

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.law.factory import columns_of, settings_of_config
from blf_dsc_controller.law.state import CHOICES

NOISY = {'position_noise': 1e-5, 'sensor.velocity': 'differenced', 'delay': 2}


def test_loop_continues_bit_for_bit_from_a_saved_state_and_begins_anew_after_a_reset():
    """The state vector is the complete state, so another controller can continue from it too."""
    law, arm = controller(quick()), plant(**NOISY)
    begun = arm.save()

    def torques(law, first, last, saved_arm):
        arm.restore(saved_arm)
        found = np.empty((last - first, 2))
        for k, torque in enumerate(found, start=first):
            torque[:] = law.update(k * 1e-3, 1e-3, arm.measure())
            arm.step(torque)
        return found

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


def test_measurement_may_be_any_array_of_numbers():
    law, start = controller(quick()), np.array([2.0, 2.0, 0.0, 0.0, 0.0, 0.0])
    torques = []
    for measurement in (start, np.repeat(start, 2)[::2], start.astype(int), start.tolist(), -start):
        law.reset()
        torques.append(law.update(0.0, 1e-3, measurement).tolist())
    *same, other = torques
    assert same.count(same[0]) == len(same)
    assert other != same[0]


def allocated(duration):
    """Blocks and counters of references that a run of the compiled loop of law and plant takes."""
    config = configured('noisy', duration)
    before = rtsys.get_allocation_stats()
    latched = run(config).latched[-1]
    after = rtsys.get_allocation_stats()
    return (after.alloc - before.alloc, after.mi_alloc - before.mi_alloc), latched


def test_updates_in_a_compiled_loop_allocate_nothing():
    """Passing the vectors allocates a little, independently of the number of updates."""
    run(configured('noisy', 0.1))  # compiles
    counting = _nrt_python.memsys_stats_enabled()
    _nrt_python.memsys_enable_stats()
    try:
        (short, _), (long, latched) = allocated(0.1), allocated(8.0)
    finally:
        if not counting:
            _nrt_python.memsys_disable_stats()
    assert latched == 1.0
    assert short == long


INTERPRETED = """
import json, sys
from test_law_controller import short_runs
json.dump(short_runs(), sys.stdout)
"""


def short_runs():
    """Last torque of a loop that learns, and all measurements of an imperfect plant."""
    law = controller(quick(window=100, learning_start=0.2, sigma=-1.0))
    list(closed_loop(law, plant(), 0.4))
    assert law.state.latched[0] == 1.0
    arm = plants.plant(**plants.FULL)
    return law.signals.torque.tolist(), plants.run(arm, plants.commands(100)).tolist()


def test_interpreted_kernels_compute_the_same():
    """Without numba's compiler only the last bits differ (its libm, its order of operations)."""
    here = Path(__file__).parent
    path = os.pathsep.join([str(here), str(here.parent)])
    environment = os.environ | {'NUMBA_DISABLE_JIT': '1', 'PYTHONPATH': path}
    interpreted = json.loads(finished(sys.executable, '-c', INTERPRETED, env=environment).stdout)
    for ours, theirs, rtol in zip(short_runs(), interpreted, (1e-9, 1e-10), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=rtol, atol=rtol)


@pytest.mark.parametrize(('law', 'share'), [('backstepping', 1.0), ('slotine_li', 0.0)])
def test_comparison_laws_are_the_linear_surface_with_their_gains(law, share):
    """`slotine_li` without w, mu_bar and W_c; neither learns from a window that is excited."""
    gains = {'surface_gain': [60.0, 35.0], 'position_gain': [30.0, 11.0]}
    gains |= {'robust_gain': [0.4, 0.2], 'leakage': 0.05}
    given = {f'comparison.{name}': value for name, value in gains.items()}
    config = configured('recommended', 1.0, given | {'law': law}).controller
    settings = settings_of_config(config)
    assert CHOICES['surface'][settings.surface] == 'linear'
    assert CHOICES['compensation'][settings.compensation] == 'state'
    found = (settings.weight, settings.mu_bar, settings.Wc)
    for ours, name in zip(found, ('position_gain', 'robust_gain', 'leakage'), strict=True):
        np.testing.assert_array_equal(ours, share * np.array(gains[name]))
    np.testing.assert_array_equal(settings.K, gains['surface_gain'])
    for zero in (settings.d2, settings.gamma, settings.kappa, settings.change_detection):
        assert not np.any(zero)


def test_proposed_law_with_everything_known_and_frozen_equals_model_based():
    frozen = {'learning.initial_estimate': list(P), 'disturbance.gain': [0.0] * 2}
    frozen |= {'learning.adaptation_gain': [0.0] * 3}
    known = {'law': 'model_based', 'truth.parameters': list(P)}
    frozen, model_based = (
        run(configured('recommended', 10.0, law, NO_DISTURBANCE)) for law in (frozen, known)
    )
    np.testing.assert_allclose(frozen.torque, model_based.torque, atol=1e-12)
    np.testing.assert_allclose(frozen.xi1, model_based.xi1, atol=1e-15)


@pytest.mark.parametrize('time_constant', [0.002, 0.016])
@pytest.mark.parametrize(
    ('gain', 'mu', 'weight'), [(150.0, 20.0, 1000.0), (60.0, 60.0, 1.0), (0.0, 40.0, 500.0)]
)
def test_error_of_the_oracle_is_the_lag_of_the_surface_filter(time_constant, gain, mu, weight):
    """The model-based law knows the disturbance, but alpha2 lags beta2 by lambda alpha2'.

    xi1 compensates it by (K/2 + mu) xi1 in beta2, and by w xi1 = -K_p xi2 in the torque.  The
    reference's acceleration is 0.3 rad/s^2; the held torque adds half a sample to the lag.
    """
    gains = {'surface.gain': gain, 'surface.mu': mu, 'barrier.weight': weight}
    changes = {name: [value] * 2 for name, value in gains.items()}
    loop = run(configured('model_based', 8.0, {'surface.time_constant': time_constant, **changes}))
    rate = gain / 2.0 + mu + weight / np.array([60.0, 20.0])
    expected = (time_constant + 0.5e-3) * 0.3 / rate
    np.testing.assert_allclose(loop.largest(1.0), expected, rtol=0.05)


def test_lyapunov_function_of_the_oracle_decreases_to_the_floor_of_the_lag():
    """(17): V decreases in every sample until only the barrier's energy of the lag remains."""
    loop = run(configured('model_based', 8.0))
    V = loop.lyapunov.sum(axis=1)
    lag = 1000.0 * np.sum(loop.xi1[loop.t >= 1.0] ** 2, axis=1).max()  # J, twice the energy
    above = np.flatnonzero(10.0 * lag < V)
    assert above[-1] > 50  # there is a decrease to check
    assert np.all(np.diff(V[: above[-1] + 2]) < 0.0)
    assert V[0] > 1e4 * V[loop.t >= 1.0].max()


def test_settings_follow_the_configuration():
    """Learning waits for window and filters, tau_d + T_a of (26)."""
    given = {'learning.window': 0.75, 'learning.settling_time': 0.25}
    given |= {'learning.adaptation_gain': [1.5, 2.0, 3.0]}
    config = build(ControllerConfig, given)
    settings, columns = settings_of_config(config), len(columns_of(config))
    assert settings.learning_start == 1.0
    assert settings.window == 750
    assert columns > 0
    assert settings.Gamma.tolist() == [1.5, 2.0, 3.0, *[1.0] * columns]

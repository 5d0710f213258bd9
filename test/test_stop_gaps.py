# SPDX-License-Identifier: Apache-2.0
"""An arm that leaves command, and while its states have gaps, gets no faster."""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import CONFIG

from blf_dsc_controller import load_loop
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.supervision.braking import braking_matrix, within_gap
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.last_state import LastState
from sim_plant.plant import plant_of

START = 1_000_000_000  # ns
MILLISECOND = 1_000_000  # ns


def left_in_motion(preset, leave, gap, seconds, after=1.0):
    """Return the speeds (n,) [rad/s] of 0.2 s before an arm leaves command, and after that.

    From then on its states come every `gap` [s], between which the drives hold the torque.
    """
    loop = load_loop(CONFIG / f'{preset}.yaml')
    config = change(loop.controller, {'safety.torque': 'hold_gravity'})
    T, n = config.sample_time, len(config.joints)
    plant = plant_of(loop.plant)
    guard = Guard(config)
    guard.starting.activate()

    def run(duration, every):
        speeds = []
        for k in range(round(duration / T)):
            if k % every == 0:
                measurement = plant.measure().copy()
                torque = guard.update(START + plant.elapsed_ns, measurement).copy()
            plant.step(torque)
            speeds.append(np.abs(plant.truth()[-n:]))
        return np.array(speeds)

    before = run(seconds, 1)[-round(0.2 / T) :].max(axis=0)
    assert guard.supervisor.running, guard.supervisor.text
    leave(guard)
    return before, run(after, max(1, round(gap / T))).max(axis=0)


@pytest.mark.parametrize('gap', [0.03, 0.11])
@pytest.mark.parametrize('preset', ['panda', 'fr3', 'ur5e'])
def test_ramp_of_a_deactivation_lasts_as_long_while_states_have_gaps(preset, gap):
    """It counted states: the arm accelerated on, to 28, 8.8 and 9.3 rad/s."""
    before, speeds = left_in_motion(preset, Guard.deactivate, gap, 2.3)
    assert (speeds - before).max() < 0.3
    assert speeds.max() < 1.1 * before.max() + 0.2


def test_damping_of_a_stop_drives_no_arm_whose_states_have_gaps():
    """A Panda, every 0.11 s: 30 1/s of damping made it 2.4 rad/s fast, and ever faster."""
    before, speeds = left_in_motion('panda', lambda each: each.fail('x'), 0.11, 3.1)
    assert speeds.max() < 1.2 * before.max()


def test_deactivation_makes_no_joint_faster_by_half_a_second_of_its_last_torque():
    """A UR5e that accelerates: by 0.16 rad/s before."""
    before, speeds = left_in_motion('ur5e', Guard.deactivate, 0.0, 2.3)
    assert (speeds - before).max() < 0.1


@pytest.mark.parametrize('gap', [0.03, 0.05, 0.11])
@pytest.mark.parametrize('seed', range(3))
def test_damping_that_is_held_for_a_gap_reverses_no_motion_of_the_model(gap, seed):
    settings = settings_of_config(load_loop(CONFIG / 'panda_rigid.yaml').controller)
    draw = np.random.default_rng(seed)
    q = draw.uniform(-1.5, 1.5, settings.n)
    P = settings.initial_estimate[: settings.p]
    M = inertia_matrices(settings.model, P, q[np.newaxis])[0]
    damping = draw.uniform(5.0, 40.0, settings.n) * np.diagonal(M)
    coupled = braking_matrix(settings, damping, q, gap)
    alone = np.diag(within_gap(settings, damping, q, gap))
    for D in (coupled, alone):
        kept = np.linalg.eigvals(np.eye(settings.n) - gap * np.linalg.solve(M, D))
        assert kept.real.min() > -1e-9
        assert kept.real.max() <= 1.0
    np.testing.assert_array_equal(within_gap(settings, damping, q, 0.0), damping)


def test_gaps_are_remembered_for_a_quarter_of_a_second():
    last = LastState(1)
    found = []
    for stamp in (1, 2, 4, 54, 84, 85, 304, 305, 306, 900):
        last.measure_gaps((START + stamp * MILLISECOND,), 1e-3)
        found.append(last.gap)
    expected = [0.0, 0.0, 0.0, 0.05, 0.05, 0.05, 0.219, 0.219, 0.219, 0.25]
    np.testing.assert_allclose(found, expected, atol=1e-9)

# SPDX-License-Identifier: Apache-2.0
"""Stability margins and expected errors of the gains derived from a URDF, at three sample rates."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load, load_loop, locate
from blf_dsc_controller.law.factory import settings_of_config
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.supervision.gains import expected_errors, transition

ARMS = [('panda', 7), ('ur5e', 6), ('fr3', 7)]


def configured(preset, sample_time, changes=None):
    given = {'sample_time': sample_time, **(changes or {})}
    return load(locate(preset), 'blf_dsc_controller', ControllerConfig, given)


def inertias(config, settings):
    limits = config.limits.position_lower, config.limits.position_upper
    q = np.random.default_rng(1).uniform(*limits, (8, len(config.joints)))
    return inertia_matrices(settings.model, np.array(config.learning.initial_estimate), q)


def growth(settings, T, lag, M, M0, stiffness):
    """Largest factor by which errors grow from sample to sample; the loop is stable below 1."""
    A, _ = transition(settings, T, lag, M, M0, stiffness)
    return np.abs(np.linalg.eigvals(A)).max()


@pytest.mark.parametrize('sample_time', [0.001, 0.002, 0.004])
@pytest.mark.parametrize('preset', ['panda', 'ur5e', 'fr3'])
def test_default_gains_have_margins_at_every_rate(preset, sample_time):
    """Inertias coupled, with the barrier at its softest and at its stiffest."""
    config = configured(preset, sample_time)
    settings = settings_of_config(config)
    lag, M0 = config.robot.lag, inertias(config, settings)
    later = lag + 1.5 * sample_time
    assert growth(settings, sample_time, lag, M0 / 1.5, M0, settings.weight) < 1.0
    assert growth(settings, sample_time, later, M0, M0, settings.weight) < 1.0
    assert growth(settings, sample_time, lag, M0, M0, settings.slope_limit) < 1.0


def test_a_surface_filter_of_two_samples_costs_the_margin_at_low_rates():
    found, lighter = [], (1.3, 1.5)
    for factor in (1.0, 2.0):
        config = configured('panda', 0.004, {'surface.time_constant': factor * 0.004})
        settings = settings_of_config(config)
        M0, size = inertias(config, settings), partial(growth, settings, 0.004, config.robot.lag)
        found.append([size(M0 / x, M0, settings.weight) < 1.0 for x in lighter])
    assert found == [[True, True], [True, False]]


def test_gains_follow_the_sample_time():
    fast, slow = (configured('panda', T) for T in (0.001, 0.004))
    assert slow.feedback.damping_rate < fast.feedback.damping_rate
    assert (fast.surface.time_constant, slow.surface.time_constant) == (0.0015, 0.004)
    planar = [
        load(locate('noisy'), 'blf_dsc_controller', ControllerConfig, each)
        for each in ({}, {'sample_time': 0.004})
    ]
    settings = map(settings_of_config, (fast, slow, *planar))
    intervals = [(each.row_interval, each.interval) for each in settings]
    assert intervals == [(10, 50), (2, 12), (1, 10), (1, 2)]


@pytest.mark.parametrize(('preset', 'n'), ARMS)
@pytest.mark.parametrize(
    'sample_time', [0.001, *(pytest.param(T, marks=pytest.mark.nightly) for T in (0.002, 0.004))]
)
def test_expected_peak_at_a_pick_up_is_that_of_the_simulated_arm(preset, n, sample_time):
    """The largest of ten moments of the simulated motion; the bound is far away."""
    largest = 0.0
    for begin in np.arange(8.0, 13.0, 0.5).tolist():
        controller = {'sample_time': sample_time, 'barrier.bound': [0.05] * n}
        plant = {
            'sample_time': sample_time,
            'duration': begin + 0.5,
            'events.begin': [begin],
            'events.duration': [9.0],
            'events.payload': [2.0],
            'truth.rotor_factor': 1.0,
        }
        loop = load_loop(preset, {'blf_dsc_controller': controller, 'sim_plant': plant})
        run = simulate(loop.controller, loop.plant).run()
        assert not run.stops
        largest = max(largest, np.abs(run.error[run.time >= begin]).max())
    config = configured(preset, sample_time, {'robot.payload': 2.0})
    expected = expected_errors(config, settings_of_config(config)).pick_up.max()
    assert 0.85 * largest < expected < 1.45 * largest  # friction, which it lacks, helps

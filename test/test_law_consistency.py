# SPDX-License-Identifier: Apache-2.0
"""Learning from consistent windows: the bound holds when the arm changes during learning."""

from __future__ import annotations

import numpy as np
import pytest
from nights import at_night
from paper_case import (
    BOUND,
    CHANGED,
    OFF,
    ROWS,
    WINDOW,
    P,
    configured,
    end_of,
    payload,
    run_preset,
    several,
)

from blf_dsc_controller import load_loop, simulate

DIFFERENCED = {
    'sensor.velocity': 'differenced',
    'sensor.position_noise': 1e-5,
    'actuator.delay': 1,
}
SENSORS = {
    'ideal': {},
    'noisy': DIFFERENCED,
    '16 bit': DIFFERENCED | {'sensor.resolution': 2.0 * np.pi / 2**16},
    'noisy velocity': {'sensor.velocity_noise': 1e-3, 'actuator.delay': 1},
}


REAL = [(name, list(SENSORS)[1 + k % 3]) for k, name in enumerate(ROWS)]
IDEAL = [(name, 'ideal') for name in ROWS]


@pytest.mark.parametrize(
    ('name', 'sensors'), [*REAL[::3], *at_night(*REAL[1::3], *REAL[2::3], *IDEAL)]
)
def test_bound_holds_when_the_arm_changes(name, sensors):
    """Nor is the error larger than 1.3 times that without learning, or 0.25 mrad after a ramp.

    Without learning the arm is up to 0.09 mrad off before the change, sometimes to the side from
    which the change pushes it back: that alone makes the ratio 1.21 for a tenth of a kilogram.
    """
    row = ROWS[name]
    plant = row | SENSORS[sensors]
    learning, without = (run_preset(end_of(row), plant, law=law) for law in ({}, OFF))
    assert np.all(learning.largest(0.0) < BOUND)
    begin = min(row['events.begin'])
    quantisation = 0.5 * plant.get('sensor.resolution', 0.0)
    # so small that 1.3 times is too strict
    gentle = 0.25e-3 if 'events.ramp' in row else 0.0
    allowed = np.maximum(1.3 * without.largest(begin), gentle) + quantisation
    assert np.all(learning.largest(begin) <= allowed)
    assert 1.0 <= learning.changes[-1] <= 6.0
    assert learning.parameter_error[-1] < 0.01


def test_change_is_known_before_its_window_is_full():
    """5 of 6.3 s after it; 3 % are left without the pull to the estimate before."""
    assert run_preset(CHANGED + 5.1, payload(0.75)).error_at(CHANGED + 5.0) < 0.025


def test_another_change_takes_back_what_a_partial_window_taught_without_a_step():
    """5.5 of 6.3 s after the first; the torque would jump by 3 N m."""
    first, second = CHANGED, CHANGED + 5.5
    load = {'payload': 0.25}
    loaded = run_preset(
        second + 1.0, several(load | {'begin': first}, load | {'begin': second})
    )
    before, after = np.searchsorted(loaded.t, (second - 0.1, second + 0.5))
    assert loaded.error_at(second - 0.1) < 0.025
    # as before the first change, but for 0.4 s of tracking errors
    np.testing.assert_allclose(loaded.estimate[after, :3], P, atol=0.08)
    steps = np.abs(np.diff(loaded.torque[before:after], axis=0))
    assert steps.max() < 0.5


def test_estimate_is_hardly_off_while_something_pushes():
    """No window in which a push comes or goes is learned from, though no change is found."""
    row = ROWS['push (0, 3.0, 3.0)']
    pushed = run_preset(end_of(row), row)
    assert pushed.parameter_error[pushed.t > row['events.begin'][0]].mean() < 0.03


def test_push_that_lasts_does_not_restart_learning_again_and_again():
    """Sideways, as no load pulls.  It was 38 changes in 3 s.

    Meanwhile it is taken for noise; a load that comes on 4 s later is found all the same.
    """
    loaded = 10.0  # s
    events = {
        'events.begin': [3.0, loaded],
        'events.duration': [3.0, 0.0],
        'events.payload': [0.0, 0.6],
        'events.force': [0.0, 14.0, 0.0, 0.0, 0.0, 0.0],  # N
    }
    learning, without = (
        run_preset(11.5, events, preset='panda', law=law) for law in ({}, OFF)
    )
    before, after = np.searchsorted(learning.t, (loaded, loaded + 1.0))
    assert learning.changes[before] <= 10.0
    assert learning.changes[after] == learning.changes[before] + 1.0
    is_pushed = (learning.t > 6.5) & (learning.t < loaded)
    assert np.linalg.norm(learning.xi1[is_pushed]) < 0.9 * np.linalg.norm(
        without.xi1[is_pushed]
    )


@pytest.mark.parametrize('preset', ['recommended', 'noisy', 'excitation', 'two_tone'])
def test_no_change_is_found_without_one(preset):
    assert run_preset(30.0, preset=preset).changes[-1] == 0.0


def test_estimate_does_not_drift_at_rest_with_noise():
    """The second parameter used to drift from 0.16 to 0.48 kg m^2 in the first minute.

    The tracking error adapts the estimate until the first full window; as that window is not
    excited, the estimate is held from then on.
    """
    standing = run_preset(60.0, preset='noisy', law={'reference.type': 'hold'})
    assert np.ptp(standing.parameter_error[standing.t > WINDOW + 0.1]) == 0.0
    assert np.all(standing.largest(1.0) < 0.5 * BOUND)


def test_rest_after_a_motion_replaces_nothing_that_it_taught():
    """Its windows are excited enough for seconds, but ever weaker: once they taught 5 % less."""
    steps = np.arange(14)
    ways = np.column_stack((2.293 - 0.5 * (steps % 2), 1.696 - 0.4 * (steps // 2 % 2)))
    law = {
        'reference.type': 'waypoints',
        'reference.times': [0.0, *(1.0 + 1.5 * steps).tolist()],
        'reference.waypoints': [2.293, 1.696, *ways.ravel().tolist()],
    }
    moved = run_preset(28.0, law=law)
    assert moved.parameter_error[-1] == pytest.approx(moved.error_at(20.0), rel=0.02)


def test_column_rejected_at_rest_is_readmitted_in_motion():
    """Hold for a while, then move: the first full window is half at rest and rejects the bias."""
    steps = np.arange(25)
    law = {
        'reference.type': 'waypoints',
        'reference.times': [0.0, *(10.0 + 1.5 * steps).tolist()],
        'reference.waypoints': [
            *(2.293, 1.696),
            *np.column_stack(
                (2.293 - 0.5 * (steps % 2), 1.696 - 0.4 * (steps // 2 % 2))
            )
            .ravel()
            .tolist(),
        ],
    }
    constant = {
        'disturbance.constant': [0.3, -0.2],
        'disturbance.amplitude': [0.0, 0.0],
    }
    moved = run_preset(45.0, constant, law=law)
    assert np.all(moved.controller.state.latch.active == 1.0)
    assert moved.parameter_error[-1] < 0.01


@pytest.mark.parametrize(
    ('preset', 'begin', 'duration', 'mass'),
    [
        ('noisy', 2.0, 0.0, 0.5),
        ('noisy', 4.0, 0.0, 0.3),
        ('panda_rigid', 2.0, 25.0, 2.0),
    ],
)
def test_first_window_that_spans_a_change_is_not_latched(preset, begin, duration, mass):
    """0.1 s after the first latch, the estimate explains the torque of the changed arm.

    Mixtures used to be latched, wrong by 0.5, 7.3 and 1.2 N m then.
    """
    events = several({'begin': begin, 'duration': duration, 'payload': mass})
    config = configured(preset, 11.0, {}, events)
    record = simulate(config.controller, config.plant)
    settings = record.controller.settings
    state = record.controller.state
    samples = [record.sample(k) for k in range(0, len(record.samples), 50)]
    first = next(k for k, sample in enumerate(samples) if sample.latched[0] == 1.0)
    rows = state.window.ring[: int(state.window.rows[0])].reshape(-1, settings.m + 1)
    for sample in samples[first + 2 :]:
        error = rows[:, :-1] @ np.nan_to_num(sample.estimate) - rows[:, -1]
        assert settings.n * np.mean(error**2) < 4.0 * settings.excitation.residual_floor


def rms_error(preset, duration, begin, law=None, arm=None):
    config = configured(preset, duration, law, arm)
    run = simulate(config.controller, config.plant).run()
    return np.sqrt((run.error[run.time > begin] ** 2).sum(axis=1).mean())


@pytest.mark.parametrize('preset', ['panda', *at_night('ur5e', 'fr3_direct')])
def test_joints_with_gains_of_their_own_learn_before_the_first_window_is_full(preset):
    """The errors of the first 5 s used to be those without learning."""
    errors = [rms_error(preset, 5.0, 2.0, law) for law in ({}, OFF)]
    assert errors[0] < 0.9 * errors[1]


@pytest.mark.parametrize('begin', [2.5, *at_night(2.6, 2.9)])
def test_load_that_is_held_for_a_moment_of_the_first_window_leaves_no_friction(begin):
    """Its pick-up was in a reversal, and looked like up to 3 N m of friction.

    The errors that followed were 3, 2.4 and 1.9 times those without learning.
    """
    load = several({'begin': begin, 'duration': 1.5, 'payload': 2.0})
    errors = [rms_error('fr3_direct', 8.0, 5.0, law, load) for law in ({}, OFF)]
    assert errors[0] < 1.3 * errors[1]


def test_friction_that_was_learned_outlasts_a_change_of_the_arm():
    """A load says nothing of it.  It went back to what was assumed, twice what there is.

    The last joint is left out: it just reverses for the first time.
    """
    load = several({'begin': 4.0, 'duration': 0.0, 'payload': 1.0})
    learning = run_preset(4.3, load, preset='panda')
    first = learning.controller.settings.friction.first_coulomb
    found = learning.estimate[:, first : first + 6]
    assert learning.changes[-1] == 1.0
    np.testing.assert_allclose(found[-1], found[3990], rtol=0.1)
    assert (found[-1] < 0.7 * found[0]).all()


def test_half_the_rated_load_is_noticed_with_a_floor_that_is_three_times_too_large():
    """As of a URDF with placeholder efforts; the configured floor alone hides this pick-up."""
    floor = load_loop('panda_rigid').controller.learning.residual_floor
    law = {'learning.residual_floor': [3.0 * each for each in floor]}
    event = several({'begin': 9.0, 'duration': 0.0, 'payload': 1.5})
    config = configured('panda_rigid', 10.0, law, event)
    record = simulate(config.controller, config.plant)
    assert [record.sample(row).changes[0] for row in (9000, 9200, -1)] == [
        0.0,
        1.0,
        1.0,
    ]

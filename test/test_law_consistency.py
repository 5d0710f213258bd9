# SPDX-License-Identifier: Apache-2.0
"""Learning from consistent windows: the bound holds when the arm changes during learning."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import recommended
from paper_case import (
    BOUND,
    CHANGED,
    NO_DISTURBANCE,
    OFF,
    ROWS,
    WINDOW,
    configured,
    end_of,
    instead,
    payload,
    run_preset,
    several,
)
from symbols import replaced

from blf_dsc_controller import load_loop, simulate
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law import excitation, learning, window
from blf_dsc_controller.law.innovation import Prior
from blf_dsc_controller.law.state import settings_of

FRICTION = {'disturbance.viscous': [0.1, 0.1]}
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


CASES = [
    (name, sensors)
    for k, name in enumerate(ROWS)
    for sensors in ('ideal', list(SENSORS)[1 + k % 3])
]


@pytest.mark.parametrize(('name', 'sensors'), CASES)
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
    assert learning.changes[-1] >= 1.0
    assert learning.parameter_error[-1] < 0.01


def test_push_that_lasts_does_not_restart_learning_again_and_again():
    """Sideways, as no load pulls.  It was 38 changes in 3 s."""
    push = {
        'events.begin': [3.0],
        'events.duration': [3.0],
        'events.payload': [0.0],
        'events.force': [0.0, 14.0, 0.0],  # N
    }
    learning, without = (
        run_preset(8.0, push, preset='panda', law=law) for law in ({}, OFF)
    )
    assert learning.changes[-1] <= 10.0
    after = learning.t > 6.5
    assert np.linalg.norm(learning.xi1[after]) < 0.9 * np.linalg.norm(
        without.xi1[after]
    )


def test_residual_matches_least_squares():
    controller = run_preset(8.0, NO_DISTURBANCE | FRICTION).controller
    settings = controller.settings
    state = controller.state
    assert settings.excitation.change_detection == 1
    rows = state.window.ring.reshape(-1, settings.m + 1)
    _, squares, _, _ = np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)
    # The residual is a few rows old.
    assert state.latch.residual[0] == pytest.approx(
        squares[0] / settings.window.length, rel=0.05
    )


def test_estimate_does_not_drift_at_rest_with_noise():
    """The second parameter used to drift from 0.16 to 0.48 kg m^2 in the first minute.

    The tracking error adapts the estimate until the first full window; as that window is not
    excited, the estimate is held from then on.
    """
    standing = run_preset(60.0, preset='noisy', law={'reference.type': 'hold'})
    assert np.ptp(standing.parameter_error[standing.t > WINDOW + 0.1]) == 0.0
    assert np.all(standing.largest(1.0) < 0.5 * BOUND)


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


def sliding_of(controller):
    """The sliding window of a controller."""
    return window.Window(
        controller.settings.window,
        controller.state.window,
        controller.signals.scratch.window,
    )


def prior_of(settings):
    """What is known of theta before any row."""
    return Prior(settings.initial_estimate, settings.information)


def evaluate(controller):
    """Fill the equations of the window, and their factor."""
    active = controller.state.latch.active
    prior = prior_of(controller.settings)
    window.find_excitation(sliding_of(controller), prior, active, 60)


def accept(controller):
    """Whether the window is accepted, with its solution."""
    settings = controller.settings
    return excitation.accept_window(
        settings.excitation,
        controller.state.latch,
        controller.signals.scratch.latch,
        sliding_of(controller),
        prior_of(settings),
        settings.model,
        controller.signals.q,
    )


def test_rejected_column_stays_zero_and_is_checked_again():
    """Also in a window that is pulled to the anchor; all are readmitted where nothing is excited.

    Unless they are checked again then, no window would ever be latched.
    """
    controller = run_preset(8.0, law={'learning.frequencies': [1.0]}).controller
    state = controller.state
    rejected = state.latch.active == 0.0
    assert rejected.any()
    assert state.latch.columns_checked[0] == 1.0
    state.latch.anchor[rejected] = 0.1
    state.window.rows[0] *= 0.5  # the window seems not to be full
    evaluate(controller)
    assert accept(controller)
    np.testing.assert_array_equal(state.latch.solution == 0.0, rejected)

    state.window.running[:] = 0.0
    state.window.cursor[0] = 0.0
    excitation.readmit_columns(
        controller.settings.excitation,
        state.latch,
        sliding_of(controller),
        prior_of(controller.settings),
        controller.settings.p,
    )
    assert state.latch.columns_checked[0] == 0.0


def test_window_after_a_change_may_be_partial_and_stays_near_the_estimate_before():
    learning = run_preset(CHANGED + 5.0, payload(0.75)).controller
    assert learning.state.latch.latched[0] == 1.0
    assert learning.state.window.rows[0] < learning.settings.window.length
    off = np.abs(learning.state.estimate - learning.state.latch.anchor)
    assert off.max() < 0.5


def test_change_detection_is_off_for_rows_of_lambda_which_contradict_each_other_on_any_arm():
    config = configured('recommended', 1.0, instead(prediction='lambda'))
    assert settings_of_config(config.controller).excitation.change_detection == 0


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


@pytest.mark.parametrize('preset', ['panda', 'ur5e', 'fr3_direct'])
def test_joints_with_gains_of_their_own_learn_before_the_first_window_is_full(preset):
    """The errors of the first 5 s used to be those without learning."""
    errors = [rms_error(preset, 5.0, 2.0, law) for law in ({}, OFF)]
    assert errors[0] < 0.9 * errors[1]


@pytest.mark.parametrize('begin', [2.5, 2.6, 2.9])
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


def test_lasting_disturbance_above_the_floor_does_not_end_learning():
    """Its first window is split once, since its parts never agree, and then accepted."""
    learning = run_preset(30.0, {'disturbance.amplitude': [1.5, 1.5]}, preset='noisy')
    state = learning.controller.state
    assert state.latch.split_residual[0] > 0.0
    assert state.latch.latched[0] == 1.0
    assert state.window.rows[0] == learning.controller.settings.window.length


@pytest.fixture(scope='module')
def window_of_friction():
    """A full latched window of unmodelled friction, its controller, and the state of that."""
    controller = run_preset(8.0, FRICTION).controller
    controller.retune(controller.law, replaced(controller.settings, residual_floor=0.0))
    controller.settings = settings_of(
        controller.settings_vector, controller.settings.model
    )
    evaluate(controller)
    assert accept(controller)
    return controller, controller.save()


@pytest.fixture
def learned(window_of_friction):
    """That controller, and the residual."""
    controller, saved = window_of_friction
    controller.restore(saved)
    evaluate(controller)
    return controller, float(controller.state.latch.residual[0])


@pytest.mark.parametrize(
    ('ratio', 'accepted', 'pulled'),
    [(1.2, True, 0), (3.0, True, 1), (3.9, True, 1), (4.1, False, 0)],
)
def test_window_is_latched_up_to_four_times_the_least_residual(
    learned, ratio, accepted, pulled
):
    """An unusual residual pulls it to the anchor, by 3 (r^2 - 1.25 r^2_least) R."""
    controller, residual = learned
    signals = controller.signals
    before = np.diag(signals.scratch.window.Phi).copy()
    controller.state.latch.least_residual[0] = residual / ratio
    assert accept(controller) == accepted
    information = np.diag(controller.settings.information)
    expected = 3.0 * (1.0 - 1.25 / ratio) * residual * information * pulled
    np.testing.assert_allclose(
        np.diag(signals.scratch.window.Phi) - before, expected, rtol=1e-6, atol=1e-12
    )


@pytest.mark.parametrize(
    ('ratio', 'rows', 'changes', 'taken_back'),
    [(7.9, 0.5, 0.0, False), (8.1, 1.0, 1.0, False), (8.1, 0.5, 1.0, True)],
)
def test_change_is_detected_from_eight_times_the_residual_on(
    learned, ratio, rows, changes, taken_back
):
    """What a window taught before it was full is taken back, and the torque stays the same."""
    controller, residual = learned
    settings, state, signals = controller.settings, controller.state, controller.signals
    signals.row.Xu[:] = 0.0
    signals.row.Xu[0, -1] = np.sqrt(ratio * residual)
    state.window.rows[0] = rows * settings.window.length
    state.latch.anchor[:] = 0.9 * state.estimate
    before = state.estimate.copy()
    torque = signals.H @ state.estimate + state.disturbance
    learning.detect_change(settings, state, signals, 0.1)
    assert state.change.changes[0] == changes
    np.testing.assert_array_equal(
        state.estimate, 0.9 * before if taken_back else before
    )
    # The next, partial windows are pulled to the estimate from before.
    assert np.array_equal(state.latch.anchor, state.estimate) == (changes == 1.0)
    np.testing.assert_allclose(
        signals.H @ state.estimate + state.disturbance, torque, atol=1e-12
    )


@pytest.mark.parametrize(
    ('latched', 'cursor', 'kept'),
    [(0.0, 100.0, True), (1.0, 100.0, False), (1.0, 0.0, True)],
)
def test_anchor_is_kept_at_the_first_latch_and_once_per_window(
    learned, latched, cursor, kept
):
    controller, _ = learned
    state = controller.state
    state.latch.anchor[:] = 0.0
    state.latch.latched[0], state.window.cursor[0] = latched, cursor
    assert accept(controller)
    assert np.array_equal(state.latch.anchor, state.latch.solution) == kept


def test_residual_floor_follows_the_residual_learned():
    settings = recommended(residual_floor=1.0).excitation
    for least, residual, expected in (
        (0.0, 0.2, 1.0),  # no full window yet: as configured
        (0.05, 0.1, 0.2),  # the best window left a quarter of this
        (0.5, 0.1, 1.0),  # never above the configured floor
        (1e-9, 1e-9, 0.01),  # nor below a tenth of its torque
        (0.05, 3.0, 3.0),
    ):
        found = excitation.explained(settings, least, residual)
        assert found == pytest.approx(expected)


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

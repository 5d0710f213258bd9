# SPDX-License-Identifier: Apache-2.0
"""The checks of each sample, each alone: sensor, repeats, effect of commands, kept estimates."""

from __future__ import annotations

import numpy as np
import pytest
from law_part import part

from blf_dsc_controller.law import (
    effect,
    kept_estimates,
    oscillation,
    repeats,
    sensor,
    torque,
)

N = 2
DT = 1e-3  # s
LIMITS = torque.Settings(
    limit=np.array([10.0, 20.0]),
    rate_limit=np.zeros(N),
    effort_is_whole=1,
    drive=0,
    drive_size=0,
    drive_chain=np.zeros(0),
    drive_inertias=np.zeros(0),
)
STEP = 1e-4  # rad, of an encoder
NOTHING = np.zeros(N)


def contradicted(velocity_of, waves=0.0, duration=2.0):
    """Whether the velocities contradict the positions of joints that swing by 0.2 rad at 1 Hz.

    `velocity_of` returns what is measured (N,) at a time, given position and velocity.
    """
    state, shaking = part(sensor.State, n=N), part(oscillation.State, n=N)
    shaking.waves[:], shaking.half[:] = waves, 0.01
    w = 2.0 * np.pi
    found = False
    for k in range(round(duration / DT)):
        t = k * DT
        q = 0.2 * np.sin(w * t) * np.ones(N)
        measured = velocity_of(t, 0.2 * w * np.cos(w * t) * np.ones(N))
        reading = np.concatenate((q, measured, NOTHING))
        found = found or sensor.compare_velocities(state, shaking, DT, DT, reading)
    return found


@pytest.mark.parametrize(
    ('velocity_of', 'expected'),
    [
        (lambda _, dq: dq, False),
        (lambda t, _: 0.4 * np.pi * np.cos(2.0 * np.pi * (t - 0.006)), False),  # a lag
        (lambda _, dq: dq * [1.0, 0.0], True),  # stuck
        (lambda _, dq: dq * [-1.0, 1.0], True),  # of the wrong sign
        (lambda _, dq: dq * [1.0, 0.2], True),  # in other units
    ],
)
def test_velocity_is_that_of_its_positions(velocity_of, expected):
    assert contradicted(lambda t, dq: velocity_of(t, dq) * np.ones(N)) == expected


@pytest.mark.parametrize(
    ('mismatch', 'waves', 'expected'),
    [
        (0.49, 0.0, False),  # of the mean square of the larger velocity
        (0.51, 0.0, True),
        (0.51, 2.0, False),  # a lag explains it, in a fast oscillation ...
        (0.91, 2.0, True),  # ... but not this
    ],
)
def test_mismatch_that_a_lag_explains_counts_where_nothing_oscillates_fast(
    mismatch, waves, expected
):
    state, shaking = part(sensor.State, n=N), part(oscillation.State, n=N)
    state.speed[:] = 1.0  # (rad/s)^2
    state.mismatch[1] = mismatch
    shaking.waves[1], shaking.half[1] = waves, 0.01  # s: 50 Hz
    assert sensor.is_contradicted(state, shaking, 1, 0.03) == expected


def test_noise_and_step_are_those_of_the_sensor():
    """Half of the readings repeat the other ones: a step of 0.1 mrad, a noise of a second one."""
    random = np.random.default_rng(0)
    state = part(sensor.State, n=N)
    noise = random.normal(0.0, 0.01, (5000, N))
    steps = random.integers(0, 3, (5000, N)) * STEP
    for q, dq in zip(steps, noise, strict=True):
        reading = np.concatenate((q, dq, NOTHING))
        sensor.measure_noise(state, DT, reading)
        state.readings[0] += 1.0
    np.testing.assert_allclose(state.resolution, STEP, rtol=1e-9)
    np.testing.assert_allclose(state.noise[N:], 1e-4, rtol=0.3)  # over 0.5 s
    assert sensor.position_changed(state, 0, 8.1 * np.sqrt(state.noise[0]))
    assert not sensor.position_changed(state, 0, 1.4 * STEP)


@pytest.mark.parametrize(
    ('readings', 'used'),
    [
        ([0.0, 0.1, 0.2], [0.0, 0.1, 0.2]),
        # as far as the joint moves at 1 rad/s, for up to three samples
        ([0.0, 0.1, 0.1, 0.1, 0.1, 0.1], [0.0, 0.1, 0.101, 0.102, 0.103, 0.1]),
        ([0.1, 0.1], [0.1, 0.101]),
    ],
)
def test_repeated_reading_is_continued_at_its_velocity(readings, used):
    state = part(repeats.State, n=1)
    found = []
    for k, q in enumerate(readings):
        repeats.bridge(state, np.array([q, 1.0, 5.0]), k == 0, DT, DT)
        found.append(state.used[0])
        assert state.used[1:].tolist() == [1.0, 5.0]
        assert state.read[0] == q
    assert found == pytest.approx(used)


@pytest.mark.parametrize(
    ('ratio', 'is_sound', 'begins', 'kept'),
    [
        (0.2, True, False, True),
        (0.3, True, False, False),  # larger than the smallest recent one, 0.25
        (0.3, True, True, True),
        (0.2, False, False, False),
    ],
)
def test_estimates_of_the_smallest_recent_error_are_kept(ratio, is_sound, begins, kept):
    state = part(kept_estimates.State, n=N, m=3)
    observed = np.array([0.5, 0.0])
    kept_estimates.keep(state, np.arange(3.0), np.array([7.0, 8.0]), observed)
    assert state.kept.tolist() == [0.0, 1.0, 2.0, 7.5, 8.0]
    state.least_ratio[0] = 0.25
    scale = np.array([0.5, 0.6])
    kept_estimates.keep_consistent(state, scale, ratio, is_sound, begins, DT)
    assert (state.consistent[-1] == 8.0) == kept
    assert (state.consistent_scale[1] == 0.6) == kept
    # one that is not kept is relaxed: the least error doubles in a second or so
    assert state.least_ratio[0] == (ratio if kept else 0.25 * (1.0 + DT / 1.4))


def sample(command, q=NOTHING, qr=NOTHING, effort=NOTHING, **given):
    """A sample of an arm in the middle of its run."""
    return effect.Sample(
        **{
            'q': np.array(q),
            'qr': np.array(qr),
            'effort': np.array(effort),
            'command': np.array(command),
            'added': NOTHING,
            'begins': False,
            'dt': DT,
        }
        | given
    )


def states():
    """State of the check, and a sensor that resolves 0.1 mrad."""
    readings = part(sensor.State, n=N)
    readings.resolution[:] = STEP
    return part(effect.State, n=N), readings


@pytest.mark.parametrize(
    ('command', 'q', 'qr', 'effort', 'missing'),
    [
        (
            3.0,
            0.0,
            0.1,
            np.nan,
            True,
        ),  # by 0.3 of the limit, and the reference moves on
        (0.9, 0.0, 0.1, np.nan, False),  # less than a tenth
        (3.0, 1e-3, 0.1, np.nan, False),  # a joint moves
        (3.0, 1e-4, 0.1, np.nan, True),  # not by more than a step of its encoder
        (3.0, 0.0, 0.0, np.nan, False),  # the reference rests
        (3.0, 0.0, 0.1, 3.0, False),  # measured torques show the effect
    ],
)
def test_commands_have_no_effect_if_they_change_and_nothing_moves(
    command, q, qr, effort, missing
):
    state, readings = states()
    state.compares[0] = float(np.isfinite(effort))
    first = sample(NOTHING, begins=True)
    assert effect.check_effect(LIMITS, state, readings, first) == (False, True)
    found = []
    for _ in range(200):  # 0.2 s: commands are averaged over 50 ms
        now = sample([command, 0.0], [q, 0.0], [qr, 0.0], [effort, 0.0])
        found.append(effect.check_effect(LIMITS, state, readings, now)[0])
    assert any(found) == missing
    assert not any(found[:49])  # it waits past the chatter of an encoder's steps


@pytest.mark.parametrize(
    ('lack', 'compares', 'lacking'),
    [(0.9, 1.0, False), (1.1, 1.0, True), (1.1, 0.0, False)],
)
def test_effort_lacks_a_tenth_of_the_limit_for_a_tenth_of_a_second(
    lack, compares, lacking
):
    state, _ = states()
    state.compares[0] = compares
    found = [
        effect.compare_effort(
            LIMITS,
            state,
            sample([5.0, 0.0], effort=[5.0 - lack, 0.0]),
            moves=False,
        )
        for _ in range(500)
    ]
    assert found[-1] == lacking
    # the average over 50 ms is past 1 N m after 0.12 s
    assert not any(found[:210])
    assert effect.effort_follows(state, NOTHING) == (compares == 1.0 and not lacking)


def test_lack_by_a_wrong_model_of_the_drive_counts_once_it_changes_at_rest():
    """The drive adds 2 N m more than its model says: no fault, whatever it is in motion."""
    state, _ = states()
    state.compares[0] = 1.0
    limits = LIMITS._replace(drive=1)
    told = {'added': np.array([1.0, 0.0])}
    for moves in (True, False):
        for k in range(500):
            begins = moves and k == 0
            now = sample([5.0, 0.0], effort=[4.0, 0.0], **told, begins=begins)
            assert not effect.compare_effort(limits, state, now, moves)
    np.testing.assert_allclose(state.shortfall, [2.0, 0.0])
    now = sample([5.0, 0.0], effort=[2.0, 0.0], **told)
    found = [effect.compare_effort(limits, state, now, moves=False) for _ in range(500)]
    assert found[-1]

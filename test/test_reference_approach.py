# SPDX-License-Identifier: Apache-2.0
"""Approaches within the limits, and starts from anywhere: the bound holds, or a rejection."""

from __future__ import annotations

import numpy as np
import pytest
from fault_table import Rig

import blf_dsc_controller as blf
from blf_dsc_controller.reference.approach import (
    blend,
    plan_start,
    reference_of,
    stop,
)
from blf_dsc_controller.reference.terms import (
    minimum_jerk,
    pack,
    sampled,
    sinusoids_term,
)

JOINTS = ('shoulder', 'elbow')
PAPER = sinusoids_term((1.9935, 1.3961), (0.3, 0.3), (1.0,), (0.0,))
POINTS = minimum_jerk(
    np.array([0.0, 5.0, 11.0]), np.array([[0.0, 1.0], [1.0, -1.0], [0.3, 0.0]])
)
T0 = 1.7  # s
AT_REST = np.array([[-0.4, 2.9], [0.0, 0.0]])
MOVING = np.array([[0.8, 1.5], [0.6, -0.9]])


def limits(velocity=(1.5, 1.0)):
    given = {
        'joints': list(JOINTS),
        'limits.position_lower': [-6.0, -6.0],
        'limits.position_upper': [6.0, 6.0],
        'limits.velocity': list(velocity),
        'limits.acceleration': [4.0, 1.5],
    }
    return blf.change(blf.ControllerConfig(), given)


def approach_to(main, start, limits):
    """Motion to `main` from a measured state."""
    return blend([stop(T0, *start, limits)], main, T0, limits)


def maxima(motion, end):
    """Largest velocity and acceleration of each joint from T0 on (2, n)."""
    fine = np.linspace(T0, end, 100_001)
    return np.abs(sampled(motion.vector, fine)[:, 1:]).max(axis=0)


def at(vector, t):
    return sampled(vector, np.array([t]))[0]


@pytest.mark.parametrize('main', [PAPER, POINTS], ids=['sinusoids', 'points'])
@pytest.mark.parametrize('start', [AT_REST, MOVING], ids=['at rest', 'moving'])
def test_approach_leads_from_the_measured_state_to_the_reference_as_fast_as_allowed(
    main, start
):
    motion = approach_to(main, start, limits())
    before = motion.settled - 1e-7
    after = motion.settled
    np.testing.assert_allclose(at(motion.vector, T0), [*start, (0.0, 0.0)], atol=1e-12)
    for t in (after, after + 1.0, 1e4):
        np.testing.assert_array_equal(at(motion.vector, t), at(pack(2, [main]), t))
    # 1e-5 allows for the jerk over 1e-7 s: position, velocity and acceleration do not
    # jump.
    np.testing.assert_allclose(
        at(motion.vector, before), at(motion.vector, after), atol=1e-5
    )
    # The planner looks at times a 200th of the approach apart or closer: it misses at
    # most 0.1 %.
    allowed = limits().limits.velocity, limits().limits.acceleration
    assert np.all(maxima(motion, motion.settled + 10.0) <= 1.001 * np.array(allowed))
    begin = stop(T0, *start, limits())
    with pytest.raises(blf.MotionError):
        blend([begin], main, T0, limits(), 0.98 * (motion.settled - T0))


def test_motion_beyond_the_limits_is_rejected_with_the_name_of_the_joint():
    with pytest.raises(blf.MotionError, match=r"'elbow' .*limits\.velocity"):
        approach_to(PAPER, AT_REST, limits(velocity=(1.0, 0.25)))
    start = MOVING.copy()
    start[1, 0] = -1.7  # too fast already
    with pytest.raises(blf.MotionError, match=r"at most 30 s.*'shoulder'.*-1\.5 rad/s"):
        approach_to(PAPER, start, limits())


CONFIG = blf.ControllerConfig()
FIRST = np.array([2.2935, 1.6961])  # qr(0)
STILL = np.zeros(2)
BOUND = 2e-3  # rad
STARTS = FIRST + np.random.default_rng(7).uniform(-2.0, 2.0, (4, 2))


def run(config, start, duration, velocity=(0.0, 0.0)):
    """The run of an arm from a state."""
    initial = {'initial.position': [*start], 'initial.velocity': [*velocity]}
    plant = blf.change(blf.PlantConfig(), initial | {'duration': float(duration)})
    return blf.simulate(config, plant).run()


@pytest.mark.parametrize('start', STARTS, ids=range(4))
def test_arm_reaches_the_reference_from_anywhere_within_the_bound(start):
    found = run(CONFIG, start, 12.0)
    assert np.abs(found.error).max() < BOUND
    np.testing.assert_allclose(found.reference[0], start, atol=1e-12)
    nominal = sampled(reference_of(CONFIG), found.time)[:, 0]
    away = np.abs(found.reference - nominal).max(axis=1)
    settled = found.time[away > 1e-14].max()
    assert 0.5 < settled < 5.0  # a step of 2 rad at 1.5 rad/s takes 2.5 s


@pytest.mark.parametrize(
    ('speed', 'frequency', 'upper', 'share'),
    [
        (0.6, 1.0, 6.0, 0.6),
        (0.0, 1.0, 6.0, 1.0),  # from rest
        (0.011, 1.0, 6.0, 1.0),  # which is a step of the velocity of a Damiao motor
        (1.0, 1.0, 6.0, 1.0),  # it would take 4.8 s
        # braked by half of 2 rad/s^2 within 0.27 rad from 2.3 rad, by half of 1.2 in 0.45 rad
        (0.6, 1.0, 2.65, 1.0),
        (0.6, 2.2, 6.0, 1.0),  # the reference itself has 1.45 rad/s^2
    ],
)
def test_arm_in_motion_is_taken_over_gently_where_that_is_possible(
    speed, frequency, upper, share
):
    changes = {'limits.position_upper': [upper] * 2, 'reference.frequency': [frequency]}
    config = blf.change(CONFIG, changes)
    start, velocity = np.array([2.3, 1.4]), np.array([speed, 0.0])
    motion = plan_start(config, np.full(2, BOUND), start, velocity)
    t = np.linspace(0.0, motion.settled, 10_000)
    q, _, ddq = sampled(motion.vector, t).transpose(1, 0, 2)
    used = (np.abs(ddq) / config.limits.acceleration).max()
    assert used <= share * 1.001
    assert used > 0.6 * 1.001 or share < 1.0
    assert q.max() <= upper


def test_fast_reference_is_approached_through_rest_at_its_middle():
    """At 99.7 % of the velocity limit it leaves too little speed to cover four radians directly."""
    changes = {
        'reference.amplitude': [0.748, 0.748],
        'reference.frequency': [2.0],
        'limits.acceleration': [3.0, 3.0],
    }
    config = blf.change(CONFIG, changes)
    start = np.array(config.reference.offset) + 4.0
    motion = plan_start(config, np.full(2, BOUND), start, STILL)
    assert motion.settled <= 30.0
    t = np.linspace(0.0, motion.settled + 5.0, 20_000)
    q, dq, ddq = sampled(motion.vector, t).transpose(1, 0, 2)
    np.testing.assert_allclose(q[0], start)
    assert np.all(np.abs(dq) <= config.limits.velocity)
    assert np.all(np.abs(ddq) <= config.limits.acceleration)
    assert np.abs(np.diff(q, axis=0)).max() < 1e-2
    after = t >= motion.settled
    np.testing.assert_array_equal(
        q[after], sampled(reference_of(config), t[after])[:, 0]
    )


def test_hold_reference_stays_where_the_arm_is_or_where_it_comes_to_rest():
    config = blf.change(CONFIG, {'reference.type': 'hold'})
    found = run(config, FIRST - 0.7, 1.0)
    np.testing.assert_array_equal(found.reference, np.tile(FIRST - 0.7, (1001, 1)))
    assert np.abs(found.error).max() < BOUND
    found = run(config, FIRST, 6.0, velocity=(0.5, -0.5))
    # at half of 2 rad/s^2, on average, from 0.5 rad/s: 3 v / 4 s
    brakes = 0.5 * (3.0 * 0.5 / 2.0) * np.array([0.5, -0.5])
    np.testing.assert_allclose(found.reference[-1], FIRST + brakes, atol=1e-12)
    assert np.abs(found.error).max() < 0.5 * BOUND


def test_reference_continues_after_a_deactivation_but_begins_anew_after_a_stop():
    rig = Rig()
    rig.step(500)
    rig.guard.deactivate()
    rig.step(1)
    rig.guard.starting.activate()
    rig.step(500)
    assert rig.guard.reference.time == pytest.approx(1.0)
    rig.deliver(b'')
    rig.step(1)
    rig.guard.starting.activate()
    rig.step(1)
    assert rig.supervisor.running
    assert rig.guard.reference.time == 0.0

# SPDX-License-Identifier: Apache-2.0
"""Back into command in motion: the arm gets no faster than it is, or than the reference asks."""

from __future__ import annotations

import re

import numpy as np
import pytest
from random_arm import CONFIG

from blf_dsc_controller import load_loop
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.motion_groups import MotionLimits, Reference
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.reference.approach import AT_REST, plan_start
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.start import prepared_start
from sim_plant.plant import plant_of

START = 1_000_000_000  # ns
LOAD = {'events.begin': [0.0], 'events.duration': [1e6], 'events.payload': [2.0]}
SLACK = {'sinusoids': 0.15, 'hold': 0.08}
"""rad/s: what a model that is up to 30 % off adds to the reference's speed, in any run.

At most 0.12 in 80 draws, and 0.05 where the arm is to hold.  An FR3 whose reference started
at rest got 0.6 to 1.7 faster in 4 of 8.
"""


class Arm:
    """A preset's arm, as its config file says, under the law with other limits of the rate."""

    def __init__(self, preset, rate, draw, load=()):
        loop = load_loop(CONFIG / f'{preset}.yaml')
        config = loop.controller
        limits = self._limits(config, rate)
        given = {
            'safety.torque': 'hold_gravity',
            'torque.rate_limit': limits,
            'safety.oscillation': 'warn',  # a start in motion shakes the gears of a UR5e
        }
        self.config = change(config, given)
        self.guard = Guard(self.config)
        self.guard.starting.activate()
        self.plant = plant_of(change(loop.plant, dict(load)))
        self._draw = draw

    @staticmethod
    def _limits(config, rate):
        """Return `rate` [1/s] times the torque limits, at most what the drives of a file bear."""
        limits = rate * np.array(config.torque.limit)
        if config.torque.rate_limit:
            limits = np.minimum(limits, config.torque.rate_limit)
        return limits.tolist()

    def run(self, shortest, longest):
        """Run for a random time [s]; return the speeds (k, n) [rad/s] and those asked for."""
        T, n = self.config.sample_time, len(self.config.joints)
        rows = []
        for _ in range(round(self._draw.uniform(shortest, longest) / T)):
            stamp = START + self.plant.elapsed_ns
            speed = self.plant.truth()[-n:].copy()
            torque = self.guard.update(stamp, self.plant.measure().copy())
            asked = self.guard.controller.sample.dqr
            rows.append((speed, asked * self.guard.has_sample))
            self.plant.step(torque)
        return np.abs(rows).transpose(1, 0, 2)


# Each with a limit at which a run from rest keeps its bounds, by torque limit and second.
ARMS = {
    'fr3': 5.0,  # elastic, with a driver of 10 to 75
    'ur5e_driver': 5.0,  # elastic, with a driver of 20 to 14
    'ur5e': 5.0,  # elastic
    'panda_rigid': 3.0,
}


@pytest.mark.parametrize('reference', ['sinusoids', 'hold'])
@pytest.mark.parametrize('back', ['activate', 'reset'])
@pytest.mark.parametrize('preset', ARMS)
def test_arm_that_is_taken_over_in_motion_gets_no_faster_than_it_is_asked_to(
    preset, back, reference
):
    """Deactivated in motion, and back at a random speed, within a random rate limit."""
    draw = np.random.default_rng(len(back) + len(reference))
    lowest = ARMS[preset]
    arm = Arm(preset, draw.uniform(lowest, 10.0 * lowest), draw)
    arm.run(1.0, 2.5)
    assert arm.guard.supervisor.running, arm.guard.supervisor.text
    arm.guard.deactivate()
    arm.guard.retune(change(arm.config, {'reference.type': reference}))
    leaving, _ = arm.run(0.005, 0.1)  # by 0.3 s it may rest
    before = leaving[-1]
    assert before.max() > 0.1
    getattr(arm.guard.starting, back)()
    speed, asked = arm.run(1.0, 1.0)
    assert arm.guard.supervisor.running, arm.guard.supervisor.text
    over = speed.max(axis=0) - np.maximum(before, asked.max(axis=0))
    assert over.max() < SLACK[reference]


@pytest.mark.parametrize('seconds', [6.25, 6.3, 6.35, 6.4, 3.7])
def test_arm_that_forgets_its_load_in_motion_gets_no_faster_than_it_is_asked_to(
    seconds,
):
    """A reset of the UR5e with 2 kg that nobody has told of, where it must turn round.

    The law, which has forgotten the load, is up to 10 mrad off at 0.6 of `limits.acceleration`.
    At all of it, the first four had 0.18 to 0.22 rad/s.
    """
    arm = Arm('ur5e_driver', np.inf, np.random.default_rng(0), LOAD)
    before, _ = arm.run(seconds, seconds)
    arm.guard.starting.reset()
    speed, asked = arm.run(0.6, 0.6)
    assert arm.guard.supervisor.running, arm.guard.supervisor.text
    most = np.maximum(before[-100:].max(axis=0), asked.max(axis=0))
    assert (speed.max(axis=0) - most).max() < SLACK['sinusoids']


@pytest.mark.parametrize(('preset', 'seconds'), [('ur5e_driver', 7.2), ('panda', 6.0)])
def test_arm_that_is_reset_at_rest_gets_no_faster_than_before_or_asked(preset, seconds):
    """After a stop, with 2 kg that nobody has told of: by 0.17 and 0.24 rad/s before.

    The load fell, and the way back took all of `limits.acceleration`, by a model without it.
    The UR5e, which carries it, had 0.14 with that.
    """
    arm = Arm(preset, np.inf, np.random.default_rng(0), LOAD)
    before, _ = arm.run(seconds, seconds)
    arm.guard.fail('by hand')
    arm.run(2.0, 2.0)
    arm.guard.starting.reset()
    speed, asked = arm.run(0.6, 0.6)
    assert arm.guard.supervisor.running, arm.guard.supervisor.text
    most = np.maximum(before[-200:].max(axis=0), asked.max(axis=0))
    assert (speed.max(axis=0) - most).max() < 0.1  # rad/s


@pytest.mark.parametrize('preset', ['fr3', 'panda'])
def test_wrist_of_an_arm_that_is_reset_in_motion_does_not_fall_with_its_load(preset):
    """It got 0.2 rad/s too fast in 20 ms, until the feedback caught it."""
    arm = Arm(preset, np.inf, np.random.default_rng(0), LOAD)
    before, _ = arm.run(4.5, 4.5)
    arm.guard.starting.reset()
    speed, asked = arm.run(0.08, 0.08)
    most = np.maximum(before[-200:].max(axis=0), asked.max(axis=0))
    assert (speed.max(axis=0) - most).max() < SLACK['hold']


@pytest.mark.parametrize('preset', ['fr3', 'ur5e_driver'])
def test_first_torque_in_motion_continues_the_one_that_acts(preset):
    """Within the rate limit of the file; without it the first one jumps."""
    arm = Arm(preset, np.inf, np.random.default_rng(0))
    arm.run(1.5, 1.5)
    arm.guard.deactivate()
    arm.run(0.05, 0.05)
    last = arm.guard.safe_torque.commanded.copy()
    arm.guard.starting.reset()
    arm.run(arm.config.sample_time, arm.config.sample_time)
    first = arm.guard.safe_torque.commanded
    step = np.array(arm.config.torque.rate_limit) * arm.config.sample_time
    assert arm.guard.controller.samples == 1
    assert np.all(np.abs(first - last) <= step * (1.0 + 1e-9))


def test_restarted_controller_says_that_the_arm_still_moves():
    """Its first torque is a step for drives that got none before."""
    arm = Arm('fr3', np.inf, np.random.default_rng(0))
    arm.run(1.5, 1.5)
    speed = np.abs(arm.plant.truth()[-7:]).max()
    small = {'torque.first_step': [0.01] * 7}  # N m
    arm.guard = Guard(change(arm.config, small))
    arm.guard.starting.activate()
    arm.guard.update(START + arm.plant.elapsed_ns, arm.plant.measure().copy())
    text = str(arm.guard.starting.error)
    assert 'the arm still moves' in text
    said = float(re.search(r'at ([\d.]+) rad/s: start again when it rests', text)[1])
    assert said == pytest.approx(speed, rel=0.05)  # as measured


@pytest.mark.parametrize(
    ('away', 'speed', 'fits'),
    [
        (0.0, 0.0, True),
        (0.04, 0.9 * AT_REST, True),
        (0.0, 1.1 * AT_REST, False),
        (0.06, 0.0, False),  # of the bound
    ],
)
def test_start_that_was_planned_from_rest_is_not_used_in_motion(away, speed, fits):
    config = load_loop(CONFIG / 'ur5e.yaml').controller
    bound = Guard(config).controller.bound_at(0.0)
    n = len(config.joints)
    q, joint = np.full(n, 0.1), np.eye(n)[2]
    prepared = prepared_start(config, bound, q)
    beside = q + away * np.array(config.barrier.bound) * joint
    assert prepared.fits(config, bound, beside, -speed * joint) == fits


@pytest.mark.parametrize(
    ('q', 'dq', 'text'),
    [
        (0.0, 2.0, 'at 2 rad/s, and its limit is 1.5 rad/s: wait until it is slower'),
        # 3 v / 2 a to rest, at 1.4 rad/s and 4 rad/s^2, are 0.735 rad
        (2.5, 1.4, 'would be held at 3.235 rad'),
    ],
)
def test_arm_that_cannot_be_held_within_its_limits_is_refused(q, dq, text):
    limits = MotionLimits((-3.0,) * 2, (3.0,) * 2, (1.5,) * 2, (4.0,) * 2)
    config = ControllerConfig(limits=limits, reference=Reference(type='hold'))
    position, velocity = np.array([q, 0.0]), np.array([dq, 0.0])
    with pytest.raises(StartError, match=re.escape(text)):
        plan_start(config, np.full(2, 0.1), position, velocity)

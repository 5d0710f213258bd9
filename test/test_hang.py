# SPDX-License-Identifier: Apache-2.0
"""A controller that hangs in motion and goes on: no joint gets faster by that than it was.

Beside it, a drive holds the last torque, or the watchdog brings the arm to rest.
"""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import CONFIG

from blf_dsc_controller import load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.reference.terms import evaluate
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.supervision import running_reference
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.last_state import LastState
from blf_dsc_controller.supervision.model_torque import needed_torque
from blf_dsc_controller.supervision.recent_motion import RecentMotion
from blf_dsc_controller.supervision.supervisor import Phase, Reason
from blf_dsc_controller.supervision.torque_watchdog import TorqueWatchdog
from sim_plant.plant import plant_of

START = 1_000_000_000  # ns
TIMEOUT = 0.05  # s, of the watchdog
PERIOD = 0.004  # s, of its checks
LOAD = {'events.begin': [0.0], 'events.duration': [1e6], 'events.payload': [2.0]}
PATIENT = {'safety.state_timeout': 10.0, 'safety.overrun_fraction': 1.0}
SLACK = 0.2
"""rad/s: what a load of 2 kg that nobody knows adds while it is observed, as in `soak_motion`.

At most 0.15 was seen, of a UR5e that goes on; before, 1.2 of it and 0.95 of an FR3.
"""


class Loop:
    """A preset's arm in motion, its controller, and a watchdog beside it."""

    def __init__(self, preset, given=None, *, load=True, watched=True):
        loop = load_loop(CONFIG / f'{preset}.yaml')
        holding = {'safety.torque': 'hold_gravity'}
        self.config = change(loop.controller, holding | (given or {}))
        self.guard = Guard(self.config)
        self.guard.starting.activate()
        self.plant = plant_of(change(loop.plant, LOAD if load else {}))
        self.line = TorqueWatchdog(self.config, TIMEOUT) if watched else None
        self.torque = None
        self.n = len(self.config.joints)

    @property
    def speed(self):
        return np.abs(self.plant.truth()[-self.n :])

    def state(self):
        return START + self.plant.elapsed_ns, self.plant.measure().copy()

    def answer(self, stamp, measurement):
        """Let the controller answer a state; its torque replaces that of the watchdog."""
        self.torque = self.guard.update(stamp, measurement).copy()
        if self.line is not None:
            now = self.plant.sample * self.config.sample_time
            self.line.torque_of_controller(self.torque, now)

    def run(self, seconds, *, hangs=False):
        """Return the speeds (k, n) [rad/s], and those that the reference asks for."""
        rows = []
        for _ in range(round(seconds / self.config.sample_time)):
            state = self.state()
            speed = self.speed
            if not hangs:
                self.answer(*state)
            asked = np.abs(self.guard.controller.sample.dqr) * self.guard.has_sample
            rows.append((speed, asked))
            self._watch(*state)
            self.plant.step(self.torque)
        return np.array(rows).transpose(1, 0, 2)

    def _watch(self, stamp, measurement):
        if self.line is None:
            return
        T = self.config.sample_time
        self.line.state(stamp, measurement, self.plant.sample * T)
        period = T if self.line.active else PERIOD
        if self.plant.sample % max(1, round(period / T)) == 0:
            torque = self.line.poll(self.plant.sample * T)
            self.torque = self.torque if torque is None else torque.copy()

    def hang(self, seconds, *, queued):
        """Hang; the state of the middle may still be in the queue, and is answered first."""
        self.run(0.5 * seconds, hangs=True)
        waiting = self.state()
        self.run(0.5 * seconds, hangs=True)
        if queued:
            self.answer(*waiting)


CASES = [
    (preset, watched, given)
    for preset in ('fr3', 'ur5e_driver', 'ur5e', 'panda')
    for watched in (True, False)
    for given in (({}, PATIENT) if preset in ('fr3', 'ur5e_driver') else ({},))
]


@pytest.mark.parametrize(('preset', 'watched', 'given'), CASES)
def test_controller_that_goes_on_after_a_hang_makes_no_joint_faster(
    preset, watched, given
):
    """At random moments, for random times, with and without a load that nobody knows.

    Without a watchdog the torque that is held drives the arm on, an FR3 with 2 kg to 7 rad/s
    in a second: where one joint is braked from 2 rad/s, another may be dragged along, but
    none gets faster than the fastest.
    """
    draw = np.random.default_rng(CASES.index((preset, watched, given)))
    longest = 2.0 if watched else 0.4
    for queued in (False, True):
        loop = Loop(preset, given, load=not queued, watched=watched)
        before, _ = loop.run(draw.uniform(1.0, 2.5))
        assert loop.guard.supervisor.running, loop.guard.supervisor.text
        loop.hang(np.exp(draw.uniform(np.log(0.05), np.log(longest))), queued=queued)
        least = np.maximum(before[-200:].max(axis=0), loop.speed)
        if not watched:
            least[:] = least.max()
        speed, asked = loop.run(0.6)
        over = speed.max(axis=0) - np.maximum(least, asked.max(axis=0))
        assert over.max() < SLACK, (queued, over)


@pytest.mark.parametrize('preset', ['fr3', 'ur5e_driver'])
def test_arm_that_nobody_commands_goes_on_as_its_reference_until_the_watchdog_brakes_it(
    preset,
):
    """The torque that is held keeps its acceleration a: |v + a s| after a silence of s.

    By up to 0.12 rad/s faster than before in the 52 ms of the watchdog, at the 2.3 rad/s^2 of
    these references.  Damping then sees the velocity behind a low pass of 0.03 s, and friction
    that was overcome passes for a load at first: by up to 0.17 rad/s beyond that.
    """
    draw = np.random.default_rng(3)
    for _ in range(4):
        loop = Loop(preset, PATIENT)
        before, _ = loop.run(draw.uniform(1.5, 4.0))
        law, T = loop.guard.controller, loop.config.sample_time
        _, v, a = motion = np.zeros((3, loop.n))
        evaluate(law.reference_vector, loop.guard.reference.time, *motion)
        silence = 0
        while not loop.line.active:
            loop.run(T, hangs=True)
            silence += 1
        assert silence * T <= TIMEOUT + PERIOD + 2.0 * T
        goes_on = np.abs(v + a * silence * T)
        speed, _ = loop.run(0.3, hangs=True)
        over = speed.max(axis=0) - np.maximum(before[-200:].max(axis=0), goes_on)
        assert over.max() < SLACK


@pytest.mark.parametrize(
    ('preset', 'moment', 'seconds', 'queued'),
    [('fr3', 1.3, 0.12, False), ('ur5e_driver', 5.3, 0.09, True)],
)
def test_law_that_goes_on_does_not_pull_a_braked_arm_to_its_reference(
    preset, moment, seconds, queued
):
    """Within its bound, but at another velocity: by 0.95 and 1.2 rad/s before."""
    loop = Loop(preset, PATIENT)
    before, _ = loop.run(moment)
    loop.hang(seconds, queued=queued)
    least = np.maximum(before[-200:].max(axis=0), loop.speed)
    speed, asked = loop.run(0.6)
    over = speed.max(axis=0) - np.maximum(least, asked.max(axis=0))
    assert over.max() < SLACK


@pytest.mark.parametrize('late', [0.033, 0.052])
def test_plan_that_takes_longer_than_a_gap_is_not_made_again(monkeypatch, late):
    """On a slow computer.  The law planned 20 to 31 times in a second, and a soak got 1 rad/s."""
    plans = []
    for name in ('plan_start', 'plan_resumption'):
        plan = getattr(running_reference, name)

        def counted(*given, plan=plan, **named):
            plans.append(1)
            return plan(*given, **named)

        monkeypatch.setattr(running_reference, name, counted)
    loop = Loop('fr3', PATIENT)
    before, _ = loop.run(4.4)
    assert len(plans) == 1
    loop.guard.starting.reset()
    T = loop.config.sample_time
    for _ in range(round(1.0 / T)):
        state, made = loop.state(), len(plans)
        torque = loop.guard.update(*state).copy()
        if len(plans) > made:
            loop.run(late, hangs=True)
        loop.torque = torque
        loop.line.torque_of_controller(torque, loop.plant.sample * T)
        loop.plant.step(torque)
    assert len(plans) == 2
    assert loop.guard.supervisor.running, loop.guard.supervisor.text
    speed, asked = loop.run(0.3)
    over = speed.max(axis=0) - np.maximum(before[-200:].max(axis=0), asked.max(axis=0))
    assert over.max() < SLACK


@pytest.mark.parametrize('preset', ['fr3', 'ur5e_driver'])
def test_controller_that_hung_takes_the_resting_arm_over_as_the_watchdog_holds_it(
    preset,
):
    """The load of 2 kg is known by then, whatever was learned of it in motion.

    What it had learned moved a wrist of the FR3 at 0.3 rad/s.
    """
    loop = Loop(preset)
    loop.run(5.3)
    loop.hang(1.0, queued=False)
    assert loop.speed.max() < 0.03
    speed, _ = loop.run(0.6)
    assert loop.guard.supervisor.reason is Reason.STAMP_JUMP
    assert speed.max() < 0.08


def test_arm_near_its_reference_returns_to_it_after_a_gap_at_the_torque_that_acts():
    """The reference begins where the arm is, and the command at what its effort shows."""
    loop = Loop('fr3', PATIENT)
    loop.run(1.3)
    loop.hang(0.12, queued=False)
    stamp, measurement = loop.state()
    guard, n = loop.guard, loop.n
    held = loop.line._safe.commanded.copy()
    loop.answer(stamp, measurement)
    assert guard.supervisor.phase is Phase.APPROACHING
    assert guard.controller.samples == 1
    start = guard.journal.pending[-1]
    assert start.type is EventType.START
    assert start.content['resumed']
    error = guard.controller.signals.xi1
    assert np.abs(error).max() < 1e-9
    whole = measurement[2 * n :] - guard.controller.signals.saturation.added
    # as measured and delayed, within what an arm that brakes changes in some samples
    np.testing.assert_allclose(whole, held, atol=0.5)
    step = np.array(loop.config.torque.rate_limit) * loop.config.sample_time
    assert np.all(np.abs(loop.torque - whole) <= step * (1.0 + 1e-9))
    loop.plant.step(loop.torque)
    loop.run(2.0)
    assert guard.supervisor.phase is Phase.TRACKING


def test_arm_far_from_its_reference_stops_after_a_gap_that_may_last():
    loop = Loop('fr3', PATIENT)
    loop.run(1.3)
    loop.hang(0.5, queued=False)
    loop.answer(*loop.state())
    assert loop.guard.supervisor.reason is Reason.STAMP_JUMP
    assert 'too far from its reference now' in loop.guard.supervisor.text


@pytest.mark.parametrize('T', [0.001, 0.004])
def test_load_is_the_torque_that_moves_the_arm_besides_its_model(T):
    """Of made-up motions: none in the first 0.1 s, and again after a gap."""
    controller = Guard(load_loop(CONFIG / 'ur5e.yaml').controller).controller
    settings, n = controller.settings, controller.settings.n
    estimate = np.array(settings.initial_estimate)
    load = np.linspace(-3.0, 5.0, n)
    recent = RecentMotion(n, T)

    def take(k):
        t, phase = k * T, np.arange(n)
        q, dq = np.sin(t + phase), np.cos(t + phase)
        ddq = -np.sin(t + 0.5 * T + phase)  # mean of the interval
        torque = load + needed_torque(settings, estimate, q, dq, ddq)
        recent.take(START + round(k * T * 1e9), np.array([q, dq, q]).ravel(), torque)

    assert (recent.size - 1) * T == pytest.approx(0.1, abs=1.5 * T)
    for k in range(round(0.35 / T)):
        assert (recent.load(settings, estimate) is None) == (k < recent.size)
        take(k)
    # of 100 N m: the motion changes within a block of 10 ms
    np.testing.assert_allclose(recent.load(settings, estimate), load, atol=0.3)
    take(k + round(0.031 / T))
    assert recent.load(settings, estimate) is None


def test_torque_that_is_left_behind_is_that_of_a_run_sample_by_sample():
    """The last of a compiled run's chunks has fewer samples than the load is observed in."""
    loop = load_loop(CONFIG / 'ur5e.yaml')
    config = change(loop.controller, {'safety.torque': 'hold_gravity'})
    config_of_plant = change(loop.plant, {'duration': 1.05 * 2.0})
    record = simulate(config, config_of_plant)
    guard = Guard(config, lambda: 0, lambda: 0)
    guard.starting.activate()
    plant = plant_of(config_of_plant)
    for k, elapsed in enumerate(record.stamps.tolist()):
        torque = guard.update(START + elapsed, plant.measure().copy())
        np.testing.assert_array_equal(torque, record.sample(k).torque)
        if k + 1 < record.stamps.size:
            plant.step(torque)
    np.testing.assert_array_equal(guard.release(), record.left)


@pytest.mark.parametrize(
    ('gap', 'slow', 'ddq'), [(0.02, 2.0 / 3.0 * 3.0, 25.0), (0.37, 0.5, None)]
)
def test_after_a_gap_the_velocity_to_be_damped_is_the_measured_one(gap, slow, ddq):
    """Positions show the mean of the gap, here 3 rad/s; a shorter step lets it in by 0.02/0.03."""
    last = LastState(1)
    last.take(START, np.zeros(3), np.zeros(1))
    stamp = START + round(gap * 1e9)
    last.take_usable(stamp, np.array([3.0 * gap, 0.5, 0.0]), 5.0, 1e-3)
    np.testing.assert_allclose(last.slow, slow)
    assert last.ddq == (None if ddq is None else pytest.approx(ddq))


def test_arm_that_no_error_stops_goes_on_after_a_gap_outside_its_bound():
    """As a busy computer leaves it: with `safety.error_ratio` 0 no bound is enforced."""
    law = {
        'reference.type': 'hold',
        'safety.error_ratio': 0.0,
        'safety.state_timeout': 10.0,
    }
    config = load_loop('recommended', {'blf_dsc_controller': law}).controller
    rest = np.array([2.293, 1.696])  # rad
    guard = Guard(config, lambda: 0, lambda: 0)
    guard.starting.activate()
    for k in range(100):
        guard.update(START + k * 1_000_000, np.array([*rest, *np.zeros(4)]))
    # slower than `safety.velocity_limit`, so it is believed
    far = rest + 3.0 * np.array(config.barrier.bound)
    guard.update(START + 162_000_000, np.array([*far, *np.zeros(4)]))
    assert guard.supervisor.running, guard.supervisor.text

# SPDX-License-Identifier: Apache-2.0
"""Every event of a controller replays from its journal, with every torque; without ROS."""

from __future__ import annotations

import numpy as np
import pytest
import recorded_run
from fault_rig import JOINTS, LOCKSTEP, MILLISECOND, Rig
from fault_table import FAULTS, run
from recorded_run import compared, of

from blf_dsc_controller import __version__
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.messages.journal import EventType, decode
from blf_dsc_controller.messages.telemetry import ControllerTelemetry
from blf_dsc_controller.messages.topics import COMMANDS, JOINT_STATES, JOURNAL, TRACKING_ERROR
from blf_dsc_controller.reference.trajectory import Trajectory, TrajectoryPoint
from blf_dsc_controller.replay.verify import verify

# A spoilt memory of the law is in no message, nor is the end of a process.
IN_MESSAGES = [one for one in FAULTS if 'poison' not in one.inject.__qualname__]
DAMPED = {'safety.torque': 'hold_gravity', 'safety.stop_ramp': 0.02}  # never twice the same


class Recorder(Rig):
    """A rig with a bag of all that the node would publish."""

    def __init__(self, given=None, **options):
        self.entries = []
        super().__init__(given, **options)
        self.telemetry = ControllerTelemetry(JOINTS, estimate_names(self.config), 1)
        self.drops = ()  # numbers of the joint states that the controller does not get
        self.count = 0

    def note(self, topic, raw):
        self.entries.append([topic.resolved, topic.type, len(self.entries), raw])

    def publish_events(self):
        while self.guard.journal.pending:
            self.note(JOURNAL, self.guard.journal.pending.popleft().encode())

    def deliver(self, raw):
        self.publish_events()
        self.note(JOINT_STATES, raw)
        self.count += 1
        if self.count - 1 in self.drops:
            return None
        torque = super().deliver(raw)
        guard = self.guard
        if guard.has_sample:
            for topic, message in self.telemetry.sample(
                guard.last_stamp, guard.controller.sample, 0.0
            ):
                self.note(topic, message)
        self.publish_events()
        return torque

    def _command(self, torque):
        if torque is not None:
            self.note(*self.telemetry.command(torque))
        super()._command(torque)

    def verify(self, path, **facts):
        self.publish_events()
        return verify(
            recorded_run.write(path / 'bag', self.entries, **facts, package_version=__version__)
        )


@pytest.mark.parametrize('fault', IN_MESSAGES, ids=lambda fault: fault.name)
def test_every_fault_replays_with_every_torque(fault, tmp_path):
    rig = Recorder(fault.given, live=fault.live)
    outcome = run(fault, rig)
    result = rig.verify(tmp_path, clock='lockstep')
    assert result.difference is None
    if any('another controller' in one for one in result.remarks):
        return  # what was killed ends there
    assert compared(result)['commands'] == 2 * len(of(rig.entries, COMMANDS))
    assert compared(result)['tracking_error'] == 6 * len(of(rig.entries, TRACKING_ERROR))
    assert ('safe stop' in ' '.join(result.turns)) == (outcome.noticed >= 0)
    assert [one for one in result.comparisons if 'torques' in one.left_out] == []


def eventful():
    """Every kind of event, one after the other."""
    rig = Recorder({**DAMPED, 'safety.watchdog': 'on', 'limits.acceleration': [40.0, 40.0]})
    rig.step(50)
    point = TrajectoryPoint(0.4, (2.2, 1.6), (0.0, 0.0), (0.0, 0.0))
    rig.guard.adopt(rig.guard.plan(Trajectory(JOINTS, (point,))))
    rig.step(100)
    plan = rig.guard.plan(Trajectory(JOINTS, (point,)), rig.guard.time + 0.02)
    rig.step(10)
    rig.guard.adopt(plan)
    rig.step(100)
    rig.guard.deactivate()
    rig.step(30)
    rig.wait(100)  # the watchdog commands while the controller is inactive, too
    rig.step(30)
    rig.guard.activate()
    rig.step(30)
    rig.wait(100)
    rig.step(30)
    rig.guard.reset()
    rig.step(10)
    rig.deliver(b'')
    rig.step(10)
    return rig


def test_the_watchdog_s_torques_replay_too(tmp_path):
    rig = eventful()
    rig.guard.release()
    result = rig.verify(tmp_path)
    assert (result.difference, result.remarks) == (None, ())
    assert result.turns == [
        'activate',
        'deactivate',
        'activate',
        'safe stop (state timeout)',
        'reset',
        'safe stop (bad message)',
    ]
    assert [one.type for one in result.events].count(EventType.SILENCE) == 2
    assert [one.type for one in result.events].count(EventType.TRAJECTORY) == 2
    assert compared(result)['commands'] == 2 * len(of(rig.entries, COMMANDS))
    states = len(of(rig.entries, JOINT_STATES))
    assert len(of(rig.entries, COMMANDS)) > states + 10


def test_dropped_states_are_found_by_the_journal(tmp_path):
    """In real time: while running by the telemetry, out of command as far as torques match."""
    rig = Recorder({**DAMPED, 'safety.deactivation_ramp': 1.0})
    rig.drops = (20, 70, 130)
    rig.step(50)
    rig.guard.deactivate()
    rig.step(50)
    rig.guard.activate()
    rig.step(50)
    rig.guard.release()
    result = rig.verify(tmp_path)
    assert result.difference is None
    assert result.passed_over == 2
    assert compared(result)['tracking_error'] == 6 * len(of(rig.entries, TRACKING_ERROR))
    # The ramp differs from the dropped state on until the law is in command again.
    assert compared(result)['commands'] == 2 * (49 + 20 + 49)
    (commands,) = (one for one in result.comparisons if one.topic.endswith('commands'))
    assert commands.left_out.startswith('29 torques')


def test_an_unexpected_error_is_replayed_as_a_stop(tmp_path):
    rig = Recorder(DAMPED)
    rig.step(50)
    rig.note(JOINT_STATES, rig.state().raw())
    stamp = rig.state().stamp
    rig.guard.journal.messages += 1  # as far as the message came
    rig.guard.journal.stamp = stamp
    rig._command(rig.guard.fail('ZeroDivisionError: x'))
    rig.plant.step(rig.input.torque)
    rig.step(30)
    rig.guard.reset()
    rig.step(30)
    result = rig.verify(tmp_path, clock='lockstep')
    assert result.difference is None
    assert result.turns == ['activate', 'safe stop (failed)', 'reset']
    assert compared(result)['commands'] >= 2 * (50 + 30)


def test_a_changed_stop_reason_is_a_departure(tmp_path):
    """The recorded controller stopped where the replayed one does not."""
    rig = eventful()
    for entry in of(rig.entries, JOURNAL):
        event = decode(entry[3])
        if event.content.get('reason') == 'bad message':
            content = {**event.content, 'reason': 'stamp jump'}
            entry[3] = event._replace(content=content).encode()
    assert rig.verify(tmp_path).difference.field.startswith('stop: stamp jump (')


def test_a_stop_that_is_moved_is_named(tmp_path):
    rig = Recorder(DAMPED)
    rig.step(50)
    rig.deliver(b'')
    rig.step(10)
    rig.publish_events()
    stop = of(rig.entries, JOURNAL)[-1]
    event = decode(stop[3])
    later = event._replace(stamp=event.stamp + MILLISECOND, messages=event.messages + 1)
    stop[3] = later.encode()
    difference = rig.verify(tmp_path, clock='lockstep').difference
    assert difference.stamp == LOCKSTEP + 49 * MILLISECOND
    assert difference.field.startswith('used by the law (')


def test_a_second_controller_in_a_bag_is_not_replayed(tmp_path):
    rig = Recorder()
    rig.step(40)
    rig.guard = rig.controller()
    rig.step(40)
    result = rig.verify(tmp_path)
    assert result.difference is None
    assert result.remarks[0] == 'another controller was started: the replay ends there'
    assert result.compared == pytest.approx(0.5)
    assert result.stamp.size == 40
    assert np.array_equal(result.stamp, LOCKSTEP + np.arange(40) * MILLISECOND)


def test_the_state_at_which_a_controller_was_killed_is_the_next_ones(tmp_path):
    """In lock-step the arm sends it again, until somebody answers."""
    rig = Recorder()
    rig.step(40)
    rig.drops = (40,)
    rig.deliver(rig.state().raw())
    rig.guard = rig.controller()
    rig.step(40)
    result = rig.verify(tmp_path, clock='lockstep')
    assert result.difference is None
    assert result.stamp.size == 40
    assert result.compared == pytest.approx(0.5)

# SPDX-License-Identifier: Apache-2.0
"""Controller events replay from the journal with identical torques; without ROS."""

from __future__ import annotations

import struct
from collections import Counter

import pytest
import recorded_run
from fault_table import FAULTS, JOINTS, MILLISECOND, Rig, run
from recorded_run import compared, of

from blf_dsc_controller import BlfDscError, TrajectoryPoint, change, verify
from blf_dsc_controller.control.telemetry import ControllerTelemetry
from blf_dsc_controller.factory.estimate import estimate_names
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import decode
from blf_dsc_controller.reference.retargeting import Target
from blf_dsc_controller.reference.trajectory import Trajectory

# Messages show neither a corrupted state of the law nor the end of a process.
IN_MESSAGES = [fault for fault in FAULTS if 'poison' not in fault.inject.__qualname__]
NAN = struct.pack('<d', float('nan'))
DAMPED = {'safety.torque': 'hold_gravity'}


class Recorder(Rig):
    """A rig that records everything the node would publish."""

    def __init__(self, given=None, **options):
        self.entries = []
        super().__init__(given, **options)
        self.telemetry = ControllerTelemetry(self.config, estimate_names(self.config))
        self.drops = ()  # indices of joint states that never reach the controller
        self.count = 0

    def record(self, topic, raw):
        self.entries.append([topic.resolved, topic.type, len(self.entries), raw])

    def publish_events(self):
        while self.guard.journal.pending:
            self.record(topics.JOURNAL, self.guard.journal.pending.popleft().encode())

    def deliver(self, raw):
        self.publish_events()
        self.record(topics.JOINT_STATES, raw)
        self.count += 1
        if self.count - 1 in self.drops:
            return None
        torque = super().deliver(raw)
        guard = self.guard
        if torque is not None and not guard.has_sample:
            self.record(*self.telemetry.answer(guard.journal.stamp, torque))
        if guard.has_sample:
            law = guard.controller
            if law.samples == 1:
                self.telemetry.restart()
            known = law.sample, law.settings.torque.limit, guard.samples.ratio
            for topic, message in self.telemetry.sample(
                guard.reference.last_stamp, *known, 0.0
            ):
                if (
                    topic is not topics.BOUND
                ):  # of which the node also sends the changed ones
                    self.record(topic, message)
        self.publish_events()
        return torque

    def _command(self, torque):
        if torque is not None:
            self.record(*self.telemetry.command(torque))
        super()._command(torque)

    def release(self):
        """End as the node does."""
        torque = self.guard.release()
        if torque is not None:
            self.record(*self.telemetry.command(torque))

    def write(self, path, **options):
        """Write the bag; return it."""
        self.publish_events()
        return recorded_run.write(path / 'bag', self.entries, **options)

    def verify(self, path, **options):
        return verify(self.write(path, **options))


@pytest.mark.parametrize('fault', IN_MESSAGES, ids=lambda fault: fault.name)
def test_every_fault_replays_with_identical_torques(fault, tmp_path):
    rig = Recorder(fault.given, live=fault.live)
    outcome = run(fault, rig)
    result = rig.verify(tmp_path)
    assert result.difference is None
    if any('another controller' in remark for remark in result.remarks):
        return  # the replay ends where the controller was killed
    assert compared(result)['commands'] == 2 * len(of(rig.entries, topics.COMMANDS))
    assert compared(result)['tracking_error'] == 6 * len(
        of(rig.entries, topics.TRACKING_ERROR)
    )
    assert ('safe stop' in ' '.join(result.transitions)) == (outcome.noticed >= 0)
    assert [item for item in result.comparisons if 'torques' in item.left_out] == []


def eventful():
    """Run a rig through every kind of event."""
    rig = Recorder(
        {
            **DAMPED,
            'safety.watchdog': 'on',
            'limits.acceleration': [40.0, 40.0],
        }
    )
    rig.step(50)
    point = TrajectoryPoint(0.4, (2.2, 1.6), (0.0, 0.0), (0.0, 0.0))
    rig.guard.motions.adopt(rig.guard.motions.plan(Trajectory(JOINTS, (point,))))
    rig.step(100)
    plan = rig.guard.motions.plan(
        Trajectory(JOINTS, (point,)), rig.guard.reference.time + 0.02
    )
    rig.step(10)
    rig.guard.motions.adopt(plan)
    rig.step(50)
    for k in range(5):  # a stream, each target before the one before is reached
        now = rig.guard.reference.time
        ahead = rig.guard.controller.reference_at(now + 0.03)
        beside = tuple((ahead[0] + 1e-4 * k).tolist())
        rates = tuple(ahead[1].tolist()) if k < 4 else ()  # the last one is to rest at
        target = Target(beside, rates, now + 0.03, now + 0.06, k > 2)
        plan = rig.guard.motions.plan(target, now + 0.004)
        rig.step(4)
        rig.guard.motions.adopt(plan)
        rig.step(20)
    rig.guard.motions.brake()
    rig.step(50)
    here = rig.guard.controller.reference_at(rig.guard.reference.time)[0]
    near = TrajectoryPoint(0.005, tuple((here + 0.002).tolist()))
    stretched = rig.guard.motions.plan(Trajectory(JOINTS, (near,)))
    assert stretched.motion.note
    rig.guard.motions.adopt(stretched)
    rig.step(50)
    rig.guard.retune(change(rig.config, {'two_link.feedback_gain': (50.0, 25.0)}))
    rig.step(50)
    rig.guard.deactivate()
    rig.step(30)
    rig.wait(100)  # the watchdog commands while the controller is inactive, too
    rig.step(30)
    rig.guard.starting.activate()
    rig.step(30)
    rig.wait(100)
    rig.step(30)
    rig.guard.starting.reset()
    rig.step(10)
    rig.deliver(b'')
    rig.step(10)
    return rig


def test_every_kind_of_event_and_watchdog_torques_replay(tmp_path):
    rig = eventful()
    rig.release()
    result = rig.verify(tmp_path)
    assert (result.difference, result.remarks) == (None, ())
    assert ', '.join(result.transitions) == (
        'activate, deactivate, activate, safe stop (state timeout), reset, safe stop (bad message)'
    )
    types = Counter(event.type for event in result.events)
    kinds = ('silence', 'brake', 'parameters')
    assert [types[each] for each in kinds] == [2, 1, 1]
    assert result.motions == 8
    states, commands = (
        len(of(rig.entries, topic)) for topic in (topics.JOINT_STATES, topics.COMMANDS)
    )
    assert compared(result)['commands'] == 2 * commands
    assert commands > states + 10


def test_dropped_states_are_detected(tmp_path):
    """In real time: what the controller did not answer was dropped."""
    rig = Recorder(DAMPED)
    rig.drops = (20, 70, 130)
    rig.step(50)
    rig.guard.deactivate()
    rig.step(50)
    rig.guard.starting.activate()
    rig.step(50)
    rig.release()
    result = rig.verify(tmp_path)
    assert (result.difference, result.skipped) == (None, 3)
    assert compared(result)['tracking_error'] == 6 * 147
    assert compared(result)['commands'] == 2 * 148  # the last one when it ends


def test_dropped_state_is_told_from_a_missing_answer_beside_torques_of_the_watchdog(
    tmp_path,
):
    """Without sequence numbers, by the number of torques in the journal."""
    rig = Recorder({**DAMPED, 'safety.watchdog': 'on'})
    rig.drops = (20,)
    rig.step(50)
    rig.wait(100)
    rig.guard.starting.reset()
    rig.step(30)
    rig.release()
    result = rig.verify(tmp_path)
    torques = len(of(rig.entries, topics.COMMANDS))
    assert torques > 80  # those of 79 states, and the watchdog's
    assert (result.difference, result.skipped) == (None, 1)
    assert compared(result)['commands'] == 2 * torques


def test_replay_ends_where_the_law_failed(tmp_path):
    """Nothing in the bag shows how far the law got."""
    rig = Recorder(DAMPED)
    rig.step(50)
    rig._command(rig.guard.fail('ZeroDivisionError: x'))
    rig.step(30)
    result = rig.verify(tmp_path)
    assert (result.difference, result.samples) == (None, 50)
    assert result.remarks == (
        'the law failed, ZeroDivisionError: x: the replay ends there',
    )


def test_replay_ends_where_the_stamps_restart(tmp_path):
    """Messages of the same stamp could not be told apart."""
    rig = Recorder(DAMPED)
    rig.step(50)
    rig.base -= 20 * MILLISECOND
    rig.step(5)
    rig.guard.starting.reset()
    rig.step(50)
    result = rig.verify(tmp_path)
    stamp = rig.base + 55 * MILLISECOND
    assert (result.difference, result.samples) == (None, 50)
    assert result.remarks == (
        f'the stamps restart at {stamp} ns: the replay ends there',
    )


def altered(**content):
    return lambda event: event._replace(content={**event.content, **content})


def later(event):
    return event._replace(stamp=event.stamp + MILLISECOND, messages=event.messages + 1)


def other_point(event):
    event.content['points'][0]['positions'][1] += 1e-9
    return event


def strict(event):
    event.content['parameters']['safety.error_ratio'] = 1e-6
    return event


@pytest.mark.parametrize(
    ('kind', 'alter', 'topic', 'field'),
    [
        ('stop', altered(reason='stamp jump'), topics.TRACKING_ERROR, 'stop: '),
        ('stop', later, topics.TRACKING_ERROR, 'used by the law ('),
        ('stop', altered(text='all is well'), topics.JOURNAL, 'text of event'),
        ('start', altered(resumed=True), topics.JOURNAL, 'resumed of event'),
        ('trajectory', later, topics.TRACKING_ERROR, 'trajectory'),
        ('trajectory', other_point, topics.COMMANDS, 'effort of joint'),
        ('configure', strict, topics.TRACKING_ERROR, 'used by the law ('),
        ('silence', altered(torques=3), topics.TRACKING_ERROR, 'silence'),
    ],
)
def test_changed_event_is_a_difference(tmp_path, kind, alter, topic, field):
    """The recorded controller did something else than the replayed one."""
    rig = eventful()
    rig.publish_events()
    events = [(entry, decode(entry[3])) for entry in of(rig.entries, topics.JOURNAL)]
    chosen = [(entry, event) for entry, event in events if event.type == kind]
    entry, event = chosen[-1 if kind == 'stop' else 0]
    entry[3] = alter(event).encode()
    difference = rig.verify(tmp_path).difference
    assert (difference.topic, difference.field[: len(field)]) == (topic.resolved, field)
    if kind in ('stop', 'trajectory'):
        assert abs(difference.stamp - event.stamp) <= MILLISECOND


def test_stop_that_the_recorded_controller_did_not_make_is_the_difference(tmp_path):
    """Its journal ends before the stop, but it answered all states that came after."""
    rig = Recorder(DAMPED)
    rig.step(50)
    rig.publish_events()
    rig.deliver(b'')
    rig.step(10)
    rig.publish_events()
    stops = [
        each
        for each in of(rig.entries, topics.JOURNAL)
        if decode(each[3]).type == 'stop'
    ]
    rig.entries.remove(stops[0])
    result = rig.verify(tmp_path)
    assert result.difference.field.startswith('used by the law (')
    assert result.difference.topic == topics.TRACKING_ERROR.resolved


@pytest.mark.parametrize('part', [0.1, 0.5, 0.9])
def test_flipped_bit_of_a_safe_torque_is_found(tmp_path, part):
    rig = eventful()
    safe = [
        entry for entry in of(rig.entries, topics.TRACKING_ERROR) if NAN in entry[3]
    ]
    # another NaN
    safe[0][3] = safe[0][3].replace(NAN, struct.pack('<d', -float('nan')), 1)
    entry = safe[int(part * len(safe))]
    entry[3] = entry[3][:-8] + bytes([entry[3][-8] ^ 1]) + entry[3][-7:]
    difference = rig.verify(tmp_path).difference
    assert (difference.topic, difference.field) == (
        topics.TRACKING_ERROR.resolved,
        'effort of joint2',
    )
    assert difference.recorded == pytest.approx(difference.replayed, abs=1e-12)


@pytest.mark.parametrize(
    ('topic', 'number', 'samples', 'remark'),
    [
        (
            topics.TRACKING_ERROR,
            40,
            40,
            f'the recorder missed messages of {topics.TRACKING_ERROR.resolved}',
        ),
        (
            topics.JOURNAL,
            3,
            1,
            'an event of the journal, or a target, is not in the bag',
        ),
    ],
)
def test_replay_ends_where_the_recorder_missed_what_it_needs(
    tmp_path, topic, number, samples, remark
):
    """Which states the law used, and what happened, is then not known."""
    rig = eventful()
    rig.publish_events()
    of(rig.entries, topic)[number][3] = None
    result = rig.verify(tmp_path, publishers=1)
    assert (result.difference, result.samples) == (None, samples)
    missed = f'the recorder missed messages of {topic.resolved}: 1 missed'
    assert result.remarks == (f'{remark}: the replay ends there', missed)
    assert result.compared < 1.0


@pytest.mark.parametrize('drops', [(), (40,)])
def test_second_controller_in_a_bag_is_not_replayed(tmp_path, drops):
    """In lock-step the plant sends the state that killed a controller until another answers."""
    rig = Recorder()
    rig.step(40)
    rig.drops = drops
    if drops:
        rig.deliver(rig.state().raw())
    rig.guard = rig.controller()
    rig.step(40)
    result = rig.verify(tmp_path)
    assert (result.difference, result.samples) == (None, 40)
    assert result.remarks == ('another controller was started: the replay ends there',)
    assert result.compared == pytest.approx(0.5)


@pytest.mark.parametrize(
    ('kind', 'content', 'words'),
    [
        ('stop', {'reason': 'boredom'}, "a stop for the unknown reason 'boredom'"),
        ('parameters', {'parameters': {'joints': ['a']}}, 'fixed at the start: joints'),
        ('silence', {'torques': 10**9}, '1000000000 torques of the watchdog'),
    ],
)
def test_event_that_cannot_be_repeated_is_named(tmp_path, kind, content, words):
    rig = eventful()
    rig.publish_events()
    events = [(entry, decode(entry[3])) for entry in of(rig.entries, topics.JOURNAL)]
    entry, event = next(found for found in events if found[1].type == kind)
    event.content.update(content)
    entry[3] = event.encode()
    with pytest.raises(BlfDscError, match=rf'event {event.number} .* {words}'):
        rig.verify(tmp_path)

# SPDX-License-Identifier: Apache-2.0
"""The watchdog beside a controller by hand, and beside a process that hangs or crashes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from diagnostic_msgs.msg import DiagnosticStatus
from random_arm import CONFIG
from rclpy.parameter import Parameter
from ros_rig import JOINTS, PATIENCE, START, FakeClock, PatientClock, values
from std_msgs.msg import String

import blf_dsc_controller as blf
from blf_dsc_controller.configuration.nodes import CONTROLLER, dump
from blf_dsc_controller.configuration.schema import build, flatten
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
)
from blf_dsc_controller.messages.journal import Journal
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.watchdog_node import WatchdogNode
from blf_dsc_controller.supervision.model_torque import gravity_torque

FR3 = CONFIG / 'fr3.yaml'
UR5E = CONFIG / 'ur5e_driver.yaml'
LOG = topics.STREAM, topics.STREAM
ENDS = {'crashed': signal.SIGSEGV, 'stopped': signal.SIGSTOP}


@pytest.fixture
def controller(ros):
    """Return a function that starts a UR5e's controller as a process in the domain of `ros`."""
    started = []

    def start(**parameters):
        """Start it with patience for a slow arm."""
        patient = {'safety.state_timeout': 10.0} | parameters
        words = [
            word
            for name, value in patient.items()
            for word in ('-p', f'{name}:={value}')
        ]
        module = ('-m', 'blf_dsc_controller.nodes.controller_node')
        command = [
            sys.executable,
            *module,
            '--ros-args',
            '--params-file',
            str(UR5E),
            *words,
        ]
        domain = str(ros.context.get_domain_id())
        started.append(
            subprocess.Popen(command, env=os.environ | {'ROS_DOMAIN_ID': domain})
        )
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.mark.parametrize('end', ENDS)
def test_arm_in_motion_comes_to_rest_beside_a_dead_process(ros, controller, end):
    """A UR5e whose driver holds the last torque for ever: 1.4 rad in a second without a watchdog.

    With it 0.1 rad; the limit leaves room for computers that are far too slow.
    """
    clock = PatientClock()
    arm = ros.add(PlantNode, flatten(blf.load_loop(UR5E).plant), clock=clock)
    watchdog = ros.add(partial(WatchdogNode, steady=clock))
    process = controller()
    # its kernels may be compiled first
    ros.until(
        lambda: watchdog.watchdog is not None and arm.plant.sample > 425, PATIENCE
    )
    process.send_signal(ENDS[end])
    ros.until(lambda: end == 'stopped' or process.poll() is not None)
    start = arm.plant.measure()[:6].copy()
    ros.until(lambda: watchdog.watchdog.active)
    # more than one if the computer kept the controller from commanding before
    takeovers = watchdog.watchdog.takeovers
    ros.run(arm, 500)
    assert watchdog.watchdog.takeovers == takeovers
    assert watchdog.watchdog.active
    assert np.abs(arm.plant.measure()[:6] - start).max() < 0.5
    if end == 'stopped':
        process.send_signal(signal.SIGCONT)
    else:
        controller(**{'safety.first_torque': 'send'})
    ros.until(lambda: not watchdog.watchdog.active, PATIENCE)


class ByHand:
    """A controller and an arm by hand, at 1 kHz of a clock of their own, beside a watchdog."""

    def __init__(self, ros, config, **parameters):
        self.ros = ros
        self.clock = FakeClock()
        self.node = ros.add(partial(WatchdogNode, steady=self.clock), parameters)
        self.config = config
        self._stamp = 10**9
        self._events = Journal()
        self._states = ros.publisher(topics.JOINT_STATES)
        self._commands = ros.publisher(topics.COMMANDS)
        self._journal = ros.publisher(topics.JOURNAL)
        self._rest = np.zeros(len(config.joints))
        self._q = np.full(len(config.joints), 0.3)
        settings = settings_of_config(config)
        # by which the arm rests
        self.holding = gravity_torque(settings, settings.initial_estimate, self._q)
        self._encoder = JointStateEncoder(config.joints)
        self.torques = []  # of the watchdog
        self._sent = 0
        publishers = self._states, self._commands, self._journal
        ros.until(lambda: all(each.get_subscription_count() for each in publishers))
        self._received = ros.listen(topics.COMMANDS)
        ros.until(lambda: self._commands.get_subscription_count() == 2)
        self.note('configure', parameters=flatten(config))
        ros.until(lambda: self.node.watchdog is not None)

    @property
    def watchdog(self):
        return self.node.watchdog

    def note(self, event, **content):
        """Publish an event of the controller, and wait until the watchdog knows it."""
        self._events.note(event, **content)
        known = []
        heed = self.node._heed
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(self.node, '_heed', lambda each: known.append(heed(each)))
            self._journal.publish(self._events.pending.popleft().encode())
            self.ros.until(lambda: known)

    def restart(self, config, *, starts=True):
        """Start another controller, which commands with the next state if it `starts`."""
        self._events = Journal()
        self.note('configure', parameters=flatten(config))
        self.note('activate')
        if starts:
            self.note('start', resumed=False)

    def go_on(self, seconds, *, commands):
        """Send states, each with a torque of the controller if it `commands`."""
        for _ in range(round(seconds * 1e3)):
            self._stamp += 10**6
            self.clock.advance(1e-3)
            self._states.publish(
                self._encoder.encode(self._stamp, self._q, self._rest, self._rest)
            )
            self.ros.until(lambda: self.watchdog.stamp == self._stamp)
            if commands:
                encoder = Float64MultiArrayEncoder(len(self._q))
                self._commands.publish(encoder.encode(self.holding))
                self._events.commands += 1
                self.ros.until(
                    lambda: (
                        self.watchdog._commanded_stamp == self._stamp
                        and not self.watchdog.active
                    )
                )

    def pause(self, seconds):
        """Send nothing for a while."""
        self._stamp += round(seconds * 1e9)
        self.clock.advance(seconds)

    def torque(self):
        """Torque (n,) [N m] of the watchdog after the controller has fallen silent."""
        self.go_on(0.2, commands=False)
        assert self.watchdog.active
        self.ros.until(lambda: self._received and self._received[-1].layout.dim)
        count = len(self._received)
        self.ros.until(lambda: len(self._received) > count + 1)
        return np.array(self._received[-1].data)


HOLDING = {'safety.torque': 'hold_gravity'}


@pytest.mark.parametrize('armed', [False, True], ids=['watching', 'restarted since'])
def test_watchdog_continues_from_the_torque_that_the_drive_holds(
    ros, armed, tmp_path, monkeypatch
):
    """At the limit of its rate.

    If it was restarted after the controller had died, it cannot know it: that of the
    model is sent at once.
    """
    limited = HOLDING | {'torque.rate_limit': [100.0, 100.0]}
    dump(tmp_path / 'law.yaml', {CONTROLLER: limited})
    words = ['node', '--ros-args', '--params-file', str(tmp_path / 'law.yaml')]
    monkeypatch.setattr(sys, 'argv', words)  # as of the controller, for a restart
    loop = ByHand(ros, build(blf.ControllerConfig, limited), armed=armed)
    model, loop.holding = loop.holding, loop.holding + 3.0
    if not armed:
        loop.go_on(0.03, commands=True)
    loop.torque()
    first = next(each.data for each in loop._received if each.layout.dim)
    np.testing.assert_allclose(first, model if armed else loop.holding, atol=0.11)
    # not 4 ms, at which it watches
    assert loop.node._timer.period == pytest.approx(1e-3)
    ros.executor.remove_node(loop.node)
    ros.spin(0.1)
    count = len(loop._received)
    loop.node.close()  # the driver holds the last torque
    ros.until(lambda: len(loop._received) > count)


@pytest.mark.parametrize(
    ('given', 'changed', 'restarted'),
    [
        ({}, HOLDING, False),
        (HOLDING, {'torque.limit': [3.0, 1.0]}, True),
    ],
)
def test_watchdog_acts_by_the_parameters_in_force(ros, given, changed, restarted):
    """Those of yesterday would drop the arm, or throw it."""
    before = build(blf.ControllerConfig, given)
    after = blf.change(before, changed)
    loop = ByHand(ros, before)
    watchdog = loop.watchdog
    loop.go_on(0.05, commands=True)
    yesterday = loop.torque()
    loop.go_on(0.01, commands=True)
    if restarted:
        loop.restart(after)
    else:
        loop.note('parameters', parameters=changed)
    loop.go_on(0.05, commands=True)
    today = loop.torque()
    held = loop.holding if given else np.zeros(2)
    np.testing.assert_allclose(yesterday, held, atol=0.1)
    limited = np.clip(loop.holding, *np.outer((-1.0, 1.0), after.torque.limit))
    np.testing.assert_allclose(today, limited, atol=0.1)
    assert np.abs(today - yesterday).min() > 0.5
    assert loop.watchdog is watchdog  # and knows what it has observed


def test_watchdog_reports_the_joint_that_swings_under_its_torque(ros):
    log = ros.listen(topics.Topic('', '/rosout', 'rcl_interfaces/msg/Log', *LOG))
    loop = ByHand(ros, build(blf.ControllerConfig, HOLDING))
    loop.go_on(0.05, commands=True)
    for k in range(300):
        loop._q[1] = 0.3 + 2e-3 * np.sin(2.0 * np.pi * 25.0 * k * 1e-3)
        loop.go_on(1e-3, commands=False)
    assert loop.watchdog.active
    ros.until(lambda: any("joint 'joint2' swings" in line.msg for line in log))


WITHDRAWN = 'withdraw', {'text': 'of the test'}
ENDED = 'release', {'resting': True}


@pytest.mark.parametrize('event', [WITHDRAWN, ENDED], ids=lambda event: event[0])
def test_watchdog_stands_down_when_silence_is_meant_until_the_next_command(ros, event):
    """Whatever the order in which its last torque and the event arrive."""
    loop = ByHand(ros, build(blf.ControllerConfig, HOLDING))
    loop.go_on(0.02, commands=True)
    loop.note(event[0], **event[1])
    loop.go_on(0.002, commands=True)
    loop.go_on(0.2, commands=False)
    assert loop.watchdog.takeovers == 0
    loop.note('reset')
    loop.go_on(0.1, commands=False)
    assert loop.watchdog.takeovers == 0
    loop.go_on(0.02, commands=True)
    assert np.abs(loop.torque()).min() > 0.5
    assert loop.watchdog.takeovers == 1


def test_watchdog_takes_over_from_a_controller_that_ends_in_motion(ros):
    loop = ByHand(ros, build(blf.ControllerConfig, HOLDING))
    loop.go_on(0.02, commands=True)
    loop.note('release', resting=False)
    assert np.abs(loop.torque()).min() > 0.5


REFUSED = 'stop', {'reason': 'start rejected', 'text': 'of the test'}
OTHER_FILES = {
    'the same file': HOLDING,
    'a file that drops the arm': {'safety.torque': 'zero'},
    'the file of another arm': {'joints': ['left', 'right'], **HOLDING},
}


@pytest.mark.parametrize('file', list(OTHER_FILES)[1:])
def test_refused_start_of_a_controller_leaves_the_watchdog_in_command(ros, file):
    """A restarted one after a kill: its configuration and its end are its own."""
    loop = ByHand(ros, build(blf.ControllerConfig, HOLDING))
    loop.go_on(0.02, commands=True)
    held = loop.torque()
    loop.restart(build(blf.ControllerConfig, OTHER_FILES[file]), starts=False)
    loop.note(REFUSED[0], **REFUSED[1])
    loop.note('release', resting=True)
    np.testing.assert_allclose(loop.torque(), held, atol=0.1)
    assert loop.watchdog.takeovers == 1
    assert np.abs(held).min() > 0.5


def test_second_controller_that_does_not_start_changes_nothing_for_the_first(ros):
    """Its journal is on the same topic."""
    loop = ByHand(ros, build(blf.ControllerConfig, HOLDING))
    loop.go_on(0.02, commands=True)
    first = loop._events
    loop.restart(build(blf.ControllerConfig, {'safety.torque': 'zero'}), starts=False)
    loop.note('release', resting=True)
    loop._events = first
    loop.note('parameters', parameters={'torque.limit': [15.0, 9.0]})
    loop.go_on(0.02, commands=True)
    assert loop.watchdog.config.torque.limit == (15.0, 9.0)
    loop.note(ENDED[0], **ENDED[1])
    loop.go_on(0.1, commands=False)
    loop.note('reset')
    loop.go_on(0.02, commands=True)
    assert np.abs(loop.torque()).min() > 0.5


def test_watchdog_in_command_stands_down_for_a_torque_alone(ros):
    """The controller was stopped for a while, and is confused: the watchdog holds the arm."""
    loop = ByHand(ros, build(blf.ControllerConfig, HOLDING))
    loop.go_on(0.02, commands=True)
    held = loop.torque()
    loop.note(ENDED[0], **ENDED[1])
    np.testing.assert_allclose(loop.torque(), held, atol=0.1)
    assert loop.watchdog.takeovers == 1


def test_torques_for_other_joints_are_none_of_the_controller(ros):
    """The drives apply none of them, so that the arm would be left alone."""
    loop = ByHand(ros, build(blf.ControllerConfig, HOLDING))
    loop.go_on(0.02, commands=True)
    held = loop.torque()
    raw = Float64MultiArrayEncoder(3).encode(np.zeros(3))
    loop._commands.publish(raw)
    loop.go_on(0.01, commands=False)
    assert loop.watchdog.active
    np.testing.assert_allclose(loop.torque(), held, atol=0.1)


def test_watchdog_watches_once_it_has_seen_a_state_and_a_torque(ros):
    """And somebody takes its torques: until then it could do nothing."""
    state = ros.listen(topics.WATCHDOG_STATE)

    def says(text, ready):
        last = state[-1] if state else DiagnosticStatus()
        return text in last.message and values(last).get(topics.READY) == ready

    loop = ByHand(ros, build(blf.ControllerConfig, HOLDING))
    ros.driver()
    ros.until(lambda: says('not ready: no joint states arrive', 'False'))
    loop.go_on(0.01, commands=False)
    ros.until(lambda: says('ready: waiting for the first torque', 'True'))
    loop.go_on(0.01, commands=True)
    ros.until(lambda: says('watching', 'True'))
    loop.torque()
    ros.until(lambda: says('commands the safe torque', 'True'))
    loop.go_on(0.01, commands=True)
    loop.pause(3.0)
    loop.go_on(0.01, commands=False)
    ros.until(lambda: says('ready: waiting for the first torque', 'True'))


def test_journal_that_cannot_be_read_is_reported_and_ends_nothing(ros):
    diagnostics = ros.listen(topics.DIAGNOSTICS)
    journal = ros.publisher(topics.JOURNAL)

    def reported(text):
        return any(
            text in status.message and status.level == DiagnosticStatus.ERROR
            for message in diagnostics
            for status in message.status
        )

    loop = ByHand(ros, build(blf.ControllerConfig, HOLDING))
    loop.go_on(0.02, commands=True)
    ros.until(lambda: journal.get_subscription_count() == 1)
    journal.publish(String(data='{"of": "another version"}'))
    ros.until(lambda: reported('acts by the parameters from before'))
    loop.note('reset')
    assert not loop.node.problem
    loop.note('parameters', parameters={'torque.limit': 'none'})
    assert not loop.node.finished
    assert loop.node.problem
    loop.note('parameters', parameters={'safety.state_timeout': 0.05})
    assert loop.watchdog.config.safety.state_timeout == 0.05
    assert not loop.node.problem
    loop.go_on(0.02, commands=True)
    assert np.abs(loop.torque()).min() > 0.5


def test_controller_that_goes_silent_on_purpose_says_so_to_its_watchdog(ros):
    """After a pause of its driver, and at an orderly end: no torque of the watchdog, no FATAL."""
    clock = FakeClock()
    given = HOLDING | {'safety.watchdog': 'on', 'learning.window': 1.0}
    law = ros.add(ControllerNode, given | {'reference.type': 'hold'}, clock=clock)
    watchdog = ros.add(partial(WatchdogNode, steady=clock))
    states = ros.publisher(topics.JOINT_STATES)
    ros.driver()
    encoder = JointStateEncoder(JOINTS)
    ros.until(
        lambda: watchdog.watchdog is not None and states.get_subscription_count() == 2
    )
    rest = np.zeros(2)

    def go_on(begin, samples):
        for k in range(samples):
            stamp = begin + k * 10**6
            clock.advance(1e-3)
            states.publish(encoder.encode(stamp, START, rest, rest))
            ros.until(
                lambda stamp=stamp: (
                    watchdog.watchdog.stamp == law.guard.journal.stamp == stamp
                )
            )

    go_on(10**9, 20)
    assert law.guard.supervisor.running
    for _ in range(300):  # the driver is restarted
        clock.advance(0.01)
        ros.spin(0.01)
    go_on(5 * 10**9, 1)
    ros.until(lambda: watchdog.watchdog.stands_down)
    go_on(5 * 10**9 + 10**6, 150)
    assert watchdog.watchdog.takeovers == 0
    ros.reset(law)
    go_on(6 * 10**9, 20)
    ros.until(lambda: not watchdog.watchdog.stands_down)
    ros.until(lambda: law.prepare_to_end() or go_on(law.guard.journal.stamp + 10**6, 1))
    law.close()
    ros.until(lambda: watchdog.watchdog.stands_down)
    ros.kill(law)
    assert watchdog.watchdog.takeovers == 0


def test_controller_reports_a_watchdog_that_is_missing(ros):
    """Which has been there before."""
    log = ros.listen(topics.Topic('', '/rosout', 'rcl_interfaces/msg/Log', *LOG))
    diagnostics = ros.listen(topics.DIAGNOSTICS)

    def missing():
        return any(
            'torque_watchdog is missing' in status.message
            for message in diagnostics[-1:]
            for status in message.status
        )

    law = ros.add(ControllerNode)
    for _ in range(20):
        law.on_second()
    watchdog = ros.add(WatchdogNode)
    ros.until(lambda: law.on_second() or law._watchdog._seen)
    assert not any('torque_watchdog is missing' in line.msg for line in log)
    ros.kill(watchdog)
    watchdog._raw_subscriptions.close()
    ros.until(lambda: law.on_second() or missing())
    ros.until(lambda: any('torque_watchdog is missing' in line.msg for line in log))
    ros.add(WatchdogNode)
    ros.until(lambda: law.on_second() or not missing())


def test_controller_does_not_take_the_watchdog_for_an_arm(ros):
    """Nothing listens to its commands but the watchdog: it waits with its first torque."""
    law = ros.add(ControllerNode)
    assert law.set_parameters([Parameter('torque.limit', value=[15.0, 9.0])])[
        0
    ].successful
    watchdog = ros.add(WatchdogNode)
    states = ros.publisher(topics.JOINT_STATES)
    ros.until(
        lambda: watchdog.watchdog is not None and states.get_subscription_count() == 2
    )
    states.publish(
        JointStateEncoder(JOINTS).encode(10**9, START, np.zeros(2), np.zeros(2))
    )
    ros.until(lambda: watchdog.watchdog.stamp == 10**9)
    ros.spin(0.2)
    assert not watchdog.status().is_ready
    assert 'nobody subscribes' in watchdog.status().text
    assert watchdog.watchdog.config.torque.limit == (15.0, 9.0)  # as changed before
    assert law.guard.journal.messages == 0
    law.on_second()
    assert law.others == 0

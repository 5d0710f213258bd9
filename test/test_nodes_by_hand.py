# SPDX-License-Identifier: Apache-2.0
"""The controller node with states sent by hand, and the plant node with torques."""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from random_arm import random_urdf
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.timer import Timer
from ros_rig import (
    JOINTS,
    START,
    FakeClock,
    cleanup,
    deactivate,
    states,
    torques,
)

import blf_dsc_controller as blf
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
)
from blf_dsc_controller.nodes import process
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode

ZERO = (0.0, 0.0)
VELOCITY = (
    0.005,
    -0.01,
)  # rad/s, of an arm at rest: faster, its start would be a blend
NEXT = tuple(q + 1e-3 * dq for q, dq in zip(START, VELOCITY, strict=True))


class Arm:
    """A stand-in for the arm: sends joint states to a controller and receives its torques."""

    def __init__(self, ros, names=JOINTS):
        self._ros = ros
        self._encoder = JointStateEncoder(names)
        self._publisher = ros.publisher(topics.JOINT_STATES)
        self.commands = ros.listen(topics.COMMANDS)
        ros.until(self._publisher.get_subscription_count)

    def send(self, stamp, position, velocity=None):
        """Send a state, at rest unless told otherwise, with its stamp [ns]."""
        still = np.zeros(len(position))
        velocity = still if velocity is None else velocity
        self._publisher.publish(self._encoder.encode(stamp, position, velocity, still))

    def torque_for(self, k, *state):
        """Send the state of sample k and return the torque received (2,) [N m]."""
        before = len(self.commands)
        self.send(1_000_000_000 + k * 1_000_000, *state)
        self._ros.until(lambda: len(self.commands) > before)
        return torques(self.commands)[-1]


def test_safe_torque_is_repeated_when_the_arm_falls_silent(ros, monkeypatch):
    """By a timer that its callback never resets: with no time left, those would multiply."""
    monkeypatch.setattr(Timer, 'reset', None)
    clock = FakeClock()
    node = ros.add(ControllerNode, {'safety.watchdog': 'on'}, clock=clock)
    arm = Arm(ros)
    assert arm.torque_for(0, START).any()
    assert not node.guard.supervisor.text
    clock.advance(0.1)
    ros.until(lambda: node.guard.supervisor.text)  # only the clock has advanced
    assert 'no joint state received for' in node.guard.supervisor.text
    before = len(arm.commands)
    ros.until(lambda: clock.advance(0.01) or len(arm.commands) >= before + 20)
    np.testing.assert_array_equal(torques(arm.commands)[-1], ZERO)


def test_cleanup_commands_the_torque_that_a_driver_may_hold(ros):
    """While it fades, whose last torque would else be held for as long as the node waits."""
    node = ros.add(ControllerNode)
    arm = Arm(ros)
    arm.torque_for(0, START)
    assert deactivate(ros, node)
    assert np.abs(arm.torque_for(1, START)).min() > 1.0
    assert cleanup(ros, node)
    ros.until(lambda: len(arm.commands) == 3)
    assert not torques(arm.commands)[-1].any()


@pytest.mark.parametrize('where', ['in the law', 'in another callback'])
def test_unexpected_error_is_answered_with_the_safe_torque_at_once(ros, where):
    """No other state comes, and a driver would hold the last torque."""
    node, arm = ros.add(ControllerNode), Arm(ros)
    assert arm.torque_for(0, START).any()

    def fail(*_):
        raise ZeroDivisionError('of the test')

    if where == 'in the law':
        node.guard.update, update = fail, node.guard.update
        torque = arm.torque_for(1, START)
        node.guard.update = update
    else:
        timer = node.create_timer(0.0, lambda: timer.cancel() or fail())
        for _ in range(300):
            if len(arm.commands) == 1:
                process.spin_once(ros.executor, node)
        torque = torques(arm.commands)[-1]
    np.testing.assert_array_equal(torque, ZERO)
    assert node.guard.supervisor.text == 'ZeroDivisionError: of the test'
    assert ros.reset(node).success
    assert arm.torque_for(2, START).any()


UNSUPPORTED = {'robot.urdf': random_urdf(3, seed=5)[0], 'robot.tip': 'tip'}
TOO_SLOW = (
    'joint states come every 0.01 s, but sample_time is 0.001 s: set update_rate of '
    'controller_manager (100 Hz by default) to 1000'
)


@pytest.mark.parametrize(
    ('steps', 'given', 'failure'),
    [
        ([1], {}, ''),
        ([1, 3, 3], {}, ''),
        ([10], {}, TOO_SLOW),
        ([33], {}, '-r joint_states:=franka/joint_states'),
        ([1], UNSUPPORTED, 'what holds the arm?'),
    ],
)
def test_live_arm_is_measured_before_the_start(ros, steps, given, failure):
    """Its rate, since controller_manager has 100 Hz by default, and what holds it.

    States lost on a busy computer are no other rate.
    """
    node = ros.add(ControllerNode, given)
    stamp = time.time_ns()
    arm = Arm(ros, node.config.joints)
    for k in range(12):
        stamp += steps[k % len(steps)] * 10**6
        arm.send(stamp, np.zeros(3) if given else START)
        ros.until(lambda k=k: node.finished or node.starting.count > k or arm.commands)
        assert bool(arm.commands) <= (k > 9 and not failure)
    ros.until(lambda: node.finished if failure else arm.commands)
    assert failure in str(node.failure)
    ros.spin(0.1)
    assert bool(arm.commands) != bool(failure)


def test_single_live_state_is_started_from_as_its_sender_waits_for_a_torque(ros):
    ros.add(ControllerNode, {'safety.state_timeout': 600.0})
    arm = Arm(ros)
    ros.spin(0.2)
    stamp = time.time_ns()
    # it may repeat the state while it waits
    ros.until(lambda: arm.send(stamp, START) or arm.commands)


@pytest.mark.parametrize(
    ('name', 'value', 'begin', 'end'),
    [
        ('two_link.feedback_gain', [30.0, 10.0], '', ''),
        (
            'two_link.feedback_gain',
            [4000.0, 15.0],
            'two_link.feedback_gain: K_p over the inertia is ',
            '; to use it anyway, start the node with it',
        ),
        (
            'sample_time',
            0.002,
            'sample_time is fixed at the start: arm and law are built',
            '',
        ),
    ],
)
def test_gain_change_takes_effect_at_the_next_sample_or_is_rejected(
    ros, name, value, begin, end
):
    """As `ros2 param set` does."""
    node, arm = ros.add(ControllerNode), Arm(ros)
    arm.torque_for(0, START, VELOCITY)
    request = SetParameters.Request(
        parameters=[Parameter(name, value=value).to_parameter_msg()]
    )
    (result,) = ros.call(
        SetParameters, f'{node.get_name()}/set_parameters', request
    ).results
    assert result.successful == (not begin)
    assert result.reason.startswith(begin)
    assert result.reason.endswith(end)
    law = blf.controller_of(blf.ControllerConfig())  # of the gains from before
    for k, q in enumerate((START, NEXT)):
        before = law.update(k * 1e-3, 1e-3, np.array([*q, *VELOCITY, 0.0, 0.0]))
    assert (
        np.array_equal(arm.torque_for(1, NEXT, VELOCITY), before) != result.successful
    )


# The plant, with torques sent by hand.

TORQUE = (5.0, 3.0)  # N m


def start_plant(ros, **values):
    """Start a plant in lock-step.

    Return it, what it publishes, and a way to send torques.
    """
    received = ros.listen(topics.JOINT_STATES, raw=True)
    node = ros.add(PlantNode, {'mode': 'lockstep', **values})
    commands = ros.publisher(topics.COMMANDS)
    ros.until(lambda: len(received) == 1 and commands.get_subscription_count() > 0)

    def send(torque):
        commands.publish(Float64MultiArrayEncoder(len(torque)).encode(torque))

    return node, received, send


@pytest.mark.parametrize(
    'invalid', [(1.0, 2.0, 3.0), (1.0, np.nan), (0.0, -2e4)], ids=str
)
def test_invalid_command_is_counted_but_not_applied(ros, invalid):
    node, received, send = start_plant(ros)
    send(TORQUE)
    ros.until(lambda: node.plant.sample == 1)
    send(invalid)
    ros.until(lambda: node.input.rejected == 1)
    assert node.plant.sample == 1
    send(TORQUE)
    ros.until(lambda: len(received) == 3)

    _, measured = states(received)
    np.testing.assert_array_equal(measured[1:, 2], [TORQUE] * 2)
    assert node.input.rejected == 1


def test_late_subscribers_receive_description_and_truth(ros):
    start_plant(ros, **{'arm.l2': 0.6})
    ros.spin(0.1)
    description = ros.listen(topics.ROBOT_DESCRIPTION)
    truth = ros.listen(topics.TRUTH)
    ros.until(lambda: description and truth)
    assert 'length="0.6"' in description[0].data
    known = dict(zip(truth[-1].name, truth[-1].position, strict=False))
    assert known['m2*l2^2'] == pytest.approx(0.5 * 0.6**2)  # kg m^2


# Of a live arm, again.


def start_live(ros, node, arm):
    """Send live states at 1 kHz until the law has commanded.

    Return the last stamp [ns].
    """
    stamp = time.time_ns()
    while not arm.commands:
        stamp += 10**6
        arm.send(stamp, START)
        ros.spin(0.005)
        assert not node.finished
    return stamp


def test_reset_measures_the_rate_again_and_a_later_refusal_ends_nothing(ros):
    """A driver that was restarted at another rate: the node stays, to be reset once more."""
    given = {'safety.state_timeout': 600.0}
    node = ros.add(ControllerNode, given)
    arm = Arm(ros)
    stamp = start_live(ros, node, arm)
    # rejected once, of an arm that has been in command
    node.guard.starting.refuse(blf.StartError('of the test'))
    node.report_if_changed(node.guard)
    assert not node.finished
    assert ros.reset(node).success
    count = len(arm.commands)
    for _ in range(15):
        stamp += 10**7
        arm.send(stamp, START)
        ros.spin(0.01)
    ros.until(lambda: node.guard.starting.error is not None)
    assert 'joint states come every 0.01 s' in str(node.guard.starting.error)
    assert not node.finished
    assert not node.guard.supervisor.running
    assert len(arm.commands) >= count


def test_bound_is_published_again_after_a_change(ros):
    bounds = ros.listen(topics.BOUND)
    node = ros.add(ControllerNode)
    arm = Arm(ros)
    arm.torque_for(0, START)
    ros.until(lambda: bounds)
    assert list(bounds[-1].position) == [0.002, 0.002]
    change = Parameter('barrier.bound', value=[0.003, 0.004])
    assert node.set_parameters([change])[0].successful
    ros.until(lambda: list(bounds[-1].position) == [0.003, 0.004])

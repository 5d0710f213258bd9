# SPDX-License-Identifier: Apache-2.0
"""The action that MoveIt follows trajectories by, over DDS, beside the loop in lock-step.

The cases are those of joint_trajectory_controller's own tests of its action.
"""

from __future__ import annotations

import importlib
import os
import re
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('ruckig', reason='needs ruckig')

import interfaces
import sros2_graph
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from rclpy.time import Time
from ros_rig import JOINTS, PATIENCE, START, RosRig, activate, deactivate
from std_srvs.srv import Trigger
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectoryPoint,
)

from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes import trajectory_action
from blf_dsc_controller.supervision.supervisor import Reason

BRISK = {
    'safety__state_timeout': 60.0,
    'limits__acceleration': [6.0, 6.0],
    'telemetry__decimation': 1,
    'reference__type': 'hold',
}
ENCLAVE = '/arm/controller'
NEAR = np.add(START, (0.1, -0.1))
FAR = np.add(START, (0.5, -0.6))
LONG = 10.0  # s of a motion that something ends, however late the messages of the action are
SUCCEEDED = GoalStatus.STATUS_SUCCEEDED
ABORTED = GoalStatus.STATUS_ABORTED
CANCELED = GoalStatus.STATUS_CANCELED


@pytest.fixture(scope='module')
def built():
    """Provide a folder with control_msgs, unless ROS has it."""
    if importlib.util.find_spec('control_msgs'):
        return None
    if interfaces.why_not():
        pytest.skip(
            f'control_msgs is not installed, and not built: {interfaces.why_not()}'
        )
    return interfaces.built(Path(__file__).parent / 'definitions' / 'control_msgs')


@pytest.fixture(scope='module')
def control_msgs(built):
    """Provide what the action consists of."""
    with pytest.MonkeyPatch.context() as patch:
        if built is not None:
            patch.syspath_prepend(built)
        yield importlib.import_module('control_msgs.action').FollowJointTrajectory
    if built is not None:
        for name in [each for each in sys.modules if each.startswith('control_msgs')]:
            del sys.modules[name]


class Client:
    """A client of a controller's action."""

    def __init__(self, ros, action):
        self.ros = ros
        self.action = action
        self.feedback = []
        self.client = ActionClient(
            ros.tester, action, '/blf_dsc_controller/follow_joint_trajectory'
        )
        ros.until(self.client.server_is_ready)

    def goal(self, *points, joints=JOINTS, stamp=0, path=(), arrival=(), time=0.0):
        """Return a goal; tolerances are joint, position, velocity."""
        from control_msgs.msg import JointTolerance

        goal = self.action.Goal()
        goal.trajectory = JointTrajectory(joint_names=joints, points=points)
        goal.trajectory.header.stamp = Time(nanoseconds=stamp).to_msg()
        for given, sent in (path, goal.path_tolerance), (arrival, goal.goal_tolerance):
            for name, position, velocity in given:
                tolerance = JointTolerance(name=name)
                tolerance.position, tolerance.velocity = position, velocity
                sent.append(tolerance)
        goal.goal_time_tolerance = Duration(nanoseconds=round(time * 1e9)).to_msg()
        return goal

    def send(self, goal):
        """Send a goal; return its handle once it is accepted or rejected."""
        future = self.client.send_goal_async(goal, self.feedback.append)
        self.ros.until(future.done)
        return future.result()

    def follow(self, *points, **options):
        """Send a goal that is accepted."""
        handle = self.send(self.goal(*points, **options))
        assert handle.accepted
        return handle

    def result(self, handle):
        """Return status and result of a goal."""
        future = handle.get_result_async()
        self.ros.until(future.done)
        return future.result().status, future.result().result

    def close(self):
        self.client.destroy()

    def cancel(self, handle):
        future = handle.cancel_goal_async()
        self.ros.until(future.done)
        return future.result()


def point(positions, time, velocities=(), accelerations=()):
    given = JointTrajectoryPoint(
        positions=[*positions], velocities=[*velocities], accelerations=[*accelerations]
    )
    given.time_from_start = Duration(nanoseconds=round(time * 1e9)).to_msg()
    return given


class Loop:
    """The running loop with a client of its action."""

    def __init__(self, ros, action):
        self.arm, self.law = ros.loop(None, BRISK)
        self.client = Client(ros, action)
        ros.run(self.arm, 50)

    def __iter__(self):
        """Provide the parts."""
        return iter((self.arm, self.law, self.client))


@pytest.fixture(scope='module')
def shared(control_msgs):
    """Provide a loop for several tests: to start it takes longer than any of them."""
    ros = RosRig(['--ros-args', '--enclave', ENCLAVE])
    loop = Loop(ros, control_msgs)
    yield loop
    loop.client.close()
    ros.close()


@pytest.fixture
def loop(shared):
    """Provide the loop with the arm at rest at START."""
    arm, law, client = shared
    client.feedback.clear()
    law.status.trajectories._is_stopped = False
    by_the_topic(law, client, START)
    client.ros.run(arm, 1100)
    np.testing.assert_allclose(rests_at(law), START, atol=1e-9)
    return shared


@pytest.fixture
def own_loop(ros, control_msgs):
    """Provide a loop that may be broken."""
    loop = Loop(ros, control_msgs)
    yield loop
    loop.client.close()


def reference(law):
    return law.guard.controller.reference_at(law.guard.reference.time)


def rests_at(law):
    """Return where the reference stays, which must rest."""
    q, dq, _ = law.guard.controller.reference_at(law.guard.reference.time + 10.0)
    np.testing.assert_array_equal(dq, 0.0)
    return q


SUCCESSES = {
    'points with the measured position first, as from MoveIt': [
        point(np.add(START, (2e-3, -3e-3)), 0.0, (0.0, 0.0), (0.0, 0.0)),
        point(NEAR, 1.0, (0.0, 0.0), (0.0, 0.0)),
    ],
    'points': [point(0.5 * (NEAR + START), 0.5), point(NEAR, 1.0)],
    'points with velocities': [
        point(0.5 * (NEAR + START), 0.5, (0.2, -0.2)),
        point(NEAR, 1.0, (0.0, 0.0)),
    ],
}


@pytest.mark.parametrize('points', SUCCESSES.values(), ids=SUCCESSES)
def test_goal_is_reached_with_feedback_on_the_way(loop, points):
    _, law, client = loop
    status, result = client.result(client.follow(*points))
    assert (status, result.error_code) == (SUCCEEDED, result.SUCCESSFUL)
    assert result.error_string == 'goal reached'
    np.testing.assert_allclose(rests_at(law), NEAR, atol=1e-9)
    client.ros.until(lambda: client.feedback)
    for message in (each.feedback for each in client.feedback):
        assert tuple(message.joint_names) == JOINTS
        desired, actual = message.desired, message.actual
        difference = np.subtract(desired.positions, actual.positions)
        np.testing.assert_array_equal(message.error.positions, difference)
        assert len(desired.accelerations) == len(actual.velocities) == 2
        assert np.abs(difference).max() < 0.02  # the bound
    times = [each.feedback.desired.time_from_start for each in client.feedback]
    # rclpy's client may call back for two that wait in any order
    times = np.sort([each.sec + 1e-9 * each.nanosec for each in times])
    # at 20 Hz; faster than real time, some are lost on the way
    assert np.diff(times).min() > 0.05 - 1e-6


def test_goal_that_ends_in_motion_succeeds_there_and_brakes(loop):
    _, law, client = loop
    velocity = np.array([0.3, -0.3])
    handle = client.follow(point(NEAR, 0.8, velocity))
    assert client.result(handle)[0] == SUCCEEDED
    # at 6 rad/s^2, which is reached within 0.05 s
    beyond = (rests_at(law) - NEAR) * np.sign(velocity)
    assert np.all((beyond > 0.0) & (beyond < 0.3 * (0.3 / 6.0 + 0.1)))


@pytest.mark.parametrize(
    ('tolerance', 'told'),
    [
        (('joint1', 1e-7, 0.0), "'joint1' is .* 1e-07 rad are allowed"),
        (('joint2', 0.0, 1e-6), "'joint2' is .* rad/s"),
    ],
)
def test_path_tolerance_of_a_goal_aborts_it_and_the_reference_rests(
    loop, tolerance, told
):
    arm, law, client = loop
    # joints may come in any order
    handle = client.follow(point(FAR[::-1], 1.0), joints=JOINTS[::-1], path=[tolerance])
    status, result = client.result(handle)
    assert (status, result.error_code) == (ABORTED, result.PATH_TOLERANCE_VIOLATED)
    assert re.search(told, result.error_string)
    assert np.abs(rests_at(law) - START).max() < 0.1  # it had hardly begun
    client.ros.run(arm, 500)
    np.testing.assert_array_equal(reference(law)[1:], 0.0)


def test_path_tolerance_of_a_goal_counts_once_its_trajectory_has_begun(loop):
    """The arm is hardly ever as near to its reference as is allowed."""
    _, law, client = loop
    begin = law.guard.reference.time + 3.0
    stamp = law.guard.reference.start_stamp + round(1e9 * begin)
    path = [('joint1', 1e-7, 0.0)]
    status, result = client.result(
        client.follow(point(FAR, 1.0), stamp=stamp, path=path)
    )
    assert (status, result.error_code) == (ABORTED, result.PATH_TOLERANCE_VIOLATED)
    assert law.guard.reference.time >= begin


def test_goal_tolerance_aborts_a_goal_that_has_not_arrived_in_time(loop):
    _, law, client = loop
    tolerance = [('joint1', 1e-12, 0.0)]
    handle = client.follow(point(NEAR, 0.5), arrival=tolerance, time=0.2)
    status, result = client.result(handle)
    assert (status, result.error_code) == (ABORTED, result.GOAL_TOLERANCE_VIOLATED)
    assert "not there 0.2 s after the end: 'joint1'" in result.error_string
    np.testing.assert_allclose(rests_at(law), NEAR, atol=1e-9)


def test_cancelled_goal_decelerates_within_the_limits_and_holds(loop):
    arm, law, client = loop
    references = client.ros.listen(topics.REFERENCE)
    client.ros.run(arm, 10)
    handle = client.follow(point(FAR, LONG))
    client.ros.until(lambda: np.abs(reference(law)[1]).min() > 0.05)
    client.cancel(handle)
    status, result = client.result(handle)
    assert (status, result.error_code) == (CANCELED, result.SUCCESSFUL)
    assert 'cancelled: braking for ' in result.error_string
    client.ros.run(arm, 1000)
    np.testing.assert_array_equal(reference(law)[1:], 0.0)
    assert np.abs(reference(law)[0] - FAR).min() > 0.01  # it stopped before
    v = np.array([each.velocity for each in references])
    assert np.abs(np.diff(v, axis=0)).max() <= 6.0e-3 * 1.001


def test_cancel_of_a_goal_does_not_brake_the_motion_that_has_replaced_it(loop):
    """Both come between two samples: the arm stands still, and so does its time."""
    arm, law, client = loop
    handle = client.follow(point(FAR, LONG))
    assert deactivate(client.ros, arm)
    by_the_topic(law, client)
    client.cancel(handle)
    client.ros.spin(0.1)
    assert activate(client.ros, arm)
    assert client.result(handle)[0] != SUCCEEDED
    np.testing.assert_allclose(rests_at(law), NEAR, atol=1e-9)


def by_a_goal(_law, client):
    return client.follow(point(NEAR, 1.0))


def by_the_topic(law, _client, q=NEAR):
    sent = JointTrajectory(joint_names=JOINTS, points=[point(q, 1.0)])
    law.status.trajectories.take_trajectory(serialize_message(sent))


def by_stop(_law, client):
    client.ros.call(Trigger, '/blf_dsc_controller/stop', Trigger.Request())


def by_reset(law, client):
    client.ros.reset(law)


PREEMPTED = {
    by_a_goal: 'pre-empted by another goal',
    by_the_topic: 'pre-empted by ~/joint_trajectory',
    by_stop: 'pre-empted by ~/stop',
    by_reset: '',  # out of command, or by a reset, as the next sample comes
}


@pytest.mark.parametrize('preempt', PREEMPTED, ids=lambda each: each.__name__)
def test_pre_empted_goal_is_aborted(loop, preempt):
    _, law, client = loop
    first = client.follow(point(FAR, LONG))
    second = preempt(law, client)
    status, result = client.result(first)
    assert (status, result.error_code) == (ABORTED, result.INVALID_GOAL)
    assert PREEMPTED[preempt] in result.error_string
    if second is not None:
        assert client.result(second)[0] == SUCCEEDED
        np.testing.assert_allclose(rests_at(law), NEAR, atol=1e-9)


def test_deactivation_aborts_the_goal(loop):
    arm, law, client = loop
    handle = client.follow(point(FAR, LONG))
    assert deactivate(client.ros, law)
    status, result = client.result(handle)
    assert (status, result.error_code) == (ABORTED, result.INVALID_GOAL)
    assert 'not in command any more' in result.error_string
    rejected = client.send(client.goal(point(NEAR, 1.0)))
    assert not rejected.accepted
    assert 'not in command: inactive' in law.status.trajectories.reason
    assert activate(client.ros, law)
    client.ros.run(arm, 50)


def test_stop_past_the_bound_violates_the_path(loop):
    arm, law, client = loop
    handle = client.follow(point(FAR, LONG))
    law.guard.stop(Reason.OUTSIDE_BOUND, "joint 'joint1' is past its bound")
    status, result = client.result(handle)
    assert (status, result.error_code) == (ABORTED, result.PATH_TOLERANCE_VIOLATED)
    assert "joint 'joint1' is past its bound" in result.error_string
    client.ros.reset(law)
    client.ros.run(arm, 50)


def in_the_past(client, law):
    return client.goal(point(NEAR, 0.01), stamp=law.guard.reference.start_stamp + 1)


def with_two_degrees_of_freedom(client, _law):
    goal = client.goal(point(NEAR, 1.0))
    goal.multi_dof_trajectory.points.append(MultiDOFJointTrajectoryPoint())
    return goal


def past_the_limits(client, _law):
    return client.goal(point((9.0, 0.0), 5.0))


def too_fast_for_its_time(client, _law):
    return client.goal(point(FAR, 0.1), time=0.2)


REJECTED = {
    in_the_past: 'it lies entirely in the past',
    with_two_degrees_of_freedom: '',  # which the log of the action's process says
    past_the_limits: 'past its limit of 6.28319 rad',
    too_fast_for_its_time: 'goal_time_tolerance allows 0.2 s',
}


@pytest.mark.parametrize('spoilt', REJECTED, ids=lambda each: each.__name__)
def test_goal_that_cannot_be_followed_is_rejected_and_the_one_before_goes_on(
    loop, spoilt
):
    arm, law, client = loop
    client.ros.run(arm, 100)
    good = client.follow(point(NEAR, 1.0))
    assert not client.send(spoilt(client, law)).accepted
    assert REJECTED[spoilt] in law.status.trajectories.reason
    assert client.result(good)[0] == SUCCEEDED


def test_goal_too_fast_for_the_limits_takes_longer_and_says_so(loop):
    _, law, client = loop
    begin = law.guard.reference.time
    status, result = client.result(client.follow(point(FAR, 0.1)))
    assert status == SUCCEEDED
    assert 'as fast as the limits allow: its end is ' in result.error_string
    # 0.6 rad at 1.5 rad/s and 6 rad/s^2
    assert law.guard.reference.time - begin > 0.6 / 1.5 + 1.5 / 6.0
    np.testing.assert_allclose(rests_at(law), FAR, atol=1e-9)


def test_process_of_the_action_has_the_enclave_of_its_controller_and_the_policys_access(
    shared,
):
    """Its profile in config/sros2_policy.xml, whose action stands for services and topics."""
    tester = shared.client.ros.tester
    nodes = tester.get_node_names_and_namespaces_with_enclaves()
    assert (sros2_graph.ACTION_NODE, '/', ENCLAVE) in nodes
    found = sros2_graph.granted(shared.client.ros, [sros2_graph.ACTION_NODE])
    action = f'/{sros2_graph.ACTION}/_action/'
    of_action = {
        kind: [name.removeprefix(action) for name in names if name.startswith(action)]
        for kind, names in found.items()
    }
    assert of_action == {
        'publish': ['feedback', 'status'],
        'subscribe': [],
        'reply': ['cancel_goal', 'get_result', 'send_goal'],
        'request': [],
    }
    others = {
        kind: [name for name in names if not name.startswith(action)]
        for kind, names in found.items()
    }
    assert others == sros2_graph.ACTION_ACCESS


def test_controller_goes_on_when_the_process_of_the_action_dies(own_loop, capfd):
    arm, law, client = own_loop
    process = law.action.process
    client.follow(point(NEAR, 0.5))
    process.kill()
    process.wait()
    client.ros.run(arm, 1000)
    np.testing.assert_allclose(rests_at(law), NEAR, atol=1e-9)
    assert (
        'the process of ~/follow_joint_trajectory has ended' in capfd.readouterr().err
    )


def test_process_of_the_action_ends_with_its_node(own_loop, capfd, monkeypatch):
    """Without a word, and not by a signal that its whole group gets: goals still end.

    A terminal sends Ctrl-C to all processes, systemd SIGTERM.
    """
    monkeypatch.setattr(trajectory_action, '_PATIENCE', PATIENCE)  # on a slow computer
    _, law, client = own_loop
    process = law.action.process
    os.kill(process.pid, signal.SIGINT)
    os.kill(process.pid, signal.SIGTERM)
    client.ros.spin(0.3)
    assert process.poll() is None
    assert client.result(client.follow(point(NEAR, 0.5)))[0] == SUCCEEDED
    client.ros.kill(law)
    assert process.returncode == 0
    said = capfd.readouterr().err
    assert 'Traceback' not in said
    assert 'has ended' not in said

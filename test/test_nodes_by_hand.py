# SPDX-License-Identifier: Apache-2.0
"""The controller node with states sent by hand, and the plant node with torques."""

from __future__ import annotations

import re
import threading
import time
from functools import lru_cache

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from random_arm import random_urdf
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.timer import Timer
from ros_rig import (
    JOINTS,
    PATIENCE,
    START,
    FakeClock,
    cleanup,
    deactivate,
    states,
    torques,
)

from blf_dsc_controller.configuration import schema
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import StartError
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
)
from blf_dsc_controller.messages.named_values import disturbance_names
from blf_dsc_controller.nodes import parameters, process
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.supervision import gain_limits, retuning
from sim_plant.plant import plant_of
from sim_plant.settings import parameter_names_of, urdf_of
from sim_plant.torque_input import Latency

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


def test_state_is_reported_when_it_changes_not_with_each_torque(ros):
    node = ros.add(ControllerNode)
    arm = Arm(ros)
    for k in range(3):
        arm.torque_for(k, START)
        assert not node.status.has_news(node.guard)
    node.guard.supervisor.add('of the test')
    assert node.status.has_news(node.guard)
    arm.torque_for(3, START)
    assert not node.status.has_news(node.guard)


def test_cleanup_commands_the_torque_that_a_driver_may_hold(ros):
    """In a ramp, whose last torque would else be held for as long as the node waits."""
    node = ros.add(ControllerNode, {'safety.deactivation_ramp': 10.0})
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
        end = time.monotonic() + PATIENCE
        while len(arm.commands) == 1:
            assert time.monotonic() < end, 'waited in vain'
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
    arm.send(time.time_ns(), START)
    ros.until(lambda: arm.commands)


def test_start_outside_the_bound_is_reported_with_joint_error_and_bound(ros):
    node = ros.add(ControllerNode, {'approach.enabled': False})
    Arm(ros).send(10**9, (START[0], START[1] - 0.0021))
    ros.until(lambda: node.finished)
    # 1.696 - 0.0021 against the reference's 1.6961 at its start
    assert isinstance(node.failure, StartError)
    assert "joint 'joint2' starts -0.0022 rad" in str(node.failure)
    assert 'its bound of 0.002 rad' in str(node.failure)


@pytest.mark.parametrize(
    ('name', 'value', 'begin', 'end'),
    [
        ('feedback.gain', [30.0, 10.0], '', ''),
        (
            'feedback.gain',
            [4000.0, 15.0],
            'feedback.gain: K_p over the inertia is ',
            '; to use it anyway, start the node with it',
        ),
        (
            'barrier.bound',
            [1e-6, 0.002],
            'barrier.bound: joint1 is ',
            '',
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
    law = controller_of(ControllerConfig())  # of the gains from before
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
    'invalid',
    [(1.0,), (1.0, 2.0, 3.0), (1.0, np.nan), (np.inf, 0.0), (1e300, 1.0), (0.0, -2e4)],
    ids=str,
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

    expected = plant_of(PlantConfig())
    expected.step(np.array(TORQUE))
    expected.step(np.array(TORQUE))
    _, measured = states(received)
    np.testing.assert_array_equal(measured[2].ravel(), expected.measure())
    assert node.input.rejected == 1


@pytest.mark.parametrize(
    'given',
    [{'arm.l2': 0.6}, {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}],
)
def test_late_subscribers_receive_description_and_truth(ros, given):
    start_plant(ros, **given)
    ros.spin(0.1)
    description = ros.listen(topics.ROBOT_DESCRIPTION)
    truth = ros.listen(topics.TRUTH)
    ros.until(lambda: description and truth)
    config = build(PlantConfig, given)
    assert description[0].data == urdf_of(config)
    assert 'robot.urdf' in given or 'length="0.6"' in description[0].data
    names = (*parameter_names_of(config), *disturbance_names(config.joints))
    assert tuple(truth[-1].name[: len(names)]) == names
    np.testing.assert_array_equal(truth[-1].position, plant_of(config).truth())


def test_first_states_may_be_incomplete(ros):
    received = ros.listen(topics.JOINT_STATES, raw=True)
    ros.add(PlantNode, {'mode': 'lockstep', 'sensor.incomplete_states': 3})
    ros.publisher(topics.COMMANDS)
    ros.until(lambda: len(received) == 4)
    stamps, measured = states(received)
    assert np.isfinite(measured[:, 0]).all()
    assert np.isfinite(measured[:, 1]).all(axis=1).tolist() == [
        False,
        False,
        False,
        True,
    ]
    assert np.diff(stamps).tolist() == [1_000_000] * 3


def test_reflex_is_reported_until_a_reset(ros):
    diagnostics = ros.listen(topics.DIAGNOSTICS)
    node, received, send = start_plant(ros, **{'actuator.reflex_rate': 1000.0})
    for sample in (1, 2):
        send(TORQUE)
        ros.until(lambda k=sample: node.plant.sample == k)
    ros.until(lambda: diagnostics[-1].status[0].message.startswith('reflex: '))
    node.reset()
    ros.until(lambda: diagnostics[-1].status[0].message.startswith('braked'))
    ros.until(lambda: len(received) == 4)
    send((0.0, 0.0))
    ros.until(lambda: diagnostics[-1].status[0].message == 'running')


LATE = 'sent 0, step 1, sent 1, step 2, sent 2, came 2.5, step 3'
ONCE = (
    'sent 0, step 1, sent 1, came 1.75, came 1.875, step 2, sent 2, came 2.25, step 3'
)


@pytest.mark.parametrize(
    ('events', 'waits', 'late'),
    [
        # A controller that is 2.5 samples late must not pass for one that is half a
        # sample late.
        (LATE, [1.0, 2.0, 2.5], 2),
        # The longest wait is published once: the first torque is late, for the state at
        # 0.
        (ONCE, [1.0, 1.75, 0.25], 1),
    ],
)
def test_latency_is_that_of_the_oldest_state_without_a_torque(events, waits, late):
    latency, found = Latency(), []
    for what, at in (event.split() for event in events.split(', ')):
        if what == 'step':
            found.append(latency.step(float(at)))
        else:
            {'sent': latency.state_published, 'came': latency.torque_received}[what](
                float(at)
            )
    assert (found, latency.late_steps) == (waits, late)


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
    given = {'safety.state_timeout': 600.0, 'safety.overrun_fraction': 1.0}
    node = ros.add(ControllerNode, given)
    arm = Arm(ros)
    stamp = start_live(ros, node, arm)
    # rejected once, of an arm that has been in command
    node.guard.starting.refuse(StartError('of the test'))
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


def test_change_of_a_gain_builds_each_configuration_once(ros, monkeypatch):
    """In the loop's thread: for a Panda, four times took longer than a silent arm may."""
    node, arm = ros.add(ControllerNode), Arm(ros)
    arm.torque_for(0, START)
    built = []
    built_settings = []
    threads = []

    def counted_build(*arguments):
        built.append(arguments)
        threads.append(threading.get_ident())
        return build(*arguments)

    def counted_settings(config):
        built_settings.append(config)
        threads.append(threading.get_ident())
        return settings_of_config(config)

    monkeypatch.setattr(schema, 'build', counted_build)
    monkeypatch.setattr(parameters, 'build', counted_build)
    cached = lru_cache(maxsize=2)(counted_settings)
    cached(node.config)
    for module in (retuning, gain_limits):
        monkeypatch.setattr(module, 'settings_in_loop', cached)
    change = Parameter('feedback.gain', value=[30.0, 10.0])
    assert node.set_parameters([change])[0].successful
    assert node.config.feedback.gain == (30.0, 10.0)
    assert len(built) == 1
    assert built_settings[1:] == [node.config]

    # By the services, as `ros2 param set` and `load` do: beside the loop.
    loop = threading.get_ident()
    assert threads == [loop] * 3
    changes = [
        Parameter('feedback.gain', value=[31.0, 10.0]),
        Parameter('barrier.bound', value=[0.003, 0.003]),
    ]
    request = [each.to_parameter_msg() for each in changes]
    for service in (SetParameters, SetParametersAtomically):
        name = re.sub(r'(?<!^)(?=[A-Z])', '_', service.__name__).lower()
        done = ros.call(
            service, f'{node.get_name()}/{name}', service.Request(parameters=request)
        )
        results = done.results if service is SetParameters else [done.result]
        assert all(each.successful for each in results)
        assert node.config.feedback.gain == (31.0, 10.0)
        assert node.config.barrier.bound == (0.003, 0.003)
    assert len(threads) == 3 + 2 + 1 + 2
    assert loop not in threads[3:]

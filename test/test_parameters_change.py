# SPDX-License-Identifier: Apache-2.0
"""Changing the parameters of a running node: a request is applied as a whole or not at all."""

from __future__ import annotations

import pytest

pytest.importorskip('rclpy')

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.nodes.parameters import declare, on_change, read


class Tuned:
    """A node that accepts changes, and the configurations it applied."""

    def __init__(self, context):
        self.node = Node('blf_dsc_controller', context=context, enable_rosout=False)
        self.applied = []
        self.problems = []
        declare(self.node, ControllerConfig)
        on_change(self.node, ControllerConfig, self.applied.append, lambda _: self.problems)

    def request(self, **given):
        """Send one atomic request; `__` stands for the dot."""
        values = {name.replace('__', '.'): value for name, value in given.items()}
        return self.node.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in values.items()]
        )

    @property
    def config(self):
        """The configuration that ROS holds now."""
        return read(self.node, ControllerConfig)


@pytest.fixture
def context():
    context = Context()
    context.init()
    yield context
    context.shutdown()


@pytest.fixture
def tuned(context):
    tuned = Tuned(context)
    yield tuned
    tuned.node.destroy_node()


def test_valid_changes_are_passed_on_once_each_as_a_whole_configuration(tuned):
    assert tuned.request(feedback__gain=[70.0, 30.0], learning__weight=2.0).successful
    expected = change(ControllerConfig(), {'feedback.gain': (70.0, 30.0), 'learning.weight': 2.0})
    assert tuned.applied == [expected]
    assert tuned.config == expected
    tuned.request(disturbance__leakage=0.5)
    assert tuned.applied == [expected, change(expected, {'disturbance.leakage': 0.5})]


@pytest.mark.parametrize(
    ('given', 'message'),
    [
        ({'feedback__gain': [1.0]}, 'feedback.gain: got 1 entry, but 2 are needed (2 of joints)'),
        ({'feedback__gain': [1.0, -1.0]}, 'feedback.gain: got -1.0 at entry 2 of [1.0, -1.0]'),
        ({'barrier__bound': [0.0, 1.0]}, 'barrier.bound: got 0.0 at entry 1 of [0.0, 1.0]'),
        ({'surface__time_constant': 0.0}, 'surface.time_constant: got 0.0, but it must be above'),
        ({'learning__update': 'magic'}, "learning.update: got 'magic', but it must be one of"),
        ({'surface__mu': [float('nan'), 1.0]}, 'surface.mu: got nan at entry 1'),
        ({'learning__radius': 0.1}, 'learning.radius: got 0.1 kg m^2, but learning.initial_est'),
        ({'barrier__weight': [3e4, 1.0]}, 'barrier.slope_limit: got 20000 N m/rad for joint1, but'),
        # ROS itself rejects these, by the descriptor of the parameter.
        ({'learning__weight': -1.0}, 'Parameter learning.weight out of range'),
        ({'learning__weight': float('inf')}, 'Parameter learning.weight out of range'),
        ({'learning__weight': 1}, 'Wrong parameter type, expected'),
    ],
)
def test_invalid_change_is_rejected_with_the_reason_and_none_of_it_applied(tuned, given, message):
    result = tuned.request(disturbance__gain=[3.0, 3.0], **given)
    assert not result.successful
    assert result.reason.startswith(message)
    assert tuned.applied == []
    assert tuned.config == ControllerConfig()


def test_changes_that_are_valid_only_together_are_applied_together(tuned):
    assert not tuned.request(barrier__weight=[3e4, 3e4]).successful
    assert tuned.request(barrier__weight=[3e4, 3e4], barrier__slope_limit=[5e4, 5e4]).successful
    assert tuned.applied[-1].barrier.weight == (3e4, 3e4)
    # Now the limit is validated against the current weight, not against the first one.
    assert not tuned.request(barrier__slope_limit=[2.5e4, 2.5e4]).successful


def test_node_can_reject_a_valid_configuration(tuned):
    tuned.problems = ['barrier.bound: joint1 is 0.0015 rad off now']
    result = tuned.request(barrier__bound=[0.001, 0.001])
    assert (result.successful, result.reason) == (False, tuned.problems[0])
    assert tuned.applied == []
    tuned.problems = []
    assert tuned.request(barrier__bound=[0.001, 0.001]).successful


def test_other_parameters_of_the_node_are_left_alone(tuned):
    tuned.problems = ['never']
    tuned.node.declare_parameter('lamp.on', value=False)
    assert tuned.request(lamp__on=True).successful
    assert tuned.applied == []


def test_set_parameters_service_behaves_the_same(context, tuned):
    executor = SingleThreadedExecutor(context=context)
    client_node = Node('client_node', context=context, enable_rosout=False)
    client = client_node.create_client(
        SetParametersAtomically, '/blf_dsc_controller/set_parameters_atomically'
    )
    for node in (tuned.node, client_node):
        executor.add_node(node)
    assert client.wait_for_service(timeout_sec=300.0)

    def result(value, name='feedback.gain'):
        message = Parameter(name, value=value).to_parameter_msg()
        future = client.call_async(SetParametersAtomically.Request(parameters=[message]))
        executor.spin_until_future_complete(future, timeout_sec=300.0)
        return future.result().result

    assert result([65.0, 25.0]).successful
    rejection = result([65.0, -25.0])
    assert rejection.reason.startswith('feedback.gain: got -25.0 at entry 2 of [65.0, -25.0]')
    refusal = result(0.002, 'sample_time')
    assert refusal.reason.startswith('sample_time is fixed at the start: it sets the size')
    assert not refusal.successful
    assert [config.feedback.gain for config in tuned.applied] == [(65.0, 25.0)]
    executor.shutdown()
    client_node.destroy_node()

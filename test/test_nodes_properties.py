# SPDX-License-Identifier: Apache-2.0
"""Arbitrary input in arbitrary order: no callback raises, and every torque is valid.

`make test-nightly` runs ten thousand examples of each, `make test` sixty.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.parameter import Parameter
from ros_rig import START
from std_srvs.srv import Trigger

import blf_dsc_controller as blf
from blf_dsc_controller.configuration import schema
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayEncoder,
    JointStateEncoder,
)
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode

EXAMPLES = 2_000 if os.environ.get('NIGHTLY') else 60
SETTINGS = settings(max_examples=EXAMPLES, suppress_health_check=list(HealthCheck))

numbers = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True, width=64),
    st.floats(-4.0, 4.0),
    st.sampled_from([0.0, np.nan, np.inf, 1e308, 5e-324]),
)
names = st.lists(st.sampled_from(['joint1', 'joint2', 'joint3', '', 'ü']), max_size=4)


@st.composite
def joint_states(draw):
    """Serialised joint states: valid ones, invalid ones, and random bytes."""
    kind = draw(
        st.sampled_from(
            ['good', 'good', 'good', 'near', 'wrong', 'names', 'bytes', 'cut']
        )
    )
    step = draw(st.sampled_from([1, 1, 1, 1, 0, 2, 60, -1, -1000, 10**7]))
    q = [start + draw(st.floats(-1e-3, 1e-3)) for start in START]
    dq = [draw(st.floats(-0.1, 0.1)) for _ in START]
    if kind == 'bytes':
        return step, lambda _: draw(st.binary(max_size=200))
    if kind == 'wrong':
        q, dq = ([draw(numbers) for _ in START] for _ in range(2))
    if kind == 'near':
        q = [start + draw(st.floats(-0.1, 0.1)) for start in START]
    joints = draw(names) if kind == 'names' else ['joint1', 'joint2']
    fields = draw(st.sets(st.sampled_from(['position', 'velocity', 'effort'])))
    if kind != 'names':
        fields |= {'position', 'velocity'}
    encoder = JointStateEncoder(joints, fields)
    values = {'position': q, 'velocity': dq, 'effort': dq}
    content = {name: (values[name] * 2)[: len(joints)] for name in fields}
    cut = draw(st.integers(0, 100)) if kind == 'cut' else 0

    def raw(stamp):
        message = encoder.encode(stamp % 2**61, **content)
        return message[: len(message) - cut]

    return step, raw


VALUES = {
    'bool': st.booleans(),
    'integer': st.integers(-1, 10),
    'double': numbers,
    'string': st.sampled_from(['zero', 'hold_gravity', 'damping', 'x']),
    'double array': st.one_of(
        st.lists(st.floats(0.0, 19.0), max_size=3), st.lists(numbers, max_size=3)
    ),
    'string array': st.lists(st.sampled_from(['torque.limit', 'x']), max_size=2),
}
LIVE = {
    each.name: VALUES[each.kind]
    for config in (blf.ControllerConfig, blf.PlantConfig)
    for each in schema.parameters(config)
    if not each.read_only
}
parameters = st.one_of(
    st.sampled_from(sorted(LIVE)).flatmap(
        lambda name: st.tuples(st.just(name), LIVE[name])
    ),
    st.tuples(st.just('joints'), st.just(['a', 'b'])),
)
# create, configure to deactivate, none
transitions = st.sampled_from([0, 1, 2, 3, 4, 77])


def events(messages):
    """Sequences of events that a node can meet, mostly messages."""
    event = st.one_of(
        st.tuples(st.just('message'), messages),
        st.tuples(st.just('message'), messages),
        st.tuples(st.just('parameter'), parameters),
        st.tuples(st.just('transition'), transitions),
        st.tuples(st.just('reset'), st.none()),
        st.tuples(st.just('tick'), st.none()),
    )
    return st.lists(event, max_size=30)


def apply_event(node, kind, content):
    """Apply one event to a node, through the callbacks that ROS would call."""
    if kind == 'transition':
        request = ChangeState.Request(transition=Transition(id=content))
        node._service_change_state.callback(request, ChangeState.Response())
    elif kind == 'reset':
        (service,) = (
            each for each in node.services if each.srv_name.endswith('/reset')
        )
        service.callback(Trigger.Request(), Trigger.Response())
    elif kind == 'tick':
        node._on_poll()
        node._report()
    elif kind == 'parameter':
        name, value = content
        if not node.has_parameter(name):  # of the other node
            return
        typed = Parameter(name, value=value) if value != [] else Parameter(name)
        node.set_parameters_atomically([typed])


@given(events(joint_states()))
@example([('parameter', ('torque.limit', [1.0, 5e-324]))])
@SETTINGS
def test_controller_survives_arbitrary_input(ros, sequence):
    node = ControllerNode(context=ros.context, cli_args=[], enable_rosout=False)
    commands = []
    node.command = lambda torque: torque is None or commands.append(torque.copy())
    node.starting._was_observed = True
    stamp = 10**9
    try:
        for kind, content in sequence:
            if kind == 'message':
                step, raw = content
                stamp = max(1, stamp + step * 1_000_000)
                node._on_joint_state(raw(stamp))
            apply_event(node, kind, content)
            limit = np.array(node.config.torque.limit)
            for torque in commands:
                assert np.isfinite(torque).all()
                assert (np.abs(torque) <= limit).all()
            commands.clear()
    finally:
        node.destroy_node()


@st.composite
def commands(draw):
    """Serialised torques of any number of values, and random bytes."""
    if draw(st.booleans()):
        values = draw(st.lists(numbers, max_size=4))
        return Float64MultiArrayEncoder(len(values)).encode(values)
    return draw(st.binary(max_size=60))


@given(events(commands()))
@SETTINGS
def test_plant_survives_arbitrary_input(ros, sequence):
    overrides = [
        Parameter('mode', value='lockstep'),
        Parameter('actuator.torque_limit', value=[20.0, 20.0]),
    ]
    node = PlantNode(
        context=ros.context,
        cli_args=[],
        enable_rosout=False,
        parameter_overrides=overrides,
    )
    node.is_observed = lambda: True
    node._peers = iter(())  # all there
    try:
        for kind, content in sequence:
            if kind == 'message':
                node._on_command(content)
            apply_event(node, kind, content)
            assert np.isfinite(node.input.torque).all()
            if node.state_label == 'active':
                measured = node.plant.measure()
                assert np.isfinite(measured).all()
                assert (np.abs(measured[4:]) <= 20.0).all()
    finally:
        node.destroy_node()

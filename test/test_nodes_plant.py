# SPDX-License-Identifier: Apache-2.0
"""The plant node with torques sent by hand."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from ros_rig import states

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.law.telemetry import disturbance_names
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import Float64MultiArrayEncoder
from blf_dsc_controller.nodes.plant_node import PlantNode
from sim_plant.plant import Latency, parameter_names_of, plant_of, urdf_of

TORQUE = (5.0, 3.0)  # N m


def start_plant(ros, **values):
    """Start a plant in lock-step; return it, what it publishes, and a way to send torques."""
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
    'given', [{'arm.l2': 0.6}, {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}]
)
def test_late_subscribers_receive_description_and_truth(ros, given):
    start_plant(ros, **given)
    ros.spin(0.1)
    description, truth = ros.listen(topics.ROBOT_DESCRIPTION), ros.listen(topics.TRUTH)
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
    assert np.isfinite(measured[:, 1]).all(axis=1).tolist() == [False, False, False, True]
    assert np.diff(stamps).tolist() == [1_000_000] * 3


def test_reflex_is_reported_and_lasts_until_a_reset(ros):
    diagnostics = ros.listen(topics.DIAGNOSTICS)
    node, received, send = start_plant(ros, **{'actuator.reflex_rate': 1000.0})
    for sample in (1, 2):
        send(TORQUE)
        ros.until(lambda k=sample: node.plant.sample == k)
    assert node.plant.is_stopped
    ros.until(lambda: len(received) == 3)
    assert not states(received)[1][-1, 1].any()
    ros.until(lambda: diagnostics[-1].status[0].message.startswith('reflex: '))
    node.reset()
    assert not node.plant.is_stopped
    ros.until(lambda: diagnostics[-1].status[0].message.startswith('braked'))
    ros.until(lambda: len(received) == 4)
    send((0.0, 0.0))
    ros.until(lambda: diagnostics[-1].status[0].message == 'running')


LATE = 'sent 0, step 1, sent 1, step 2, sent 2, came 2.5, step 3'
ONCE = 'sent 0, step 1, sent 1, came 1.75, came 1.875, step 2, sent 2, came 2.25, step 3'


@pytest.mark.parametrize(
    ('events', 'waits', 'late'),
    [
        # A controller that is 2.5 samples late must not pass for one that is half a sample late.
        (LATE, [1.0, 2.0, 2.5], 2),
        # The longest wait is published once: the first torque is late, for the state at 0.
        (ONCE, [1.0, 1.75, 0.25], 1),
    ],
)
def test_latency_is_that_of_the_oldest_state_without_a_torque(events, waits, late):
    latency, found = Latency(), []
    for what, time in (event.split() for event in events.split(', ')):
        if what == 'step':
            found.append(latency.step(float(time)))
        else:
            {'sent': latency.state_published, 'came': latency.torque_received}[what](float(time))
    assert (found, latency.late_steps) == (waits, late)

# SPDX-License-Identifier: Apache-2.0
"""Events between two samples replay bit for bit from the bag of the nodes.

Bags are played.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import recorded_run
from rclpy.parameter import Parameter
from recorded_run import compared, of
from ros_rig import FakeClock, RosRig, activate, configure, deactivate
from test_nodes_trajectory import JOINTS, SECOND

from blf_dsc_controller import verify
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.nodes.process import drain
from blf_dsc_controller.nodes.recorder_node import BagRecorderNode

# no two torques alike
DAMPED = {'safety__torque': 'hold_gravity', 'safety__damping': [2.0, 1.0]}


class Recording:
    """A loop in lock-step and its recorder, all in this process."""

    def __init__(self, path, clock=time.monotonic_ns, **controller):
        self.ros = RosRig()
        self.path = path
        self.recorder = self.ros.add(BagRecorderNode, output=str(path))
        complete = {'wait_for_subscribers': 1}
        waiting = complete | {'autostart': False}
        self.arm, self.law = self.ros.loop(waiting, complete | controller, clock=clock)
        configure(self.ros, self.arm)
        activate(self.ros, self.arm)

    def run(self, samples):
        self.ros.run(self.arm, samples)

    def change(self, name, value):
        (result,) = self.law.set_parameters([Parameter(name, value=value)])
        assert result.successful, result.reason

    def end(self):
        """Stop the plant, let the recorder receive everything, and complete the bag."""
        deactivate(self.ros, self.arm)
        self.ros.until(lambda: self.law.guard.journal.stamp == self.arm.stamp)
        for node in (self.arm, self.law):
            drain(node.publishers)
        self.recorder.close()
        self.ros.close()
        return self.path


def test_stops_ramps_and_activations_replay_with_identical_torques(tmp_path):
    """A pause, a stop in which a gain changes, a reset, a stop since no state comes any more."""
    clock = FakeClock()
    run = Recording(tmp_path / 'bag', clock, safety__watchdog='on', **DAMPED)
    run.ros.until(lambda: clock.advance(0.01) or run.arm.is_offered)
    run.run(100)
    deactivate(run.ros, run.law)
    run.run(600)  # past the ramp
    activate(run.ros, run.law)
    run.run(200)
    run.arm.start_stamp += SECOND // 10  # the next state is too late
    run.ros.until(lambda: run.law.guard.supervisor.text)
    run.run(50)
    run.change('safety.damping', [4.0, 3.0])
    run.run(50)
    deactivate(run.ros, run.law)
    run.run(50)
    activate(run.ros, run.law)
    run.run(100)
    run.ros.reset(run.law)
    run.run(100)
    deactivate(run.ros, run.arm)
    clock.advance(0.1)
    run.ros.until(lambda: run.law.guard.supervisor.text)
    silent = run.law.guard.reference.last_stamp
    activate(run.ros, run.arm)
    run.ros.until(lambda: clock.advance(0.01) or run.arm.is_offered)
    run.run(20)
    deactivate(run.ros, run.law)
    activate(run.ros, run.law)  # after a stop, keeping only the estimates
    run.run(50)
    bag = run.end()
    result = verify(bag)
    assert (result.difference, result.remarks) == (None, ())
    assert [event.type for event in result.events].count(EventType.PARAMETERS) == 1
    assert ', '.join(result.transitions) == (
        'activate, deactivate, activate, safe stop (stamp jump), deactivate, activate, reset, '
        'safe stop (state timeout), deactivate, activate'
    )
    errors = read_content(bag).topics[topics.TRACKING_ERROR].joint_states(JOINTS, ())
    used = errors.stamp[np.isfinite(errors.field(0)[:, 0])]
    assert result.samples == used.size
    assert np.count_nonzero(used > silent) >= 30
    torques = len(of(recorded_run.messages(bag), topics.COMMANDS))
    assert compared(result)['commands'] == 2 * torques
    assert compared(result)['tracking_error'] == 6 * errors.size
    assert torques - result.samples >= 600 + 2 * 50

# SPDX-License-Identifier: Apache-2.0
"""The plant's waiting time for a torque, at times given by the test [ms]."""

from __future__ import annotations

from sim_plant.command_input import Latency


def test_latency_of_a_late_torque_includes_all_of_its_lateness():
    """A controller that is 2.5 samples late must not pass for one that is half a sample late."""
    latency = Latency()
    latency.state_published(0.0)
    assert latency.step(1.0) == 1.0  # no torque so far
    latency.state_published(1.0)
    assert latency.step(2.0) == 2.0
    latency.state_published(2.0)
    latency.torque_received(2.5)
    assert latency.step(3.0) == 2.5
    assert latency.late_steps == 2


def test_longest_wait_of_a_sample_is_published_once():
    latency = Latency()
    latency.state_published(0.0)
    latency.step(1.0)
    latency.state_published(1.0)
    latency.torque_received(1.75)  # late, for the state at 0.0
    latency.torque_received(1.875)  # for the state at 1.0
    assert latency.step(2.0) == 1.75
    latency.state_published(2.0)
    latency.torque_received(2.25)
    assert latency.step(3.0) == 0.25
    assert latency.late_steps == 1

# SPDX-License-Identifier: Apache-2.0
"""No way round the gate: no pause lets an arm of another rate start."""

from __future__ import annotations

import pytest

from blf_dsc_controller.supervision.start_gate import GateState, StartGate

MILLISECOND = 1_000_000  # ns
NOW = 1_700_000_000_000_000_000  # ns
PAUSE = 30  # checks of 8 ms


def fill(gate, period, count=11, begin=NOW):
    """Send `count` states of a period [ms]; return the last answer."""
    return [gate.take(begin + k * period * MILLISECOND) for k in range(count)][-1]


@pytest.mark.parametrize('states', [2, 10])
def test_pause_within_the_first_states_begins_the_measurement_anew(states):
    gate = StartGate(1e-3)
    fill(gate, 10, states)
    assert not any(gate.poll() for _ in range(PAUSE))
    assert (gate.state, gate.count) == (GateState.MEASURING, 0)
    assert fill(gate, 10, begin=NOW + 10**9) is GateState.REFUSED


def test_slow_sender_is_refused_although_it_is_asked_about_between_its_states():
    """At 30 Hz there are four looks between two states; only a pause of 25 is one."""
    gate = StartGate(1e-3)
    for k in range(11):
        gate.take(10**9 + k * 33 * MILLISECOND)
        assert not any(gate.poll() for _ in range(4))
    assert gate.state is GateState.REFUSED

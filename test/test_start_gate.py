# SPDX-License-Identifier: Apache-2.0
"""No way round the gate: no clock and no pause lets an arm of another rate start."""

from __future__ import annotations

import pytest

from blf_dsc_controller.supervision.start_gate import GateState, StartGate

MILLISECOND = 1_000_000  # ns
CLOCKS = {'live': 1_700_000_000_000_000_000, 'an hour off': 1_699_996_400_000_000_000}
PAUSE = 30  # checks of 8 ms


def fill(gate, period, count=11, begin=CLOCKS['live']):
    """Send `count` states of a period [ms]; return the last answer."""
    return [gate.take(begin + k * period * MILLISECOND) for k in range(count)][-1]


@pytest.mark.parametrize('clock', CLOCKS)
@pytest.mark.parametrize(
    ('period', 'state'),
    [(1, GateState.OPEN), (10, GateState.REFUSED), (2, GateState.REFUSED)],
)
def test_rate_decides_whatever_the_clock(clock, period, state):
    gate = StartGate(1e-3)
    assert fill(gate, period, 10, CLOCKS[clock]) is GateState.MEASURING
    assert fill(gate, period, 11, CLOCKS[clock]) is state
    assert bool(gate.problem) == (state is GateState.REFUSED)


@pytest.mark.parametrize('states', range(2, 11))
def test_pause_within_the_first_states_begins_the_measurement_anew(states):
    gate = StartGate(1e-3)
    fill(gate, 10, states)
    assert not any(gate.poll() for _ in range(PAUSE))
    assert (gate.state, gate.count) == (GateState.MEASURING, 0)
    assert fill(gate, 10, begin=CLOCKS['live'] + 10**9) is GateState.REFUSED


def test_sender_that_waits_for_a_torque_is_waited_for_only_once():
    gate = StartGate(1e-3)
    assert not any(gate.poll() for _ in range(PAUSE))  # nothing has come
    gate.take(10**9)
    assert sum(gate.poll() for _ in range(PAUSE)) == 1
    assert gate.take(10**9) is gate.state is GateState.WAITED_FOR
    gate.restart()
    assert gate.state is GateState.MEASURING


def test_repeated_state_is_no_newer_one():
    """A plant in lock-step sends its state again while it waits."""
    gate = StartGate(1e-3)
    found = []
    for _ in range(5):
        gate.take(10**9)
        found += [gate.poll() for _ in range(10)]
    assert sum(found) == 1


def test_slow_sender_is_refused_although_it_is_asked_about_between_its_states():
    """At 30 Hz there are four looks between two states; only a pause of 25 is one."""
    gate = StartGate(1e-3)
    for k in range(11):
        gate.take(10**9 + k * 33 * MILLISECOND)
        assert not any(gate.poll() for _ in range(4))
    assert gate.state is GateState.REFUSED

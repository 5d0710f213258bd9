# SPDX-License-Identifier: Apache-2.0
"""What a bound at the tool and the detection of contacts cost in each state of a Panda.

A state is answered by the guarded law as in a node, with its telemetry encoded; the middleware is
left out.  Contestants take turns, with the states of their own simulated runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from time import perf_counter

import numpy as np

from benchmark.harness import FULL, Ratio, ratio
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, load_loop
from blf_dsc_controller.control.guarded_loop import GuardedLoop
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.simulation.loop import simulate

_ROUNDS = 15
_STATES = 1000  # in each turn
_BASELINE = 'without both'
_TOOL: Mapping[str, object] = {
    'barrier.bound': None,
    'barrier.tool_bound': 0.02,
    'barrier.tool_angle_bound': 0.1,
}
_FELT: Mapping[str, object] = {'contact.enabled': True, 'contact.reaction': 'hold'}
_CONTESTANTS: Mapping[str, Mapping[str, object]] = {
    _BASELINE: {},
    'bound at the tool': _TOOL,
    'contacts': _FELT,
    'both': {**_TOOL, **_FELT},
}
_UNTIL, _WHOLE = 'until the torque', 'whole'


class Contestant:
    """A guarded loop that answers the states of a run, from when its window is full."""

    def __init__(self, given: Mapping[str, object]) -> None:
        quiet: dict[str, object] = {
            f'events.{each}': [] for each in ('begin', 'duration', 'payload')
        }
        states = (_ROUNDS + 1) * _STATES
        plant = {'duration': FULL + 1e-3 * states, **quiet}
        loop = load_loop('panda_rigid', {PLANT: plant, CONTROLLER: given})
        record = simulate(loop.controller, loop.plant)
        stamps = (FIRST_STAMP + record.stamps).tolist()
        self._states = zip(stamps, record.measurements, strict=True)
        self._loop = GuardedLoop(loop.controller, lambda: 0, lambda: 0)
        self._loop.guard.starting.activate()
        self.answer(len(stamps) - states)
        if not self._loop.guard.controller.sample.latched[0]:
            raise RuntimeError(f'nothing is learned in {FULL:g} s')

    def answer(self, count: int) -> tuple[float, float]:
        """Return the times of a state [s]: until its torque is known, and until all is done."""
        guard = self._loop.guard
        until = 0.0
        begin = perf_counter()
        for stamp, measurement in itertools.islice(self._states, count):
            before = perf_counter()
            torque = guard.update(stamp, measurement)
            until += perf_counter() - before
            guard.perceive()
            for _ in self._loop.messages(torque):
                pass
        if not guard.supervisor.running:
            raise RuntimeError(f'the run has stopped: {guard.supervisor.text}')
        return until / count, (perf_counter() - begin) / count


def measure() -> Iterator[Ratio]:
    """Measure the times of a state relative to those without both."""
    found = {name: Contestant(given) for name, given in _CONTESTANTS.items()}
    seconds = {name: np.empty((_ROUNDS, 2)) for name in found}
    for k in range(-1, _ROUNDS):  # the first round is a warm-up
        for name, contestant in found.items():
            times = contestant.answer(_STATES)
            if k >= 0:
                seconds[name][k] = times
    baseline = seconds.pop(_BASELINE)
    group = 'Panda, time of a state in the guarded law'
    for name, each in seconds.items():
        for column, part in enumerate((_UNTIL, _WHOLE)):
            mine, theirs = each[:, column], baseline[:, column]
            here, there = (1e6 * np.median(times) for times in (mine, theirs))
            note = f'{here:.1f} instead of {there:.1f} us here'
            yield ratio(group, f'{name}: {part}', _BASELINE, mine, theirs, note)

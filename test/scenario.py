# SPDX-License-Identifier: Apache-2.0
"""Scenarios: an arm under `blf.ArmController`, what goes wrong with it, and its record.

    arm = Scenario('fr3', {'safety.torque': 'hold_gravity'}, plant=carrying(2.0))
    before = arm.run(2.0)
    arm.controller.stop()
    after = arm.run(1.0, spoil=changed(dq=lambda dq: 0.0 * dq))
    assert after.speed.max() < before.speed.max()

In each sample the arm is measured, `spoil` makes of that the states that arrive, the
controller answers each, `reach` makes of the answer what the drives give, and the arm
moves on.  Drives hold the last torque while no other comes; before the first one they
give none.  The record has what is true beside what was measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

import blf_dsc_controller as blf
from sim_plant.plant import plant_of

START = 1.0  # s, stamp of the first state
RUNNING = blf.Phase.APPROACHING, blf.Phase.TRACKING


@dataclass(frozen=True)
class State:
    """A joint state as it arrives: its stamp [s], and (n,) rad, rad/s, N m."""

    stamp: float
    q: np.ndarray
    dq: np.ndarray
    effort: np.ndarray


Spoil = Callable[[State], Iterable[State]]
Reach = Callable[[np.ndarray], np.ndarray]


class Record(NamedTuple):
    """The samples of a run, the first axis of each array."""

    t: np.ndarray  # (k,) s, since the scenario began
    q: np.ndarray  # (k, n) rad, true
    dq: np.ndarray  # (k, n) rad/s, true
    measured: np.ndarray  # (k, 3, n) last state that arrived: rad, rad/s, N m
    torque: np.ndarray  # (k, n) N m, last answer of the controller; NaN: it gave none
    dqr: np.ndarray  # (k, n) rad/s, of the reference; 0 out of command
    error: np.ndarray  # (k, n) rad, of the reference; NaN out of command
    bound: np.ndarray  # (k, n) rad, on this error
    phase: np.ndarray  # (k,) of blf.Phase

    @property
    def speed(self) -> np.ndarray:
        """True |dq| (k, n) [rad/s]."""
        return np.abs(self.dq)

    @property
    def ratio(self) -> float:
        """Largest error over its bound, while the law was in command."""
        return float(np.nanmax(np.abs(self.error) / self.bound))

    @property
    def stop(self) -> int:
        """The first sample in the safe stop; the number of samples: there was none."""
        stopped = self.phase == blf.Phase.SAFE_STOP
        return int(stopped.argmax()) if stopped.any() else len(self.t)

    def since(self, begin: int, end: int | None = None) -> Record:
        """Return some of the samples."""
        return Record(*(values[begin:end] for values in self))


class Scenario:
    """An arm of a preset, and the controller that commands it.

    Attributes:
        controller: the `blf.ArmController` in command; `restart` makes another one.
        plant: the arm; any with `measure`, `truth` and `step`.
    """

    def __init__(
        self,
        preset: Any,
        given: Mapping[str, Any] | None = None,
        *,
        plant: Any = None,
        record: Any = None,
    ) -> None:
        """`preset` is a name, a file, or what `blf.load_loop` returns of one.

        `given` are parameters of the controller, `plant` those of the arm, or an arm of
        your own; `record` is the folder of a bag.
        """
        of_arm = plant if isinstance(plant, Mapping) else {}
        if isinstance(preset, tuple):  # as load_loop returns it
            loop = preset
        else:
            given = {'blf_dsc_controller': given or {}, 'sim_plant': of_arm}
            loop, given, of_arm = blf.load_loop(preset, given), {}, {}
        self.config = blf.change(loop.controller, given or {})
        is_arm = plant is not None and not isinstance(plant, Mapping)
        self.plant = plant if is_arm else plant_of(blf.change(loop.plant, of_arm))
        self.T = self.config.sample_time
        self.n = len(self.config.joints)
        self.restart(record=record)

    def restart(
        self,
        given: Mapping[str, Any] | None = None,
        *,
        acting: np.ndarray | None = None,
        record: Any = None,
    ) -> None:
        """Let another controller take over, which has learned nothing.

        `acting` (n,) [N m] is the torque by which another node holds the arm meanwhile.
        """
        self.config = blf.change(self.config, given or {})
        self.controller = blf.ArmController(self.config, record=record)
        if acting is not None:
            self.guard.starting.take_over_from(acting)
        self._applied = np.zeros(self.n)
        self._answer: np.ndarray | None = None
        self._arrived = np.full((3, self.n), np.nan)
        self._nothing = self._arrived[0]

    # The law between its checks, which a shell sees and a user of ArmController does not.

    @property
    def guard(self):
        """The guard of the controller."""
        return self.controller.guard

    @property
    def reason(self) -> str:
        """The kind of the last stop, such as `error past the bound`."""
        return str(self.guard.supervisor.reason)

    @property
    def text(self) -> str:
        """Why the controller stopped or does not start."""
        return self.controller.reason

    @property
    def is_running(self) -> bool:
        """Whether the law is in command."""
        return self.controller.phase in RUNNING

    @property
    def events(self) -> list:
        """All events so far."""
        return list(self.guard.journal.pending)

    def change(self, given: Mapping[str, Any]) -> list[str]:
        """Change parameters at run time; return the problems, with which nothing changes."""
        config = blf.change(self.config, given)
        problems = self.guard.problems(config)
        if not problems:
            self.guard.retune(config)
            self.config = config
        return problems

    def run(
        self,
        seconds: float,
        *,
        spoil: Spoil | None = None,
        reach: Reach | None = None,
        at: Mapping[float, Callable[[], Any]] | None = None,
        until: Callable[[], bool] | None = None,
    ) -> Record:
        """Run for a time [s], at least a sample, or until a condition holds after one.

        `at` has what to do before the sample at a time [s] of this run.
        """
        actions = {round(t / self.T): action for t, action in (at or {}).items()}
        rows = []
        for k in range(max(1, round(seconds / self.T))):
            if k in actions:
                actions[k]()
            rows.append(self._sample(spoil, reach))
            if until is not None and until():
                break
        return Record(*(np.array(column) for column in zip(*rows, strict=True)))

    def _sample(self, spoil: Spoil | None, reach: Reach | None) -> tuple:
        elapsed = 1e-9 * self.plant.elapsed_ns
        truth = self.plant.truth()[-2 * self.n :].reshape(2, -1).copy()
        state = State(START + elapsed, *self.plant.measure().copy().reshape(3, -1))
        for each in [state] if spoil is None else spoil(state):
            self._arrived = np.array((each.q, each.dq, each.effort))
            self._answer = self.controller.update(each.stamp, *self._arrived)
            if self._answer is not None:
                self._applied = self._answer
        phase = self.controller.phase
        in_command = phase in RUNNING
        row = (
            elapsed,
            *truth,
            self._arrived,
            self._nothing if self._answer is None else self._answer,
            self.controller.reference.dq if in_command else np.zeros(self.n),
            self.controller.error if in_command else self._nothing,
            self.controller.bound,
            phase,
        )
        self.plant.step(self._applied if reach is None else reach(self._applied))
        return row


def run(preset: Any, given: Mapping[str, Any] | None = None, *, until, **how) -> Record:
    """Run an arm from its start for `until` [s]; `how` as of `Scenario` and its `run`."""
    plant = how.pop('plant', None)
    return Scenario(preset, given, plant=plant).run(until, **how)


def carrying(mass: float, begin: float = 0.0, ramp: float = 0.0) -> dict[str, Any]:
    """Return parameters of an arm that holds a load [kg] from a time [s] on, for ever."""
    return {
        'events.begin': [begin],
        'events.duration': [0.0],
        'events.ramp': [ramp],
        'events.payload': [mass],
    }


# What may become of states: `changed` for NaN, an offset or a sign.


def changed(
    joint: int | slice = slice(None), **values: Callable[[np.ndarray], Any]
) -> Spoil:
    """Change q, dq or effort of a joint, or of all, as `dq=lambda dq: dq + 0.1`."""

    def spoil(state):
        arrays = {}
        for name, change in values.items():
            arrays[name] = getattr(state, name).copy()
            arrays[name][joint] = change(arrays[name][joint])
        return [replace(state, **arrays)]

    return spoil


def frozen(*names: str) -> Spoil:
    """Repeat the first values for ever, of `names` or all, with velocity 0: brakes, say."""
    first = []

    def spoil(state):
        first.append(state)
        rest = replace(first[0], dq=0.0 * state.dq)
        kept = names or ('q', 'dq', 'effort')
        return [replace(state, **{name: getattr(rest, name) for name in kept})]

    return spoil


def repeated(times: int) -> Spoil:
    """Send each state so many times."""
    return lambda state: [state] * times


def every(period: float) -> Spoil:
    """Send the first state and then one every `period` [s] only."""
    last = []

    def spoil(state):
        if last and state.stamp - last[-1] < period - 1e-6:
            return []
        last.append(state.stamp)
        return [state]

    return spoil


def lost(fraction: float, seed: int = 0) -> Spoil:
    """Lose a fraction of the states at random."""
    draw = np.random.default_rng(seed)
    return lambda state: [] if draw.random() < fraction else [state]


def late(samples: int) -> Spoil:
    """Deliver each state so many samples later, with the stamp it was measured at."""
    held = []

    def spoil(state):
        held.append(state)
        return [held.pop(0)] if len(held) > samples else []

    return spoil

# SPDX-License-Identifier: Apache-2.0
"""A closed loop for fault injection, all injected faults, and the table of their outcomes.

In the loop of arm, messages, guarded law and clocks that the test sets, everything
passes through the same decoders, supervisor and torque input as in the nodes.

`python test/fault_table.py doc/faults.md` runs all faults and rewrites the table of the
page.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller import (
    ControllerConfig,
    Phase,
    PlantConfig,
    TrajectoryError,
    TrajectoryPoint,
    change,
)
from blf_dsc_controller.configuration.schema import build, flatten
from blf_dsc_controller.messages.codecs import (
    Float64MultiArrayDecoder,
    Float64MultiArrayEncoder,
    JointStateDecoder,
    JointStateEncoder,
)
from blf_dsc_controller.messages.errors import MessageError
from blf_dsc_controller.reference.trajectory import Trajectory
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.state_watchdog import PERIOD
from blf_dsc_controller.supervision.supervisor import Reason
from sim_plant.plant import plant_of
from sim_plant.torque_input import TorqueInput

JOINTS = ('joint1', 'joint2')
MILLISECOND = 1_000_000  # ns
LOCKSTEP = 1_000_000_000  # ns
TODAY = 1_700_000_000_000_000_000  # ns
PLAIN = JointStateEncoder(JOINTS)


class State(NamedTuple):
    """One measured state, before it becomes a message."""

    stamp: int
    q: np.ndarray
    dq: np.ndarray
    effort: np.ndarray

    def raw(self, encoder=PLAIN, **changes):
        """Return the state, with changes, as a message."""
        changed = self._replace(**changes)
        return encoder.encode(changed.stamp, changed.q, changed.dq, changed.effort)


class Rig:
    """A loop with steps of 1 ms, stamped in lock-step time or, if `live`, in wall time."""

    def __init__(self, given=None, *, live=False, plant=None):
        self.config = build(ControllerConfig, given or {})
        self.live = live
        self.steady = self.next_watch = 5_000_000_000
        self.wall = TODAY
        self.base = TODAY if live else LOCKSTEP
        self.guard = self.controller()
        self.plant = plant_of(build(PlantConfig, plant or {}))
        self.input = TorqueInput(len(JOINTS))
        self._encoder = Float64MultiArrayEncoder(len(JOINTS))
        self._received = Float64MultiArrayDecoder(len(JOINTS))
        self.commands = []  # all torques commanded
        self.push = np.zeros(2)
        self.sense = lambda state: [state.raw()]  # messages sent for a state
        self.actuate = lambda raw: [raw]  # commands sent for a torque

    def controller(self):
        """Start a controller process: activated, with nothing learned."""
        self._decoder = JointStateDecoder(JOINTS, required=('position',))
        guard = Guard(self.config, lambda: self.steady, lambda: self.wall)
        guard.starting.activate()
        return guard

    @property
    def supervisor(self):
        return self.guard.supervisor

    def state(self):
        """Return the current true state."""
        q, dq, effort = self.plant.measure().copy().reshape(3, 2)
        return State(self.base + self.plant.elapsed_ns, q, dq, effort)

    def deliver(self, raw):
        """Pass one message to the controller.

        Return the torque it commands, or None.
        """
        try:
            stamp = self._decoder.decode(raw)
        except MessageError as error:
            torque = self.guard.reject(error)
        else:
            torque = self.guard.update(stamp, self._decoder.values)
            self.guard.perceive()
        self._command(torque)
        return torque

    def _command(self, torque):
        if torque is None:
            return
        self.commands.append(torque.copy())
        for raw in self.actuate(self._encoder.encode(torque)):
            size = self._received.decode(raw)
            self.input.take(size, self._received.values, self.plant.sample)

    def step(self, count=1):
        """Advance by `count` milliseconds: measure, deliver, run the watchdog if due, move."""
        for _ in range(count):
            for raw in self.sense(self.state()):
                self.deliver(raw)
            self.wait()
            self.plant.step(self.input.torque + self.push)

    def wait(self, milliseconds=1):
        """Advance the clocks, and run the watchdog when it is due."""
        for _ in range(milliseconds):
            self.steady += MILLISECOND
            self.wall += MILLISECOND
            if self.steady >= self.next_watch:
                self._command(self.guard.watch())
                self.next_watch = self.steady + PERIOD * 1e9

    def clear_fault(self):
        """Remove the fault, and reset arm and controller as the nodes' services do."""
        self.sense = lambda state: [state.raw()]
        self.actuate = lambda raw: [raw]
        self.push = np.zeros(2)
        self.guard.retune(self.config)
        self.base = self.state().stamp + LOCKSTEP
        self.wall = max(self.wall, self.base) if self.live else self.wall
        self.plant.reset()
        self.input.torque[:] = 0.0
        self.guard.starting.reset()


LEAD = 40  # fault-free samples before the fault
WATCHED = 120  # samples after the fault, at least

R = Reason


@dataclass(frozen=True)
class Fault:
    """One fault: how to inject it, and the expected outcome and delay."""

    name: str
    inject: Callable[[Rig], None]
    reason: Reason = R.NONE  # then the loop continues within its bound
    within: int = 1  # samples
    given: dict[str, Any] | None = None
    live: bool = False


class Outcome(NamedTuple):
    """Outcome of a fault."""

    noticed: int  # samples until the stop; -1 without one
    reason: Reason
    text: str
    before: np.ndarray  # commanded from the fault to the stop
    after: np.ndarray  # commanded from the stop on; without one, from the fault on
    last: np.ndarray  # commanded before it
    error: float  # largest |xi1| / k_c since, while tracking
    recovered: bool


def run(fault: Fault, rig: Rig | None = None) -> Outcome:
    """Inject a fault into a running loop, observe the outcome, and recover."""
    rig = rig or Rig(fault.given, live=fault.live)
    rig.step(LEAD)
    assert rig.supervisor.phase is Phase.TRACKING, rig.supervisor.text
    start = stop = len(rig.commands)
    last, noticed = rig.commands[-1], -1
    fault.inject(rig)
    for sample in range(max(WATCHED, fault.within)):
        commanded = len(rig.commands)
        rig.step()
        if noticed < 0 and rig.supervisor.phase is Phase.SAFE_STOP:
            noticed, stop = sample + 1, commanded
    reason = rig.supervisor.reason
    text = rig.supervisor.text
    error = float(rig.guard.samples.ratio.max())
    before = np.array(rig.commands[start:stop])
    after = np.array(rig.commands[stop:])
    rig.clear_fault()
    rig.step(LEAD)
    recovered = rig.supervisor.phase is Phase.TRACKING and bool(
        rig.guard.samples.ratio.max() < 1.0
    )
    return Outcome(noticed, reason, text, before, after, last, error, recovered)


def every(change) -> Callable[[Rig], None]:
    """Apply `change` to every state from now on."""
    return lambda rig: setattr(rig, 'sense', change)


def once(change) -> Callable[[Rig], None]:
    """Apply `change` to the next state."""

    def inject(rig):
        def sense(state):
            rig.sense = lambda state: [state.raw()]
            return change(state)

        rig.sense = sense

    return inject


def spoil(name: str, joint: int, value: float) -> Callable[[Rig], None]:
    """Replace one value of one message."""

    def change(state):
        values = getattr(state, name).copy()
        values[joint] = value
        return [state.raw(**{name: values})]

    return once(change)


def shifted(nanoseconds: int) -> Callable[[Rig], None]:
    """Shift the stamp of one message."""
    return once(lambda state: [state.raw(stamp=state.stamp + nanoseconds)])


def named(*names: str, fields=('position', 'velocity', 'effort')) -> JointStateEncoder:
    """Return an encoder of other joints."""
    return JointStateEncoder(names, fields)


def arranged(names, values=lambda *both: both):
    """Send the joints by these `names`, with `values` made of those of the two joints."""

    def change(state):
        q, dq, effort = (
            np.array(values(*v)) for v in (state.q, state.dq, state.effort)
        )
        return [state.raw(named(*names), q=q, dq=dq, effort=effort)]

    return change


def unmeasured(*fields: str):
    """Leave arrays empty."""
    kept = tuple(f for f in ('position', 'velocity', 'effort') if f not in fields)
    short = {'position': 'q', 'velocity': 'dq', 'effort': 'effort'}
    empty = {short[name]: np.zeros(0) for name in fields}
    return lambda state: [state.raw(named(*JOINTS, fields=kept), **empty)]


def silence(milliseconds: int, *, queued: bool = False) -> Callable[[Rig], None]:
    """Send no state for a while; the arm moves on under the last torque."""

    def inject(rig):
        held = []

        def sense(state):
            held.append(state.raw())
            if len(held) < milliseconds:
                return []
            rig.sense = lambda state: [state.raw()]
            return held if queued else held[-1:]

        rig.sense = sense

    return inject


def stalled(rig: Rig) -> None:
    """Stall the process for 200 ms: the watchdog wakes before the queued states arrive."""
    rig.steady += 200 * MILLISECOND
    rig.guard.watch()


def sparse(period: int) -> Callable[[Rig], None]:
    """Send only one state in every `period` samples."""

    def inject(rig):
        def sense(state):
            return [state.raw()] if rig.plant.sample % period == 0 else []

        rig.sense = sense

    return inject


def same_stamp(rig: Rig) -> None:
    stamp = rig.state().stamp
    rig.sense = lambda state: [state.raw(stamp=stamp)]


def delayed(rig: Rig) -> None:
    """Send twenty late states in one burst, after a newer one."""
    old = [
        rig.state()._replace(stamp=rig.state().stamp - k * MILLISECOND)
        for k in range(20, 0, -1)
    ]
    rig.sense = lambda _: [state.raw() for state in old]


def frozen(rig: Rig) -> None:
    """Freeze the encoders while the stamps advance."""
    stuck = rig.state()
    rig.sense = lambda state: [stuck.raw(stamp=state.stamp)]


def jammed(rig: Rig) -> None:
    """Hold the arm itself still."""
    held = rig.plant.state.copy()

    def sense(state):
        rig.plant.state[1:5] = [*held[1:3].tolist(), 0.0, 0.0]
        return [state.raw(q=held[1:3], dq=np.zeros(2))]

    rig.sense = sense


def pushed(rig: Rig) -> None:
    rig.push = np.array([40.0, 0.0])


def reversed_motor(rig: Rig) -> None:
    rig.actuate = lambda raw: [
        Float64MultiArrayEncoder(2).encode(-np.frombuffer(raw[-16:], '<f8'))
    ]


def commanded(values: np.ndarray, *, always: bool) -> Callable[[Rig], None]:
    """Send these values to the plant instead of the next command, or of all."""
    replaced = Float64MultiArrayEncoder(values.size).encode(values)

    def inject(rig):
        def actuate(_):
            rig.actuate = rig.actuate if always else lambda raw: [raw]
            return [replaced]

        rig.actuate = actuate

    return inject


def poisoned(what: str, value: float) -> Callable[[Rig], None]:
    """Corrupt a number in the state of the law."""

    def inject(rig):
        getattr(rig.guard.controller.state, what)[0] = value

    return inject


def weak(rig: Rig) -> None:
    """Limit the torque to less than gravity, bypassing every check."""
    rig.guard.retune(change(rig.guard.config, {'torque.limit': (5.0, 5.0)}))


def random_gains(rig: Rig) -> None:
    """Change all gains by up to a fifth in every sample, as `ros2 param set` does."""
    rng = np.random.default_rng(0)
    start = flatten(rig.guard.config)
    names = (
        'two_link.surface_gain',
        'two_link.mu',
        'two_link.feedback_gain',
        'two_link.barrier_weight',
        'disturbance.gain',
    )

    def sense(state):
        given = {name: tuple(start[name] * rng.uniform(0.8, 1.2, 2)) for name in names}
        candidate = change(rig.guard.config, given)
        if not rig.guard.problems(candidate):
            rig.guard.retune(candidate)
        return [state.raw()]

    rig.sense = sense


def rejection(name: str, value: list[float]) -> Callable[[Rig], None]:
    """Request a change that must be rejected."""

    def inject(rig):
        problems = rig.guard.problems(change(rig.guard.config, {name: value}))
        assert problems
        assert all(problem.startswith(name) for problem in problems)

    return inject


def replaced(*, possible: bool) -> Callable[[Rig], None]:
    """Send a trajectory every 30 ms, before the last one ends.

    Too far unless `possible`.
    """

    def inject(rig):
        def sense(state):
            if rig.plant.sample % 30 == 0:
                size = 0.2 if possible else 20.0  # rad
                goal = tuple(state.q + (size if rig.plant.sample % 60 else -size))
                point = TrajectoryPoint(time=1.5, positions=goal)
                try:
                    rig.guard.motions.adopt(
                        rig.guard.motions.plan(Trajectory(JOINTS, (point,)))
                    )
                except TrajectoryError:
                    assert not possible
                else:
                    assert possible
            return [state.raw()]

        rig.sense = sense

    return inject


def wall_clock_back(rig: Rig) -> None:
    """Set the wall clock back by an hour.

    Stamps of a driver with its own clock continue.
    """
    rig.wall -= 3600 * 10**9


def restarted_controller(rig: Rig) -> None:
    """Start a new controller process while the arm is moving, far from the start."""
    rig.sense = lambda _: []
    rig.step(1)
    rig.plant.state[1] += 0.1
    rig.guard = rig.controller()
    rig.sense = lambda state: [state.raw()]


NAN, INF = np.nan, np.inf
OTHERS = named('a', 'b')
AMONG = ('gripper', 'joint2', 'rail', 'joint1')
TWICE = ('joint1', 'joint2', 'joint1')
ESTIMATED = {'safety.velocity': 'estimated'}
FAST = {'reference.amplitude': [1.0, 1.0], 'reference.offset': [1.2935, 0.6961]}
IMPATIENT = {'safety.saturation_time': 0.01}

FAULTS = (
    Fault('position of joint1 is NaN', spoil('q', 0, NAN), R.NOT_FINITE),
    Fault('position of joint2 is minus infinity', spoil('q', 1, -INF), R.NOT_FINITE),
    Fault('velocity of joint1 is NaN', spoil('dq', 0, NAN), R.NOT_FINITE),
    Fault('effort is NaN', spoil('effort', 0, NAN)),
    Fault('position of joint1 jumps by 3 mrad', spoil('q', 0, 2.296), R.OUTSIDE_BOUND),
    Fault('position of joint2 is 1e300 rad', spoil('q', 1, 1e300), R.JUMPED),
    Fault('position of joint1 wraps', spoil('q', 0, 2.293 - math.tau), R.WRAPPED),
    Fault('velocity of joint1 is 60 rad/s', spoil('dq', 0, 60.0), R.VELOCITY),
    Fault(
        'joints in another order', every(arranged(JOINTS[::-1], lambda a, b: (b, a)))
    ),
    Fault(
        'extra joints, one of them NaN',
        every(arranged(AMONG, lambda a, b: (NAN, b, 7.0, a))),
    ),
    Fault(
        'duplicate joint',
        once(arranged(TWICE, lambda a, b: (a, b, a))),
        R.JOINT_DUPLICATED,
    ),
    Fault('missing joint', once(arranged(('joint1', 'joint3'))), R.JOINT_MISSING),
    Fault('no joints', once(arranged((), lambda *_: ())), R.JOINT_MISSING),
    Fault(
        'states of another robot in between', every(lambda s: [s.raw(OTHERS), s.raw()])
    ),
    Fault(
        'only states of another robot',
        every(arranged('ab')),
        R.STATE_TIMEOUT,
        60,
        live=True,
    ),
    Fault('no positions', once(unmeasured('position')), R.FIELD_MISSING),
    Fault('no velocities', once(unmeasured('velocity')), R.NOT_FINITE),
    Fault(
        'no velocities, estimated from positions',
        every(unmeasured('velocity', 'effort')),
        given=ESTIMATED,
    ),
    Fault('no efforts', every(unmeasured('effort'))),
    Fault('truncated message', once(lambda s: [s.raw()[:-9]]), R.BAD_MESSAGE),
    Fault('empty message', once(lambda _: [b'']), R.BAD_MESSAGE),
    Fault(
        'message in another encoding',
        once(lambda s: [b'\x00\x03' + s.raw()[2:]]),
        R.BAD_MESSAGE,
    ),
    Fault(
        'garbage message',
        once(lambda _: [b'\x00\x01\x00\x00' + b'\xff' * 60]),
        R.BAD_MESSAGE,
    ),
    Fault('one state sent twice', once(lambda s: [s.raw(), s.raw()])),
    Fault('every state sent four times', every(lambda s: [s.raw()] * 4)),
    Fault('stamp stops advancing', same_stamp, R.STAMP_REPEATED, 5),
    Fault('stamp jumps back by 2 ms', shifted(-2 * MILLISECOND), R.STAMP_BACKWARD),
    Fault('stamp jumps ahead by 10 s', shifted(10**10), R.STAMP_JUMP),
    Fault('stamp is zero', once(lambda s: [s.raw(stamp=0)]), R.STAMP_MISSING),
    Fault('stamp before 1970', once(lambda s: [s.raw(stamp=-1)]), R.STAMP_MISSING),
    Fault('burst of twenty old states', delayed, R.STAMP_BACKWARD),
    Fault(
        '10 ms of silence, then all delayed states at once', silence(10, queued=True)
    ),
    Fault('30 ms of silence', silence(30), live=True),
    Fault('50 ms of silence', silence(50), R.STATE_TIMEOUT, 50, live=True),
    Fault('50 ms of silence, watchdog off', silence(50), R.STAMP_JUMP, 50),
    Fault(
        'joint states stop for good',
        every(lambda _: []),
        R.STATE_TIMEOUT,
        60,
        live=True,
    ),
    Fault('controller process stalls for 200 ms', stalled, live=True),
    Fault('only every third state arrives', sparse(3), R.OVERRUN, 1500),
    Fault('wall clock set back by an hour', wall_clock_back, live=True),
    Fault('encoders frozen', frozen, R.STAMP_REPEATED, 120, FAST),
    Fault('arm jammed', jammed, R.NO_EFFECT, 120),
    Fault('arm pushed with 40 N m', pushed, R.OUTSIDE_BOUND, 40),
    Fault('motors reversed', reversed_motor, R.OUTSIDE_BOUND, 40),
    Fault('torque limit below the gravity torque', weak, R.OUTSIDE_BOUND, 60),
    Fault(
        'torque at its limit for longer than allowed', weak, R.SATURATED, 12, IMPATIENT
    ),
    Fault('an estimate is NaN', poisoned('estimate', NAN), R.ESTIMATE),
    Fault('the disturbance estimate is NaN', poisoned('disturbance', NAN), R.ESTIMATE),
    Fault('the surface filter is NaN', poisoned('alpha2', NAN), R.TORQUE),
    Fault('an estimate is twice what it was', poisoned('estimate', 1.0)),
    Fault('all gains changed in every sample', random_gains),
    Fault('trajectory replaced repeatedly in motion', replaced(possible=True)),
    Fault('requested trajectory past the limits', replaced(possible=False)),
    Fault('requested bound below the error', rejection('barrier.bound', [1e-9, 1e-9])),
    Fault(
        'requested torque limit below the torque', rejection('torque.limit', [1.0, 1.0])
    ),
    Fault('one command of the wrong length', commanded(np.zeros(3), always=False)),
    Fault('one command that is NaN', commanded(np.array([NAN, 1.0]), always=False)),
    Fault(
        'all commands are NaN',
        commanded(np.array([NAN, NAN]), always=True),
        R.OUTSIDE_BOUND,
        80,
    ),
    Fault(
        'plant killed and restarted', lambda rig: rig.plant.reset(), R.STAMP_BACKWARD
    ),
    Fault('controller killed and restarted outside the bound', restarted_controller),
)


@cache
def outcome_of(number: int) -> Outcome:
    """Return the outcome of a fault of the table."""
    return run(FAULTS[number])


RULE = '| --- | --- |\n'


def measured() -> str:
    """Return a row of faults for each reason of a stop, and the list of the other faults."""
    stops: dict[str, list[str]] = {}
    tolerated = []
    for number, fault in enumerate(FAULTS):
        outcome = outcome_of(number)
        if outcome.noticed < 0:
            tolerated.append(f'- {fault.name}\n')
        else:
            found = stops.setdefault(outcome.reason, [])
            found.append(f'{fault.name} ({outcome.noticed})')
    rows = (f'| {reason} | {"; ".join(found)} |\n' for reason, found in stops.items())
    return ''.join([*rows, '\nTolerated:\n\n', *tolerated])


def page(text: str) -> str:
    """Return the text of the page with the outcomes as measured."""
    head, _, rest = text.partition(RULE)
    return head + RULE + measured() + rest[rest.index('\n## ') :]


if __name__ == '__main__':
    path = Path(sys.argv[1])
    path.write_text(page(path.read_text(encoding='utf-8')), encoding='utf-8')

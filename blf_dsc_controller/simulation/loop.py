# SPDX-License-Identifier: Apache-2.0
"""The closed loop without ROS: the node's guard and the simulated arm, in turn; its bag.

A lock-step run over ROS and an offline run of the same configuration agree bit for bit,
stops and safe torques included.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path

import numpy as np

from blf_dsc_controller.bags.writer import BagWriter, TopicRecorder
from blf_dsc_controller.compiled.announcement import logged_compilation
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.law_file import errors_told_with_line
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.configuration.tool_bound import tool_of
from blf_dsc_controller.control.telemetry import ControllerTelemetry
from blf_dsc_controller.errors import BlfDscError, StartError, check_type
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.factory.estimate import estimate_names, learned_arm
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.law.state import Sample, sample_of
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import (
    Change,
    Event,
    EventType,
    Journal,
    found_in,
    stops_in,
)
from blf_dsc_controller.messages.named_values import (
    disturbance_names,
    external_names,
    monitored,
)
from blf_dsc_controller.messages.plant_telemetry import PlantTelemetry
from blf_dsc_controller.messages.topics import Message
from blf_dsc_controller.run import (
    FIRST_STAMP,
    Contact,
    Floats,
    Oscillation,
    Run,
    Series,
)
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.warnings.table import refuse
from sim_plant.plant import plant_of
from sim_plant.sampled_plant import Plant
from sim_plant.settings import parameter_names_of, steps_of

_CHUNK = 1000  # samples that are kept in memory while a bag is written


@logged_compilation()
def simulate(
    controller_config: ControllerConfig,
    plant_config: PlantConfig,
    *,
    supervised: bool = True,
    after_stop: float = math.inf,
) -> Record:
    """Run controller and plant in closed loop for `duration` and return every sample.

    The plant's duration must not be 0.  If not `supervised`, the law runs alone, past
    its limits too.  A run whose law has been stopped for `after_stop` [s] may end early.

    Raises StartError if no arm is stable with the gains, or if the law cannot take over or stops
    before its first torque, MotionError if there is no approach within the limits,
    ArgumentTypeError if the configurations are others, and BlfDscError if they are of other joints.
    """
    remedy = 'simulate(loop.controller, loop.plant) runs what load_loop returns'
    check_type('controller_config', controller_config, ControllerConfig, remedy)
    check_type('plant_config', plant_config, PlantConfig, remedy)
    if controller_config.joints != plant_config.joints:
        raise BlfDscError(
            f'the joints of the controller are {", ".join(controller_config.joints)}, those of the '
            f'plant {", ".join(plant_config.joints)}: {remedy}'
        )
    plant = plant_of(plant_config)
    if supervised:
        guard = Guard(controller_config, lambda: 0, lambda: 0)
        refuse(controller_config)
        guard.starting.activate()
        record = new_record(
            guard.controller, controller_config, plant_config, guard.journal
        )
        size = 0
        for part in _run_supervised(guard, plant, record.rows, record.stamps.size):
            size += part.stamps.size
            if 1e-9 * record.stamps[size - 1] >= record.stopped + after_stop:
                break
        return record.rows(range(size))
    journal = Journal()
    record = new_record(
        controller_of(controller_config), controller_config, plant_config, journal
    )
    run_alone(record, plant)
    journal.note(EventType.CONFIGURE, parameters=flatten(controller_config))
    journal.note(EventType.ACTIVATE)
    journal.stamp, journal.messages = FIRST_STAMP, 1
    journal.note(EventType.START, resumed=False)
    return record


def run_alone(record: Record, plant: Plant, *, perceives: bool = True) -> None:
    """Fill a record, by its law alone from the beginning.

    If it `perceives`, also find what no torque depends on: load and external torque.

    Raises StartError if the law cannot take over, MotionError if there is no approach
    within the limits, and BlfDscError if a law of a file fails.
    """
    controller = record.controller
    perceives = perceives or controller.settings.contact.freezes == 1
    q, dq, _ = plant.measure().reshape(3, -1)
    begin(controller, record.config, q, dq)
    dt = plant.period_ns * 1e-9

    def answer(row: int, measurement: Floats) -> Floats:
        torque = controller.update(int(record.stamps[row]) * 1e-9, dt, measurement)
        if perceives:
            controller.perceive(dt)
        record.samples[row] = controller.sample_vector
        return torque

    with errors_told_with_line(record.config.law):
        _fill(record, plant, answer)


def _fill(
    record: Record, plant: Plant, answer: Callable[[int, Floats], Floats | None]
) -> None:
    """Fill the rows of a record; `answer` gives a torque (n,) [N m] for each row's measurement.

    Without one the run ends.
    """
    for row in range(record.stamps.size):
        measurement = plant.measure()
        record.measurements[row] = measurement
        record.truths[row] = plant.truth()
        if record.motors.size:
            record.motors[row] = plant.motor_reading
        torque = answer(row, measurement)
        if torque is None:
            return
        plant.step(torque)


def _run_supervised(
    guard: Guard, plant: Plant, rows_of: Callable[[range], Record], size: int
) -> Iterator[Record]:
    """Run `size` samples in chunks; fill and yield the rows of each, which come from `rows_of`."""
    for first in (0, *range(1, size, _CHUNK)):
        chunk = range(first, min(first + _CHUNK, size) if first else 1)
        record = rows_of(chunk)
        with errors_told_with_line(guard.config.law):
            _fill(record, plant, partial(_answer, guard, record))
        if guard.starting.error is not None:
            raise guard.starting.error
        if guard.supervisor.stops and not guard.commanding:  # nothing would ever move
            raise StartError(guard.supervisor.text)
        if chunk.stop == size and (torque := guard.release()) is not None:
            record.left[:] = torque  # as a node leaves an arm
        yield record


def _answer(
    guard: Guard, record: Record, row: int, measurement: Floats
) -> Floats | None:
    """Answer a measurement as the nodes do, and keep the sample in a row."""
    torque = guard.update(FIRST_STAMP + int(record.stamps[row]), measurement)
    guard.perceive()
    if torque is None:
        return None
    record.samples[row] = guard.controller.sample_vector
    if not guard.has_sample:
        bound = np.array(record.sample(row).bound)
        record.samples[row] = np.nan
        record.sample(row).bound[:] = bound
        record.sample(row).torque[:] = torque
    return torque


@dataclass(frozen=True)
class Record:
    """All samples of a run, one row each."""

    stamps: np.ndarray  # (k,) ns, since the start
    measurements: np.ndarray  # (k, 3 n) [q, dq, applied torque of the last interval]
    # (k, s) rows of `law.state.Sample`; after a stop NaN except bound, torque
    samples: np.ndarray
    truths: np.ndarray  # (k, p + 3 n) [P, tau_dist, q, dq]
    # (k, 2, n) rad, rad/s, by encoders of their own; empty: there are none
    motors: np.ndarray
    left: np.ndarray  # (n,) N m, commanded after the last sample; NaN: nothing was
    parameters: tuple[str, ...]  # names of the entries of P
    config: ControllerConfig
    controller: Controller  # after the run
    journal: Journal  # events of the run, their stamps from `FIRST_STAMP` on

    @property
    def stopped(self) -> float:
        """When the law was stopped first [s], since the start; infinity: not yet."""
        stop = next(stops_in(self._events(), 0), None)
        return math.inf if stop is None else 1e-9 * stop.stamp

    def rows(self, chosen: range) -> Record:
        """Return some rows, as views."""
        rows = slice(chosen.start, chosen.stop)
        return replace(
            self,
            stamps=self.stamps[rows],
            measurements=self.measurements[rows],
            samples=self.samples[rows],
            truths=self.truths[rows],
            motors=self.motors[rows],
        )

    def sample(self, row: int) -> Sample:
        """Return one row of `samples` with named fields."""
        return sample_of(self.samples[row], self.controller.settings)

    def true_errors(self) -> np.ndarray:
        """Return the errors (k, n) [rad] of the true positions, not of the measured ones."""
        n = len(self.config.joints)
        p = len(self.parameters)
        qr = sample_columns(self.samples, self.controller.settings).qr
        return np.asarray(self.truths[:, p + n : p + 2 * n] - qr)

    def run(self) -> Run:
        """Return all samples as a `Run`, with the truth and the terms of (29) that the law has.

        Rows of states that the law did not use are NaN except for bound and torque.
        """
        config, events = self.config, self._events()
        samples = sample_columns(self.samples, self.controller.settings)
        used = ~np.isnan(samples.qr[:, 0])
        stamps = self.stamps[used]
        position, velocity, effort = np.split(self.measurements, 3, axis=1)
        tool = tool_of(config)
        external, contacts = None, None
        if config.contact.enabled:
            torques = samples.external[used], samples.external_interval[used]
            names = external_names(config.joints)
            external = Series(names, stamps, np.hstack(torques))
            contacts = found_in(events, EventType.CONTACT, Contact)
        parts = monitored(config, estimate_names(config))
        monitor = np.hstack([getattr(samples, part)[used] for part in parts])
        true = (*self.parameters, *disturbance_names(config.joints))
        return Run(
            joints=config.joints,
            stamp=self.stamps,
            received=self.stamps,
            position=position,
            velocity=velocity,
            torque=samples.torque,
            reference=samples.qr,
            error=samples.xi1,
            bound=samples.bound,
            torque_limit=np.broadcast_to(config.torque.limit, position.shape),
            monitor=Series(tuple(chain.from_iterable(parts.values())), stamps, monitor),
            external=external,
            arm=learned_arm(config),
            tool=tool.errors if tool else None,
            learns=config.traits.learns and config.learning.enabled,
            effort=effort,
            sliding=config.robot.sliding(config.joints),
            xi2=samples.xi2,
            parameters=flatten(config),
            truth=Series(true, self.stamps, self.truths[:, : len(true)]),
            contacts=contacts,
            oscillations=found_in(events, EventType.OSCILLATION, Oscillation),
            stops=tuple(stops_in(events, 0)),
        )

    def _events(self) -> list[Event]:
        """Return the events, with their stamps since the start [ns]."""
        pending = self.journal.pending
        return [each._replace(stamp=each.stamp - FIRST_STAMP) for each in pending]


def new_record(
    controller: Controller,
    config: ControllerConfig,
    plant: PlantConfig,
    journal: Journal,
    rows: range | None = None,
) -> Record:
    """Return a record for a run of a plant, or some of its rows, to be filled."""
    chosen = rows or range(steps_of(plant) + 1)
    size = len(chosen)
    n = len(plant.joints)
    names = parameter_names_of(plant)
    return Record(
        stamps=np.arange(chosen.start, chosen.stop) * plant.sample_time_ns,
        measurements=np.zeros((size, 3 * n)),
        samples=np.zeros((size, controller.sample_vector.size)),
        truths=np.zeros((size, len(names) + 3 * n)),
        motors=np.full((size * (plant.sensor.side == 'both'), 2, n), np.nan),
        left=np.full(n, np.nan),
        parameters=names,
        config=config,
        controller=controller,
        journal=journal,
    )


def write_bag(
    path: Path,
    record: Record | Iterable[Record],
    plant: PlantConfig | None = None,
    *,
    compression: str = 'none',
) -> None:
    """Write the messages that the nodes would have published in a run as a bag.

    Its record may come in parts.  The bag has the configuration of the controller and, if
    given, of the plant; `compression` is `none` or `zstd`. Raises BagError if `path` exists.
    """
    bag = BagWriter(path, compression=compression, flush_interval=None)
    with closing(TopicRecorder(bag)) as recorder:
        if plant is not None:
            configured = Change(FIRST_STAMP, flatten(plant), configured=True).encode()
            recorder.write(FIRST_STAMP, topics.CHANGES, configured)
        parts = [record] if isinstance(record, Record) else record
        for stamp, message in _messages(parts):
            recorder.write(stamp, *message)


def simulate_into_bag(
    path: Path,
    controller: ControllerConfig,
    plant: PlantConfig,
    *,
    compression: str = 'none',
) -> None:
    """Run as `simulate` does and write the bag of `write_bag`, in the memory of a short run.

    Arguments and errors are those of both.
    """
    guard = Guard(controller, lambda: 0, lambda: 0)
    guard.starting.activate()

    def rows_of(rows: range) -> Record:
        return new_record(guard.controller, controller, plant, guard.journal, rows)

    size = steps_of(plant) + 1
    parts = _run_supervised(guard, plant_of(plant), rows_of, size)
    first = next(parts)  # before there is a bag: it may not start
    write_bag(path, chain([first], parts), plant, compression=compression)


def _messages(parts: Iterable[Record]) -> Iterator[tuple[int, Message]]:
    """Yield the messages of a run, whose record comes in parts, with their times [ns]."""
    row = noted = 0
    ratio = np.zeros(0)
    for record in parts:
        if not row:
            config = record.config
            plant = PlantTelemetry(config.joints, record.parameters)
            controller = ControllerTelemetry(config, estimate_names(config))
            limit = np.array(config.torque.limit)
            ratio = np.zeros(len(config.joints))
        events = deque(islice(record.journal.pending, noted, None))
        for k, elapsed in enumerate(record.stamps.tolist()):
            stamp = FIRST_STAMP + elapsed
            sample = record.sample(k)
            while events and events[0].messages <= row:
                yield stamp, (topics.JOURNAL, events.popleft().encode())
                noted += 1
            motors = record.motors[k] if record.motors.size else None
            for message in plant.states(
                row,
                stamp,
                record.measurements[k],
                motors,
                partial(record.truths.__getitem__, k),
            ):
                yield stamp, message
            yield stamp, controller.command(sample.torque)
            row += 1
            if np.isnan(sample.qr[0]):  # stopped
                yield stamp, controller.answer(stamp, sample.torque)
                continue
            np.maximum(ratio, np.abs(sample.xi1) / sample.bound, out=ratio)
            for message in controller.sample(stamp, sample, limit, ratio, float('nan')):
                yield stamp, message
    if np.isfinite(record.left).all():
        yield stamp, controller.command(record.left)
    for event in islice(record.journal.pending, noted, None):
        yield stamp, (topics.JOURNAL, event.encode())

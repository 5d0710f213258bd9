# SPDX-License-Identifier: Apache-2.0
"""What joint torque sensors are worth at the gains that elastic joints bear.

    python -m benchmark load-observer margins
    python -m benchmark load-observer loops
    python -m benchmark load-observer pairs [--runs 20]
    python -m benchmark load-observer declarations
    python -m benchmark load-observer sensors

`margins`: of the linear loop with gears, drives with a torque loop, and the load observer at a
bandwidth, the worst over postures along the reference, gears of the preset's stiffness and
thrice that, motors of 1 and 1.3 times the published, and links of 0.8 to 1.2 times the model,
without a load and with the rated one before it is learned.  First the modulus margin above
5 Hz.  Then the least distance from the ray [1, infinity) of the eigenvalues of
-(I + G C)^-1 G C_r, from 0.3 Hz up, C_r being the observer: while it is not 0, no gain of the
observer from 0 to 1, and a threshold is such a gain, makes a stable loop unstable.

`loops`: each arm moves as its preset does and picks up 2 kg at 8 s.  A row has the largest
error [mrad] from 4 s to then, at the pick-up, and from 3.5 s after it on, and how long after
it the 95 % interval of the weight is within 0.1 kg of 2 kg.  Rivals have the same feedback:
PD or PID on the model of the URDF along the reference, without learning, each alone and with
the same observer by torque sensors.

`pairs`: random arms of the study `monte_carlo_elastic_*`, each with and without observer.
Besides, the sensors of every other arm err, and friction changes or something pushes.  A row has
the ratios of both runs: rms and largest error, in motion (4 to 8 s) and afterwards.

`declarations`: of `margins`, arms that are as declared; whose encoders are at the motors; and
whose efforts are commands, with and without a torque loop.  A cell has in how many of the
cases (postures, gears, links) the linear loop with an observer at a bandwidth is unstable.

`sensors`: the arms of `loops` with sensors that fail at 3 s.  A row has the largest error
[mrad] afterwards, and what is said, after how long.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from benchmark.elastic import FREE
from benchmark.harness import print_table
from benchmark.options import add_runs
from benchmark.studies import load_study
from blf_dsc_controller.arms.linear_loop import (
    Joints,
    Timing,
    TorqueLoop,
    arm_response,
    law_response,
)
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    LoopConfig,
    load_loop,
)
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.controller import begin, controller_of
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.run import FIRST_STAMP
from blf_dsc_controller.simulation.loop import Record, simulate
from blf_dsc_controller.studies.monte_carlo import draw, plant_with
from blf_dsc_controller.supervision.expected_errors import linear_feedback
from blf_dsc_controller.supervision.guard import Guard
from sim_plant.plant import plant_of

PRESETS = ('panda', 'fr3_direct', 'fr3')
PICK_UP = 8.0  # s
LATER = 3.5  # s
SECONDS = 16.0
WEIGHT = 2.0  # kg
BANDWIDTH = 150.0  # rad/s

BANDWIDTHS = (0.0, 60.0, 100.0, 150.0, 200.0)
STIFFNESS = (1.0, 3.0)  # of the gears, over that of the preset
MOTORS = np.array(
    (0.606, 0.606, 0.462, 0.462, 0.206, 0.206, 0.206)
)  # kg m^2, published
SPREAD = (1.0, 1.3)
LINKS = (0.8, 1.0, 1.2)  # true over assumed
POSTURES = 4
PERIOD = 5.0  # s, of the reference
VISCOUS = np.array((0.3,) * 4 + (0.04,) * 3)  # N m s/rad
RIGID = 5.0  # Hz, up to which an arm is rigid
FREQUENCIES = np.geomspace(0.3, 480.0, 120)  # Hz


class LinearLoop(NamedTuple):
    """The loop of a preset at small errors, and its links in some postures."""

    loop: LoopConfig
    assumed: np.ndarray  # links of the model, without rotors (k, n, n) kg m^2
    loaded: np.ndarray  # with the rated payload


def linear(preset: str) -> LinearLoop:
    """Return the linear loop of a preset."""
    loop = load_loop(preset)
    config = loop.controller
    chain = config.robot.chain(config.joints)
    base = parameters_of(config.robot, chain)
    q = sampled(reference_of(config), np.linspace(0.0, PERIOD, POSTURES))[:, 0]
    none = np.zeros(len(config.joints))
    links = inertia_matrices(base.model, base.of(chain.inertias, none), q)
    held = replace(
        config.robot, drive_compensates='gravity', drive_payload=config.robot.payload
    ).drive_inertias(chain, chain.inertias)
    return LinearLoop(loop, links, inertia_matrices(base.model, base.of(held, none), q))


def observer(
    bandwidth: float, timing: Timing, M: np.ndarray, model: np.ndarray, s: np.ndarray
) -> np.ndarray:
    """Return C_r (k, f, n, n) [N m/rad] of the observer, tau = - C_r q, at s = i omega (f,)."""
    T = timing.period
    z = np.exp(T * s)
    pole = 1.0 - np.exp(-bandwidth * T)
    old = np.exp(-T / timing.velocity_lag)
    passed = pole / (1.0 - (1.0 - pole) / z)
    late = (1.0 - old) / (1.0 - old / z)
    difference = (1.0 - 1.0 / z) / T  # the mean of a derivative over an interval
    sensed = (late * difference * s)[:, None, None] * M[:, None]
    expected = (late * difference**2)[:, None, None] * model[:, None]
    return np.asarray(-passed[:, None, None] * (sensed - expected))


def from_ray(eigenvalues: np.ndarray) -> float:
    """Return the least distance of eigenvalues from the ray [1, infinity)."""
    beside = np.abs(eigenvalues.imag)
    return float(
        np.where(eigenvalues.real >= 1.0, beside, np.abs(eigenvalues - 1.0)).min()
    )


def margin(preset: LinearLoop, links: np.ndarray, bandwidth: float) -> str:
    """Return the modulus margin, and how far the observer is from making the loop unstable."""
    gears = np.array(preset.loop.plant.joint.stiffness)
    config = preset.loop.controller
    settings = settings_of_config(config)
    lag = 0.5 * config.robot.lag
    timing = Timing(config.sample_time, drive_lag=lag, velocity_lag=lag)
    feedback = linear_feedback(settings, preset.assumed, settings.barrier.weight)
    s = np.asarray(2j * np.pi * FREQUENCIES, complex)
    C = law_response(feedback, timing, s)
    one = np.eye(len(MOTORS))
    modulus = distance = np.inf
    for share, factor, K in itertools.product(LINKS, SPREAD, STIFFNESS):
        M = share * links
        joints = Joints(factor * MOTORS, VISCOUS, K * gears, 0.03, TorqueLoop())
        G = arm_response(M, joints, timing, s)
        seen = 0.0 * C
        if bandwidth > 0.0:
            seen = observer(bandwidth, timing, M, preset.assumed, s)
            around = -np.linalg.solve(one + G @ C, G @ seen)
            distance = min(distance, from_ray(np.linalg.eigvals(around)))
        whole = (one + G @ (C + seen))[:, FREQUENCIES > RIGID]
        values = np.linalg.svd(whole, compute_uv=False)[..., -1]
        modulus = min(modulus, float(values.min()))
    return f'{modulus:.2f}' + (f', {distance:.2f}' if bandwidth > 0.0 else '')


def margins() -> Iterator[list[str]]:
    """Compute the rows of the linear margins."""
    for name in PRESETS:
        preset = linear(name)
        for label, links in (('empty', preset.assumed), ('loaded', preset.loaded)):
            cells = (margin(preset, links, L) for L in BANDWIDTHS)
            yield [name, label, *cells]


class Law(NamedTuple):
    """A law of the table: what differs from the preset, and what it learns."""

    label: str
    changes: Mapping[str, object]
    is_learning: bool = True
    has_integral: bool = True


OBSERVED = {'disturbance.observer_bandwidth': BANDWIDTH}
LAWS = (
    Law('this law', {'disturbance.observer_bandwidth': 0.0}),
    Law(f'this law, load observer at {BANDWIDTH:g} rad/s', OBSERVED),
    Law(
        'PD and model',
        {'disturbance.observer_bandwidth': 0.0},
        is_learning=False,
        has_integral=False,
    ),
    Law('PID and model', {'disturbance.observer_bandwidth': 0.0}, is_learning=False),
    Law(
        'PD, model and observer by sensors',
        OBSERVED,
        is_learning=False,
        has_integral=False,
    ),
    Law('PID, model and observer by sensors', OBSERVED, is_learning=False),
)


def loop_of(
    preset: str,
    law: Law,
    changes: Mapping[str, object] | None = None,
    gains: Mapping[str, object] | None = None,
) -> LoopConfig:
    """Return the loop of an arm with a law; `changes` of the arm and `gains` are optional."""
    loop = load_loop(preset)
    n = len(loop.controller.joints)
    plant = {
        'duration': SECONDS,
        'events.begin': [PICK_UP],
        'events.duration': [0.0],
        'events.payload': [WEIGHT],
        **(changes or {}),
    }
    controller = {'barrier.bound': [FREE] * n, **(gains or {}), **law.changes}
    if not law.has_integral:
        controller['disturbance.gain'] = [0.0] * n
    loop = load_loop(preset, {PLANT: plant, CONTROLLER: controller})
    if law.is_learning:
        return loop
    return loop._replace(controller=without_learning(loop.controller))


def without_learning(controller: ControllerConfig) -> ControllerConfig:
    """Return a controller that keeps its estimate at first: a PID over the model of the URDF."""
    count = len(controller.learning.initial_estimate)
    still = {'learning.weight': 0.0, 'learning.adaptation_gain': [0.0] * count}
    return change(controller, still)


def known_after(record: Record) -> float:
    """Return how long after the pick-up the weight is known to 0.1 kg; NaN: never."""
    sample = sample_columns(record.samples, record.controller.settings)
    t = 1e-9 * record.stamps
    known = sample.load[:, 4] < 0.1  # half of the interval
    known &= np.abs(sample.load[:, 0] - WEIGHT) < 0.1
    known &= t > PICK_UP
    return float(t[known][0] - PICK_UP) if known.any() else float('nan')


def largest(time: np.ndarray, error: np.ndarray) -> list[float]:
    """Return the largest of errors (k, n) [rad] in motion, at the pick-up, and later [mrad]."""
    of_samples = 1e3 * np.abs(error).max(axis=1)
    after = PICK_UP + LATER
    spans = (4.0, PICK_UP), (PICK_UP, after), (after, SECONDS)
    return [float(of_samples[(time >= a) & (time < b)].max()) for a, b in spans]


def loop_row(preset: str, law: Law) -> list[str]:
    """Return what happens to an arm with a law."""
    loop = loop_of(preset, law)
    record = simulate(loop.controller, loop.plant)
    run = record.run()
    if run.stops:
        stop = run.stops[0]
        return [preset, law.label, f'{1e-9 * stop.stamp:.2f} s: {stop.reason}']
    cells = [f'{each:.2f}' for each in largest(run.time, np.asarray(run.error))]
    known = known_after(record)
    cells.append(f'{known:.2f} s' if law.is_learning else '-')
    return [preset, law.label, *cells]


def loops() -> Iterator[list[str]]:
    """Compute the rows of the closed loops."""
    for preset, law in itertools.product(PRESETS, LAWS):
        yield loop_row(preset, law)


STUDIES = 'monte_carlo_elastic_panda', 'monte_carlo_elastic_fr3'
OFFSET = 1.0  # N m, largest offset of sensors in large joints; in wrists a fifth
SCALE = 0.03  # largest error of their scale
NOISE = 0.05  # N m, rms in large joints
LARGE = (True,) * 4 + (False,) * 3
SPANS = {'in motion': (4.0, PICK_UP), 'from the load on': (PICK_UP, SECONDS)}


class Pair(NamedTuple):
    """A random arm: rms and largest error (spans, 2) [mrad] without and with observer."""

    number: int
    events: str
    without: np.ndarray
    observed: np.ndarray


def events_of(
    rng: np.random.Generator, viscous: np.ndarray, coulomb: np.ndarray
) -> tuple[str, dict[str, Any]]:
    """Return what happens besides 2 kg from 8 s on: nothing, other friction, or a push."""
    kind = ('nothing', 'friction', 'push')[int(rng.integers(3))]
    if kind == 'nothing':
        return kind, {}
    n = len(viscous)
    events: dict[str, Any] = {
        'events.begin': [float(rng.uniform(5.0, 7.0)), PICK_UP],
        'events.duration': [0.0 if kind == 'friction' else 0.5, 0.0],
        'events.payload': [0.0, WEIGHT],
    }
    if kind == 'push':
        push = rng.uniform(-15.0, 15.0, 3).tolist()
        return kind, events | {'events.force': [*push, 0.0, 0.0, 0.0]}
    change_by = float(rng.uniform(-0.7, 1.0))
    for name, value in (('viscous', viscous), ('coulomb', coulomb)):
        events[f'events.{name}'] = [*(change_by * value).tolist(), *([0.0] * n)]
    return f'{kind} {1.0 + change_by:.2f}', events


def sensor_errors_of(rng: np.random.Generator) -> dict[str, Any]:
    """Return what joint torque sensors see wrongly; the loop of the drives sees it as well."""
    size = np.where(LARGE, 1.0, 0.2)
    return {
        'sensor.torque_offset': (
            OFFSET * size * rng.uniform(-1.0, 1.0, size.shape)
        ).tolist(),
        'sensor.torque_factor': (
            1.0 + SCALE * rng.uniform(-1.0, 1.0, size.shape)
        ).tolist(),
        'sensor.torque_noise': (NOISE * size).tolist(),
    }


def errors_of(config: ControllerConfig, plant: PlantConfig) -> np.ndarray:
    """Return rms and largest true error (spans, 2) [mrad] of a law."""
    controller, arm = controller_of(config), plant_of(plant)
    n = len(config.joints)
    dt = config.sample_time
    measurement = np.array(arm.measure())
    begin(controller, config, *measurement.reshape(3, n)[:2])
    errors = np.zeros((round(SECONDS / dt), n))
    for k, error in enumerate(errors):
        measurement[:] = arm.measure()
        torque = controller.update(k * dt, dt, measurement)
        error[:] = controller.sample.xi1
        controller.perceive(dt)
        arm.step(torque)
        if np.abs(error).max() > FREE:
            errors[k:] = np.inf
            break
    t = dt * np.arange(len(errors))
    spans = [1e3 * errors[(t >= a) & (t < b)] for a, b in SPANS.values()]
    return np.array([[np.sqrt((e**2).mean()), np.abs(e).max()] for e in spans])


def pair(study_name: str, number: int) -> Pair:
    """Run a random arm with and without observer."""
    study = load_study(study_name)
    plant = plant_with(study, draw(study, number))
    rng = np.random.default_rng(number)
    friction = (
        np.array(each)
        for each in (plant.disturbance.viscous, plant.disturbance.coulomb)
    )
    label, events = events_of(rng, *friction)
    plant = change(plant, {'duration': SECONDS, **events})
    if number % 2:
        label = f'{label}, sensors err'
        plant = change(plant, sensor_errors_of(rng))
    n = len(study.controller.joints)
    both = [
        errors_of(_with_bandwidth(study.controller, L, n), plant)
        for L in (0.0, BANDWIDTH)
    ]
    return Pair(number, label, *both)


def _with_bandwidth(
    config: ControllerConfig, bandwidth: float, n: int
) -> ControllerConfig:
    changes = {
        'disturbance.observer_bandwidth': bandwidth,
        'barrier.bound': [FREE] * n,
        'barrier.initial_bound': [0.0] * n,
    }
    return change(config, changes)


def pairs(runs: int) -> Iterator[list[str]]:
    """Compute the rows of random arms, and the worst and the median ratio of each study."""
    for study in STUDIES:
        found = []
        for number in range(runs):
            of = pair(study, number)
            found.append(of.observed / of.without)
            cells = [
                f'{a:.3g} {b:.3g}'
                for a, b in zip(of.without.ravel(), of.observed.ravel(), strict=True)
            ]
            yield [study, f'{number}', of.events, *cells]
        for name, reduced in (('median', np.median), ('worst', np.max)):
            ratios = reduced(found, axis=0).ravel()
            yield [study, name, 'ratios', *(f'{each:.2f}' for each in ratios)]


DECLARATIONS = {
    'as declared': (False, {'torque_loop': TorqueLoop()}),
    'encoders at the motors': (
        False,
        {'torque_loop': TorqueLoop(), 'motor_side': True},
    ),
    'efforts are commands, torque loop': (True, {'torque_loop': TorqueLoop()}),
    'efforts are commands, no torque loop': (True, {}),
}
SLOW_TO_FAST = (2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 150.0)  # rad/s
FINE = np.concatenate((np.geomspace(0.02, 5.0, 150), np.geomspace(5.05, 499.0, 1200)))


def destabilises(
    preset: LinearLoop, M: np.ndarray, joints: Joints, bandwidth: float, *, echo: bool
) -> np.ndarray:
    """Return whether the observer makes the loop unstable in each posture (k,).

    The loop is stable without it, so that det(I - T) has to encircle 0 for that, T being
    that from r to r.  Efforts are commands, an `echo`, or the torques at the links.
    """
    T = response_of_observer(preset, M, joints, bandwidth, echo=echo)
    one = np.eye(len(joints.motors))
    phase = np.unwrap(np.angle(np.linalg.det(one - T)), axis=1)
    return np.asarray(np.abs(phase[:, -1] - phase[:, 0]) > 0.8 * np.pi)


def response_of_observer(
    preset: LinearLoop, M: np.ndarray, joints: Joints, bandwidth: float, *, echo: bool
) -> np.ndarray:
    """Return the response (k, frequencies, n, n) from the torque r of the observer to r.

    It is the filtered difference of what sensors show and what the model expects.
    """
    config = preset.loop.controller
    settings = settings_of_config(config)
    dt, lag = config.sample_time, 0.5 * config.robot.lag
    timing = Timing(dt, drive_lag=lag, velocity_lag=lag)
    s = np.asarray(2j * np.pi * FINE, complex)
    z = np.exp(dt * s)
    passed = pole_response(np.exp(-bandwidth * dt), z) * pole_response(
        np.exp(-dt / lag), z
    )
    difference = (1.0 - 1.0 / z) / dt
    feedback = linear_feedback(settings, preset.assumed, settings.barrier.weight)
    G, C = arm_response(M, joints, timing, s), law_response(feedback, timing, s)
    one = np.eye(len(joints.motors))
    expected = (passed * difference**2)[:, None, None] * preset.assumed[:, None] @ G
    if echo:
        held = np.exp(-timing.delay * dt * s) / (1.0 + lag * s) * difference / s
        sensed = (passed * held)[:, None, None] * one
    else:
        of_links = arm_response(M, joints._replace(motor_side=False), timing, s)
        sensed = (passed * difference * s)[:, None, None] * M[:, None] @ of_links
    return np.asarray(np.linalg.inv(one + C @ G) @ (sensed - expected))


def pole_response(decay: float, z: np.ndarray) -> np.ndarray:
    """Return the response of a first-order filter that keeps `decay` of its value in a sample."""
    return np.asarray((1.0 - decay) / (1.0 - decay / z))


def declarations() -> Iterator[list[str]]:
    """Compute the rows of arms that are not what is declared."""
    for name, (label, (echo, changes)) in itertools.product(
        PRESETS[:2], DECLARATIONS.items()
    ):
        preset = linear(name)
        gears = np.array(preset.loop.plant.joint.stiffness)
        cells = []
        for bandwidth in SLOW_TO_FAST:
            found = [
                destabilises(
                    preset,
                    share * preset.assumed,
                    Joints(MOTORS, VISCOUS, K * gears, 0.03, **changes),
                    bandwidth,
                    echo=echo,
                )
                for share, K in itertools.product(LINKS, STIFFNESS)
            ]
            cells.append(f'{np.sum(found)} of {np.size(found)}')
        yield [name, label, *cells]


FAILS = 3.0  # s
AFTER_FAILURE = 3.0  # s


class Failure(NamedTuple):
    """What is read instead of the torque: gain and offset [N m] of one or all joints."""

    gain: float
    offset: float = 0.0
    joints: slice = slice(None)
    is_stuck: bool = False

    def read(self, torque: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return what is read (n,) instead of a torque; `before` is the last that was right."""
        wrong = np.array(torque)
        source = before if self.is_stuck else torque
        wrong[self.joints] = self.gain * source[self.joints] + self.offset
        return wrong


SECOND = slice(1, 2)
FAILURES = {
    'nothing': Failure(1.0),
    'joint 2 stuck': Failure(1.0, joints=SECOND, is_stuck=True),
    'joint 2 zero': Failure(0.0, joints=SECOND),
    'joint 2 of the wrong sign': Failure(-1.0, joints=SECOND),
    'joint 2, 5 N m more': Failure(1.0, 5.0, SECOND),
    'joint 2, 15 N m more': Failure(1.0, 15.0, SECOND),
    'all stuck': Failure(1.0, is_stuck=True),
    'all zero': Failure(0.0),
    'all of the wrong sign': Failure(-1.0),
    'all a tenth': Failure(0.1),
    'all in N mm': Failure(1000.0),
}


def failed(preset: str, failure: str) -> list[str]:
    """Return what happens to an arm whose sensors fail."""
    loop = load_loop(preset, {PLANT: {'duration': FAILS + AFTER_FAILURE}})
    arm, guard = plant_of(loop.plant), Guard(loop.controller)
    guard.starting.activate()
    n, period = len(loop.controller.joints), loop.plant.sample_time_ns
    largest, before = 0.0, np.zeros(n)
    for k in range(round((FAILS + AFTER_FAILURE) / (1e-9 * period))):
        measurement = np.array(arm.measure())
        if 1e-9 * k * period < FAILS:
            before[:] = measurement[2 * n :]
        else:
            effort = FAILURES[failure].read(measurement[2 * n :], before)
            measurement[2 * n :] = effort
            largest = max(largest, np.abs(guard.controller.sample.xi1).max())
        torque = guard.update(FIRST_STAMP + k * period, measurement)
        if torque is None or not guard.supervisor.running:
            break
        arm.step(torque)
    kinds = EventType.TORQUE_SENSORS, EventType.STOP
    said = [
        f'{1e-9 * (each.stamp - FIRST_STAMP) - FAILS:.3f} s: {each.content["text"][:60]}'
        for each in guard.journal.pending
        if each.type in kinds
    ]
    return [preset, failure, f'{1e3 * largest:.2f}', '; '.join(said)]


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    tables = 'margins', 'loops', 'pairs', 'declarations', 'sensors'
    parser.add_argument('table', choices=tables)
    add_runs(parser, 20, 'arms of each study')


def main(given: argparse.Namespace) -> None:
    """Print the table that was asked for."""
    if given.table == 'margins':
        print_table(['arm', 'tip', *(f'{L:g} rad/s' for L in BANDWIDTHS)], margins())
    elif given.table == 'loops':
        heads = ['arm', 'law', 'in motion', 'pick-up', 'later', 'weight known after']
        print_table(heads, loops())
    elif given.table == 'declarations':
        heads = ['arm', 'it is', *(f'{L:g} rad/s' for L in SLOW_TO_FAST)]
        print_table(heads, declarations())
    elif given.table == 'sensors':
        heads = ['arm', 'fails', 'largest error', 'said']
        rows = (failed(*each) for each in itertools.product(('panda', 'fr3'), FAILURES))
        print_table(heads, rows)
    else:
        of_spans = [f'{each}, {span}' for span in SPANS for each in ('rms', 'largest')]
        print_table(['study', 'arm', 'events', *of_spans], pairs(given.runs))

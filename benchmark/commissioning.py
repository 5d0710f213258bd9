# SPDX-License-Identifier: Apache-2.0
"""Random arms with elastic joints: commissioned by simulated runs, then put to work.

    python -m benchmark commissioning [ARMS] [STUDY ...]
    python -m benchmark commissioning repeat [ARMS] [STUDY ...]
    python -m benchmark commissioning careful [ARMS] [STUDY ...]
    python -m benchmark commissioning unknown [ARMS] [STUDY ...]
    python -m benchmark commissioning lags [ARMS] [STUDY ...]
    python -m benchmark commissioning above [ARMS] [STUDY ...]

The arms are those of the studies `monte_carlo_elastic_*`: gears, motors, friction, links,
delays and tables are drawn independently of what controller and commissioning assume.  Each is
measured in three postures, and in one with its rated payload.  With the gains that follow it
runs the motion of its preset for 60 s, and picks up its load at 8 s.

    held       no stop, and no oscillation, in 60 s, with a bound that only an arm that shakes
               would leave
    in bound   of these, those that keep the bound of the file that was written
    pick-up    largest error [mrad] within 4 s of it, in the median of those that hold; in
               brackets with the gains of the preset, where these hold
    bears      the largest of 1, 1.5, 2.5 and 4 by which all gains can be multiplied until the
               arm stops or oscillates within 16 s: the number of arms for each of them

`repeat` commissions each arm four times, with other noise, and compares the stiffnesses that
are chosen: (largest - least) / mean, in the median of the joints and in the worst of them.
Beside it the same of the measured inertias.

`careful` says what makes the chosen gains smaller than the largest that hold: the factors by
which they can be raised

    noise      until the margin of 0.5 is reached without the deviations by noise
    margin     until a margin of 0.1 is left, likewise: nearly the stability limit
    here       likewise, by the last run alone: in the first posture, with the load
    holds      until the arm stops or oscillates within 16 s, by bisection; without a limit
               it is 16

`unknown` commissions the same arms by files that have nothing but the URDF, what drivers know
of their robot, and the motion: the friction, the motors, the gears and the gains that the
presets have are left out.  With what is written each runs its motion for 16 s

    hidden     joints whose inertia friction hides
    bound      the largest error over the bound that is written; or why the arm stopped
    motion     the largest error [mrad] from 3 s on until the pick-up
    pick-up    likewise from the pick-up at 8 s on
    bears      as above

`lags` chooses the gains of each arm by the same runs three times: for damping that does not lag,
with lags of at most 5 ms where they pay, and with any of `choice.LAGS`

    lag [ms]   of each joint's damping, the last time
    stiffer    the gains, joint by joint, than without
    motion     largest error [mrad] from 3 s to the pick-up, each time; - if it does not hold
    pick-up    likewise, within 4 s of it
    later      likewise, from then on
    bears      as above, each time

`above` says whether a motion that ends at 120 Hz misses anything: the modulus margin of the true
linear arms up to there and above, in the postures of the measurement, with gains of the preset and
multiples of them.  Play and friction are left out.
"""

from __future__ import annotations

import argparse
import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np

from benchmark.elastic import FREE
from benchmark.harness import print_table
from benchmark.studies import load_study
from blf_dsc_controller.arms.joint_gains import linear
from blf_dsc_controller.arms.known_gears import MARGIN
from blf_dsc_controller.arms.linear_loop import (
    SLOWEST,
    Feedback,
    Joints,
    Timing,
    TorqueLoop,
    arm_response,
    law_response,
)
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.commissioning import simulated
from blf_dsc_controller.commissioning.choice import LAGS
from blf_dsc_controller.commissioning.commissioned import Commissioned, commissioned
from blf_dsc_controller.commissioning.commissioning import Commissioning
from blf_dsc_controller.commissioning.margin import Loops
from blf_dsc_controller.commissioning.measurement import Measured
from blf_dsc_controller.commissioning.planned import measuring_gains, postures_of
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change, flatten
from blf_dsc_controller.configuration.side_nodes import RecorderConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import Study, draw, plant_with
from blf_dsc_controller.studies.runs import cores

STUDIES = (
    'monte_carlo_elastic_fr3',
    'monte_carlo_elastic_panda',
    'monte_carlo_elastic_ur5e',
)
LONG, SHORT = 60.0, 16.0  # s
BEGIN = 3.0  # s, from which errors in motion are counted
PICK_UP, LOADED = 8.0, 4.0  # s, and for how long after it errors are counted
FACTORS = (1.5, 2.5, 4.0)
SHORT_LAG = 0.005  # s
TIMES = 4  # that an arm is commissioned
RAISE = 1.03  # step by step, since a loop beyond its stability limit has a margin again
LEAST = 0.1  # modulus margin, of a loop that is nearly unstable
MOST, HALVINGS = (
    16.0,
    6,
)  # the largest factor on the gains that is tried, and how finely
SEEN = 120.0  # Hz, the fastest line of the motion
STIFFER = (1.0, 2.0, 4.0)  # times the gains of the preset


class Outcome(NamedTuple):
    """What became of one arm."""

    refusal: str  # why there are no gains; empty if there are
    held: bool
    kept: bool  # its bound
    pick_up: float  # mrad
    before: float  # mrad, with the gains of the preset; NaN: they do not hold
    bears: float  # factor on the gains


def worked(
    controller: ControllerConfig, plant: PlantConfig, seconds: float
) -> tuple[bool, float]:
    """Return whether an arm holds, and its largest error [mrad] at the pick-up."""
    _, pick_up, _ = largest_errors(controller, plant, seconds)
    return not np.isnan(pick_up), pick_up


def largest_errors(
    controller: ControllerConfig, plant: PlantConfig, seconds: float
) -> tuple[float, float, float]:
    """Return the largest errors [mrad] in motion, at the pick-up and later; nan: it stops."""
    run = simulate(controller, change(plant, {'duration': seconds})).run()
    if run.error is None or run.stops or run.oscillations:
        return np.nan, np.nan, np.nan
    errors = 1e3 * np.abs(run.error).max(axis=1)
    begins = (BEGIN, PICK_UP, PICK_UP + LOADED)
    motion, pick_up, later = (
        float(errors[(run.time >= begin) & (run.time < end)].max())
        for begin, end in itertools.pairwise((*begins, seconds))
    )
    return motion, pick_up, later


def without_bound(controller: ControllerConfig) -> ControllerConfig:
    """Return a controller with bounds that only an arm that shakes would leave."""
    n = len(controller.joints)
    free = {'barrier.bound': [FREE] * n, 'barrier.initial_bound': [0.0] * n}
    return change(controller, free)


def refused(why: str) -> Outcome:
    """Return the outcome of an arm for which there are no gains."""
    return Outcome(why, False, False, np.nan, np.nan, 0.0)  # noqa: FBT003


def borne(controller: ControllerConfig, plant: PlantConfig) -> float:
    """Return the largest factor on the gains with which an arm holds."""
    most = 1.0
    for factor in FACTORS:
        if not worked(scaled(controller, factor), plant, SHORT)[0]:
            break
        most = factor
    return most


def scaled(controller: ControllerConfig, factor: float) -> ControllerConfig:
    """Return a controller with all gains multiplied."""
    gains = {
        'feedback.gain': controller.feedback.gain,
        'barrier.weight': controller.barrier.weight,
        'barrier.slope_limit': controller.barrier.slope_limit,
        'disturbance.gain': controller.disturbance.gain,
    }
    stiff = {
        name: (factor * np.array(values)).tolist() for name, values in gains.items()
    }
    return change(controller, stiff)


def outcome(name: str, number: int) -> Outcome:
    """Return what becomes of an arm of a study."""
    try:
        found, plant = commissioning_of(name, number)
    except BlfDscError as error:
        return refused(str(error))
    if found.choice.margin.value < MARGIN:
        text = f'no gains have the margin: {found.choice.margin.value:.2f}'
        return refused(text)
    free = without_bound(found.config)
    held, pick_up = worked(free, plant, LONG)
    kept, _ = worked(found.config, plant, LONG)
    _, before = worked(without_bound(found.before), plant, SHORT)
    return Outcome('', held, kept, pick_up, before, borne(free, plant))


def commissioning_of(
    name: str,
    number: int,
    seed: int | None = None,
    known: Callable[[ControllerConfig], ControllerConfig] = lambda config: config,
) -> tuple[Commissioned, PlantConfig]:
    """Return what is found of an arm of a study, with a seed of its noise, and its plant.

    `known` returns what is known of the arm, by the configuration of the study.
    """
    controller, measured, plant = measured_of(name, number, seed, known)
    return commissioned(controller, measured, MARGIN), plant


def measured_of(
    name: str,
    number: int,
    seed: int | None = None,
    known: Callable[[ControllerConfig], ControllerConfig] = lambda config: config,
) -> tuple[ControllerConfig, list[Measured], PlantConfig]:
    """Return what is known of an arm of a study, its runs, and its plant, as above."""
    study = load_study(name)
    controller = known(study.controller)
    # motors are drawn, which leaves nothing to scale
    plant = change(plant_with(study, draw(study, number)), {'truth.rotor_factor': 1.0})
    if seed is not None:
        plant = change(plant, {'seed': seed})
    return controller, runs_of(controller, plant), plant


def runs_of(controller: ControllerConfig, plant: PlantConfig) -> list[Measured]:
    """Return the runs of a commissioning of an arm that go to the end."""
    loop = LoopConfig(plant, controller, RecorderConfig())
    runs = [run for _, run in simulated.runs_of(Commissioning(controller), loop)]
    return [run for run in runs if not isinstance(run, BlfDscError)]


def lagging(name: str, number: int) -> list[str]:
    """Return the row of `lags` for an arm."""
    controller, measured, plant = measured_of(name, number)
    short = tuple(lag for lag in LAGS if lag <= SHORT_LAG)
    found = [
        commissioned(controller, measured, MARGIN, lags) for lags in ((), short, LAGS)
    ]
    choice = found[-1].choice
    row = [
        ', '.join(f'{1e3 * each:g}' for each in np.asarray(choice.gains.damping_lag)),
        ', '.join(f'{each:.2f}' for each in choice.factors / choice.without_lag),
    ]
    free = [without_bound(each.config) for each in found]
    errors = [largest_errors(each, plant, LONG) for each in free]
    row += [
        ', '.join('-' if np.isnan(e) else f'{e:.1f}' for e in times)
        for times in zip(*errors, strict=True)
    ]
    row.append(', '.join(f'{borne(each, plant):g}' for each in free))
    return [name.rpartition('_')[2], f'{number}', *row]


_STATED = (
    'sample_time',
    'joints',
    'robot.urdf',
    'robot.tip',
    'robot.gravity',
    'robot.effort',
    'robot.drive_',
    'torque.rate_limit',
    'torque.first_step',
    'reference.',
)


def by_urdf_alone(config: ControllerConfig) -> ControllerConfig:
    """Return a configuration that has the URDF, the facts of a driver, and the motion."""
    stated = {
        name: value
        for name, value in flatten(config).items()
        if name.startswith(_STATED)
    }
    return build(ControllerConfig, stated)


def unknown(name: str, number: int) -> list[str]:
    """Return the row of `unknown` for an arm."""
    first = [name.rpartition('_')[2], f'{number}']
    try:
        found, plant = commissioning_of(name, number, known=by_urdf_alone)
        config = found.config
    except BlfDscError as error:
        return [*first, str(error), '', '', '', '']
    run = simulate(config, change(plant, {'duration': SHORT})).run()
    hidden = f'{np.isnan(found.findings.inertia).sum()}'
    bears = f'{borne(without_bound(config), plant):g}'
    if run.error is None or run.stops:
        text = run.stops[0].text if run.stops else 'no sample'
        return [*first, hidden, f'stop: {text}', '', '', bears]
    errors = np.abs(run.error)
    moving = (run.time >= BEGIN) & (run.time < PICK_UP)
    used = f'{float((errors / np.array(config.barrier.bound)).max()):.2f}'
    if run.oscillations:
        used += ', oscillates'
    largest_errors = [
        f'{1e3 * float(errors[rows].max()):.2g}'
        for rows in (moving, run.time >= PICK_UP)
    ]
    return [*first, hidden, used, *largest_errors, bears]


def repeated(name: str, number: int) -> list[str]:
    """Return the row of `repeat` for an arm."""
    found = [commissioning_of(name, number, 1 + k)[0] for k in range(TIMES)]
    row = [name.rpartition('_')[2], f'{number}', f'{TIMES}']
    for values in (
        np.array([each.choice.gains.stiffness for each in found]),
        np.array([each.findings.inertia for each in found]),
    ):
        spread = np.ptp(values, axis=0) / values.mean(axis=0)
        row.append(f'{np.nanmedian(spread):.1%}, {np.nanmax(spread):.1%}')
    return row


def without_noise(loops: Loops) -> Loops:
    """Return measured arms as if no noise had been measured."""
    clean = [
        each._replace(
            position_noise=0.0 * each.position_noise,
            velocity_noise=0.0 * each.velocity_noise,
        )
        for each in loops.responses
    ]
    return loops._replace(responses=clean)


def largest(holds: Callable[[float], bool]) -> float:
    """Return the largest factor from 1 to MOST that holds, by bisection of its logarithm."""
    low, high = 0.0, float(np.log(MOST))
    if holds(MOST):
        return MOST
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(float(np.exp(middle))) else (low, middle)
    return float(np.exp(low))


def careful(name: str, number: int) -> list[str]:
    """Return the row of `careful` for an arm."""
    found, plant = commissioning_of(name, number)
    clean = without_noise(found.loops)
    here = clean._replace(responses=clean.responses[-1:])
    gains = found.choice.gains

    def raised(loops: Loops, margin: float) -> float:
        factor = 1.0
        while (
            factor < MOST and loops.margin(gains.scaled(RAISE * factor)).value >= margin
        ):
            factor *= RAISE
        return factor

    free = without_bound(found.config)
    factors = (
        raised(clean, MARGIN),
        raised(clean, LEAST),
        raised(here, LEAST),
        largest(lambda f: worked(scaled(free, f), plant, SHORT)[0]),
    )
    return [name.rpartition('_')[2], f'{number}', *(f'{f:.2g}' for f in factors)]


def drawn_joints(study: Study, number: int) -> tuple[Joints, Timing]:
    """Return what is between torques and links of an arm of a study, without play and friction."""
    plant = plant_with(study, draw(study, number))
    drives, sensor = plant.actuator, plant.sensor
    loop = TorqueLoop(drives.loop_gain, drives.loop_damping, drives.loop_lag)
    joints = Joints(
        motors=np.array(plant.truth.rotor_inertia),
        viscous=np.array(plant.disturbance.viscous),
        stiffness=np.array(plant.joint.stiffness),
        damping_ratio=plant.joint.damping_ratio,
        torque_loop=loop if drives.loop_gain > 0.0 else None,
        motor_side=sensor.side == 'motor',
    )
    filtered = 1.0 / sensor.velocity_pole if sensor.velocity_pole > 0.0 else 0.0
    timing = Timing(plant.sample_time, 1 + drives.delay, drives.time_constant, filtered)
    return joints, timing


def least_of(
    links: np.ndarray,
    arm: tuple[Joints, Timing],
    law: Feedback,
    frequency: np.ndarray,
) -> float:
    """Return the least singular value of I + G C at frequencies (f,) [Hz], in all postures."""
    s = np.asarray(2j * np.pi * frequency, np.complex128)
    G, C = arm_response(links, *arm, s), law_response(law, arm[1], s)
    loop = np.eye(links.shape[-1]) + np.matmul(G, C)
    return float(np.linalg.svd(loop, compute_uv=False).min())


def above(name: str, count: int) -> Iterator[list[str]]:
    """Compute the rows of `above` for a study."""
    study = load_study(name)
    arm, _ = design_of(study.controller)
    P = arm.parameters.of(arm.chain.inertias, 0.0 * arm.rotors)
    links = inertia_matrices(arm.parameters.model, P, postures_of(study.controller))
    inertia = arm.over_postures().inertia
    fastest = 0.48 / study.plant.sample_time
    bands = np.geomspace(SLOWEST, SEEN, 400), np.geomspace(SEEN, fastest, 800)[1:]
    arms = [drawn_joints(study, number) for number in range(count)]
    for factor in STIFFER:
        law = linear(
            measuring_gains(study.controller).scaled(factor), inertia, len(links)
        )
        least = np.array(
            [[least_of(links, each, law, f) for f in bands] for each in arms]
        )
        yield [
            name.rpartition('_')[2],
            f'{count}',
            f'{factor:g}',
            *(
                f'{each:.2f}'
                for each in (*np.median(least, axis=0), *least.min(axis=0))
            ),
            f'{np.count_nonzero(least[:, 1] < least[:, 0])}',
        ]


def of_arms(
    row: Callable[[str, int], list[str]], names: tuple[str, ...], count: int
) -> Iterator[list[str]]:
    """Compute a row for each arm of each study."""
    arms = [(name, number) for name in names for number in range(count)]
    with ProcessPoolExecutor(cores()) as pool:
        yield from pool.map(row, *zip(*arms, strict=True))


def rows(names: tuple[str, ...], count: int) -> Iterator[list[str]]:
    """Compute the row of each study."""
    with ProcessPoolExecutor(cores()) as pool:
        for name in names:
            found = list(pool.map(outcome, itertools.repeat(name), range(count)))
            chosen = [each for each in found if not each.refusal]
            for text, times in Counter(e.refusal for e in found if e.refusal).items():
                print(f'{name}: {times} times: {text}')
            for k, each in enumerate(found):
                if not (each.refusal or each.held):
                    print(f'{name}: run {k} does not hold')
            bears = Counter(each.bears for each in chosen)
            pick_up = np.nanmedian([each.pick_up for each in chosen])
            before = np.nanmedian([each.before for each in chosen])
            yield [
                name.rpartition('_')[2],
                f'{count}',
                f'{len(chosen)}',
                f'{sum(each.held for each in chosen)}',
                f'{sum(each.held and each.kept for each in chosen)}',
                f'{pick_up:.2g} ({before:.2g})',
                ', '.join(f'{bears[factor]}' for factor in (1.0, *FACTORS)),
            ]


HEADS = {
    'repeat': ['arm', 'number', 'times', 'stiffness chosen', 'inertia measured'],
    'lags': [
        'arm',
        'number',
        'lag [ms]',
        'stiffer',
        'motion',
        'pick-up',
        'later',
        'bears',
    ],
    'careful': ['arm', 'number', 'noise', 'margin', 'here', 'holds'],
    'unknown': ['arm', 'number', 'hidden', 'bound', 'motion', 'pick-up', 'bears'],
    'above': [
        'arm',
        'arms',
        'times the gains',
        'margin to 120 Hz, median',
        'above',
        'to 120 Hz, worst',
        'above',
        'least above',
    ],
}
ROWS = {'lags': lagging, 'repeat': repeated, 'careful': careful, 'unknown': unknown}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('words', nargs='*', metavar='WORD', help='see above')


def main(options: argparse.Namespace) -> None:
    """Print a table."""
    words = options.words
    what = words.pop(0) if words and words[0] in HEADS else ''
    many, *given = words or ['2' if what else '20']
    names = tuple(given) or STUDIES
    if what == 'above':
        margins = (row for name in names for row in above(name, int(many)))
        print_table(HEADS[what], margins)
        return
    if what:
        print_table(HEADS[what], of_arms(ROWS[what], names, int(many)))
        return
    print_table(
        [
            'arm',
            'arms',
            'with gains',
            'held',
            'in bound',
            'pick-up',
            'bears 1, 1.5, 2.5, 4',
        ],
        rows(names, int(many)),
    )

# SPDX-License-Identifier: Apache-2.0
"""UR5es whose damping lags (`feedback.damping_lag`), and the same ones without.

    python -m benchmark damping-lag margins
    python -m benchmark damping-lag motors
    python -m benchmark damping-lag drawn [--count 40]
    python -m benchmark damping-lag arms [--arms 143 ...] [--lag 0.003]
    python -m benchmark damping-lag presets [--lag 0.003]

The margins are those of the linear loop of the arm in the middle of the study of
`random-arms`, with encoders at its links and at its motors. Those of `motors` are of
presets with motors of several times the controller's guess, those of `drawn` of arms of
that study, both also with a lag on the damping of the first three joints alone. Arms are
random ones of the study, by default those that oscillate although the published gains hold,
and three calm ones. Presets pick up the 3 kg of `ur5e`, or 2 kg, with motors of several
times the controller's guess, encoders at either side, and play. Errors [mrad] are the
largest in motion, from the pick-up on, and from 3 s later on.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from benchmark import random_arms
from benchmark.harness import print_table
from benchmark.random_arms import Result
from benchmark.soft_arms import PLAY, POSTURES
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change

UR5E = 'ur5e'
LAG = 0.003  # s
LAGS = (0.0, 0.001, 0.002, 0.003, 0.004, 0.005, 0.0075)  # s
OSCILLATE = (143, 362, 411, 417, 424, 442)
CALM = (3, 5, 8)
GUESSES = (1.0, 2.0, 3.0, 5.0, 7.0)
LARGE = 3  # joints of shoulder and elbow
SETTINGS = {  # how many joints lag, by how much [s]
    'none': (0, 0.0),
    '3 ms': (6, LAG),
    f'2 ms, first {LARGE} joints': (LARGE, 0.002),
    f'3 ms, first {LARGE} joints': (LARGE, LAG),
    f'5 ms, first {LARGE} joints': (LARGE, 0.005),
}
QUARTILES = (0.0, 0.25, 0.5, 0.75, 1.0)
LESS = 0.02  # of margin, that counts as less
ROTORS = (0.5, 1.0, 2.0, 7.0)
AT_MOTORS: Mapping[str, object] = {'sensor.side': 'motor'}
OF_2_KG: Mapping[str, object] = {'events.payload': [2.0]}
AS_IT_IS: Mapping[str, object] = {}
PLAYS: Mapping[str, object] = {'joint.backlash': [PLAY] * 6}
ALL: tuple[float | None, ...] = (None, *ROTORS)
PRESETS = (
    (UR5E, 'encoders at the links', AS_IT_IS, ALL),
    (UR5E, 'encoders at the links, 2 kg', OF_2_KG, ALL[:1]),
    (UR5E, 'encoders at the motors', AT_MOTORS, ALL),
    (UR5E, 'encoders at the motors, 2 kg', {**AT_MOTORS, **OF_2_KG}, ALL[:1]),
    (UR5E, 'play of 0.4 mrad', PLAYS, ALL[:1]),
    ('ur5e_driver', 'encoders at the links', AS_IT_IS, ALL),
    ('ur5e_driver', 'encoders at the links, 2 kg', OF_2_KG, ALL[:1]),
)


def lagging(config: ControllerConfig, lag: float) -> ControllerConfig:
    """Return a controller whose damping lags by so much [s]."""
    return change(config, {'feedback.damping_lag': lag})


def margins() -> Iterator[list[str]]:
    """Compute the rows: the modulus margin for each lag."""
    arm = random_arms.described(UR5E)
    config = load_loop(UR5E).controller
    for lag in LAGS:
        law = random_arms.own_feedback(lagging(config, lag), arm.M0)
        sides = (arm.joints._replace(motor_side=each) for each in (False, True))
        values = [arm._replace(joints=joints).margin(law) for joints in sides]
        yield [f'{1e3 * lag:g} ms', *(f'{each:.2f}' for each in values)]


def motors() -> Iterator[list[str]]:
    """Compute the rows: margins of presets with motors of several times the guess."""
    for preset, side, factor in itertools.product(
        (UR5E, 'ur5e_driver'), ('link', 'motor'), GUESSES
    ):
        loop = load_loop(preset, {PLANT: random_arms.picks_up(UR5E)})
        rotors = factor * random_arms.guessed_rotors(loop.controller)
        given = {'truth.rotor_inertia': rotors.tolist(), 'sensor.side': side}
        found = margins_of(loop.controller, change(loop.plant, given))
        yield [preset, side, f'{factor:g}', *(f'{each:.2f}' for each in found)]


def drawn(count: int) -> Iterator[list[str]]:
    """Compute the rows: margins of random arms, with encoders on either side."""
    study = random_arms.study_of(UR5E)
    plants = [random_arms.arm_of(study, number) for number in range(count)]
    for side in ('link', 'motor'):
        found = np.array(
            [
                margins_of(study.controller, change(each, {'sensor.side': side}))
                for each in plants
            ]
        )
        for label, values in zip(SETTINGS, found.T, strict=True):
            quartiles = ' / '.join(f'{q:.2f}' for q in np.quantile(values, QUARTILES))
            less = int((values < found[:, 0] - LESS).sum())
            yield [side, label, quartiles, f'{(values == 0.0).sum()}', f'{less}']


def margins_of(config: ControllerConfig, plant: PlantConfig) -> list[float]:
    """Return the modulus margins of an arm with each of the `SETTINGS`."""
    arm = random_arms.describe(config, plant, POSTURES)
    law = random_arms.own_feedback(config, arm.M0)
    n = len(config.joints)
    return [
        arm.margin(law._replace(damping_lag=np.where(np.arange(n) < first, lag, 0.0)))
        for first, lag in SETTINGS.values()
    ]


def arms(numbers: Sequence[int], lag: float) -> Iterator[list[str]]:
    """Compute the rows: random arms without and with the lag."""
    study = random_arms.study_of(UR5E)
    for number in numbers:
        plant = random_arms.arm_of(study, number)
        yield [f'{number}', *_both(study.controller, plant, lag)]


def presets(lag: float) -> Iterator[list[str]]:
    """Compute the rows: presets without and with the lag."""
    pick_up = random_arms.picks_up(UR5E)
    for name, label, changes, factors in PRESETS:
        loop = load_loop(name, {PLANT: {**pick_up, **changes}})
        for factor in factors:
            plant, motors = loop.plant, 'as they are'
            if factor is not None:
                rotors = factor * random_arms.guessed_rotors(loop.controller)
                plant = change(plant, {'truth.rotor_inertia': rotors.tolist()})
                motors = f'{factor:g} times the guess'
            yield [name, label, motors, *_both(loop.controller, plant, lag)]


def _both(config: ControllerConfig, plant: PlantConfig, lag: float) -> Iterator[str]:
    """Compute what becomes of an arm without and with the lag."""
    bound = np.array(config.barrier.bound)
    for each in (0.0, lag):
        yield _told(random_arms.run(lagging(config, each), plant, bound))


def _told(found: Result) -> str:
    """Return what becomes of an arm: errors [mrad], and whether it oscillates or stops."""
    errors = found.motion, found.pick_up, found.settled
    what = ', '.join('-' if np.isnan(e) else f'{1e3 * e:.1f}' for e in errors)
    why = found.text.partition(' with ')[0]
    if not np.isnan(found.stopped):
        return f'{what}; stops at {found.stopped:.1f} s: {why}'
    return f'{what}; {why}' if why else what


BOTH = 'without [mrad]', 'with the lag [mrad]'
HEADS = {
    'margins': ('lag', 'encoders at the links', 'at the motors'),
    'motors': ('preset', 'encoders', 'motors [of the guess]', *SETTINGS),
    'drawn': (
        'encoders',
        'lag',
        'margin: least / quartiles / largest',
        'unstable',
        'less than without',
    ),
    'arms': ('arm', *BOTH),
    'presets': ('preset', 'arm', 'motors', *BOTH),
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('table', choices=HEADS)
    parser.add_argument('--arms', type=int, nargs='+', default=[*OSCILLATE, *CALM])
    parser.add_argument('--count', type=int, default=40, help='arms of drawn')
    parser.add_argument('--lag', type=float, default=LAG, help='s')


def main(given: argparse.Namespace) -> None:
    """Print the table that was asked for."""
    if given.table == 'margins':
        rows = margins()
    elif given.table == 'motors':
        rows = motors()
    elif given.table == 'drawn':
        rows = drawn(given.count)
    elif given.table == 'arms':
        rows = arms(given.arms, given.lag)
    else:
        rows = presets(given.lag)
    print_table(HEADS[given.table], rows)

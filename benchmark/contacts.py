# SPDX-License-Identifier: Apache-2.0
"""How soon a contact is detected, with the learned model and the URDF's.

    python -m benchmark contacts [--arms 1000] [--force 10 20] --out contacts

Each arm has links up to 30 % heavier or lighter than its URDF, picks up an unknown
load, and is pushed at the tip once it has learned it, in a random direction.  Two
observers of the same bandwidth read the same sensors behind the same lag, in the same
loop:

    learned         X_L theta^ - u_L, with the covariance that it gives itself (law.external_torque)
    URDF            X_L P^(0) - u_L, the momentum observer of the URDF, friction included

The residual of the URDF's observer is mostly its own error, so its threshold matters.
One detector gets what no user knows: the mean square matrix of its residual on this
very arm, with this load, in the seconds before the push.  The other has, as is usual,
one limit for each joint of all arms of a kind, in proportion to the rms of its residual
there.  All thresholds are then scaled to equal false alarms.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from benchmark.options import add_configs, add_out, positive
from blf_dsc_controller.analysis.figures import Picture, head
from blf_dsc_controller.analysis.output import aligned, write_json
from blf_dsc_controller.analysis.panels import BLUE, MUTED, ORANGE
from blf_dsc_controller.cli.result_folder import make_folder
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.law.perception import DISTANCE
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.law.state import Sample
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.run import FIRST_STAMP, Floats
from blf_dsc_controller.simulation.loop import Record, simulate
from blf_dsc_controller.studies import laws
from blf_dsc_controller.studies.runs import cores

PICK_UP = 8.0  # s
FREE = 12.0  # s, from when on false alarms are counted
PUSH = 18.0  # s, or up to a second later
WATCHED = 0.5  # s after it
RISE = 0.01  # s
CALM = 0.2  # s without an alarm, after which another one counts
DOUBT = 0.3  # of the links' masses
LEAST_LOAD = 0.3  # kg
RATES = (100.0, 10.0, 0.0)
"""False alarms for each hour of motion at which delays are compared; 0: none at all."""
DRAWN = 10.0
"""One of them, of the picture."""

LEARNED = 'learned, its own covariance'
TOLD = 'URDF, known error on each arm'
USUAL = 'URDF, one limit for each joint'
DETECTORS = {LEARNED: BLUE, TOLD: ORANGE, USUAL: MUTED}


class Trial(NamedTuple):
    """Distances of one arm from what an observer explains, sample by sample."""

    arm: str
    free: Mapping[str, Floats]  # (k,) from FREE to the push
    # (WATCHED,) since the push; NaN once the law has stopped
    pushed: Mapping[str, Floats]
    rms: Floats  # (n,) N m, of the URDF's residual in free motion
    # of the detector as it is set by default, with loads expected:
    pick_up_alarms: int
    false_alarms: int
    delay: float  # s; infinite: not found


def loop_of(arm: str, seed: int, force: float) -> LoopConfig:
    """Return the loop of a random arm with its load and its push of `force` [N]."""
    random = np.random.default_rng((seed, 49))
    direction = random.normal(size=3)
    direction *= force / np.sqrt((direction**2).sum())
    begin = PUSH + float(random.uniform())
    loop = laws.trial(arm, seed)
    payload = float(random.uniform(LEAST_LOAD, loop.controller.robot.payload))
    plant = {
        'duration': begin + WATCHED,
        'truth.mass_deviation': DOUBT,
        'events.begin': [PICK_UP, begin],
        'events.duration': [0.0, 0.0],
        'events.ramp': [0.0, RISE],
        'events.payload': [payload, 0.0],
        'events.force': [0.0, 0.0, 0.0, *direction.tolist()],
    }
    controller = {'contact.enabled': True}
    return loop._replace(
        plant=change(loop.plant, plant), controller=change(loop.controller, controller)
    )


def run(arm: str, seed: int, force: float) -> Trial | None:
    """Run one arm three times: alone, with loads expected, and with the URDF's model.

    None: the law stopped before the push.
    """
    loop = loop_of(arm, seed, force)
    begin = loop.plant.events.begin[1]
    alone, of_urdf, expecting = (
        simulate(controller, loop.plant) for controller in variants(loop.controller)
    )
    residuals = np.asarray(telemetry(of_urdf).external)
    learned = telemetry(alone).contact[:, DISTANCE]
    t = of_urdf.stamps * 1e-9
    free = (t >= FREE) & (t < begin)
    watched = np.flatnonzero(t >= begin)[: round(WATCHED / loop.plant.sample_time)]
    known = residuals[free]
    if np.isnan(known).any() or np.isnan(learned[free]).any():
        return None
    distances = {
        LEARNED: learned,
        TOLD: whitened(residuals, known),
        USUAL: np.abs(residuals),
    }
    alarms = contact_times(expecting)
    found = alarms[alarms >= begin]
    return Trial(
        arm,
        {name: each[free].astype(np.float32) for name, each in distances.items()},
        {name: each[watched] for name, each in distances.items()},
        np.sqrt((known**2).mean(axis=0)),
        pick_up_alarms=int(((alarms >= PICK_UP) & (alarms < FREE)).sum()),
        false_alarms=int(((alarms >= FREE) & (alarms < begin)).sum()),
        delay=float(found[0] - begin) if found.size else np.inf,
    )


def variants(config: ControllerConfig) -> Iterator[ControllerConfig]:
    """Yield the law that expects no loads, that does not learn, and as it is set by default."""
    unlearned = [0.0] * len(config.learning.initial_estimate)
    yield change(config, {'contact.loads': False})
    yield change(
        config, {'learning.weight': 0.0, 'learning.adaptation_gain': unlearned}
    )
    yield config


def telemetry(record: Record) -> Sample:
    """Return the samples of a run as columns; NaN after a stop."""
    return sample_columns(record.samples, record.controller.settings)


def whitened(residuals: Floats, known: Floats) -> Floats:
    """Return the lengths (k,) of residuals (k, n) by the mean square matrix of those `known`."""
    inverse = np.linalg.inv(known.T @ known / len(known))
    squares = np.einsum('ki,ij,kj->k', residuals, inverse, residuals)
    return np.asarray(np.sqrt(squares))


def contact_times(record: Record) -> Floats:
    """Return when contacts were reported [s since the first sample]."""
    found = (e for e in record.journal.pending if e.type is EventType.CONTACT)
    return np.array([(event.stamp - FIRST_STAMP) * 1e-9 for event in found])


def with_usual_limits(trials: Sequence[Trial]) -> list[Trial]:
    """Replace the residuals of USUAL by the largest over the limit of its joint."""
    limits = {
        arm: np.sqrt(
            np.mean([trial.rms**2 for trial in trials if trial.arm == arm], axis=0)
        )
        for arm in {trial.arm for trial in trials}
    }

    def scaled(trial: Trial, values: Mapping[str, Floats]) -> dict[str, Floats]:
        worst = (values[USUAL] / limits[trial.arm]).max(axis=1)
        return {**values, USUAL: worst}

    return [
        trial._replace(
            free=scaled(trial, trial.free), pushed=scaled(trial, trial.pushed)
        )
        for trial in trials
    ]


def alarms(distance: Floats, threshold: float, calm: int) -> int:
    """Return how often a distance (k,) exceeds a threshold after `calm` samples."""
    above = np.flatnonzero(distance > threshold)
    if not above.size:
        return 0
    return 1 + int((np.diff(above) > calm).sum())


def delays(pushed: Sequence[Floats], threshold: float, period: float) -> Floats:
    """Return the delays (N,) [s] of distances since the push; infinite: not found."""
    found = [np.flatnonzero(each > threshold) for each in pushed]
    return np.array([each[0] * period if each.size else np.inf for each in found])


def threshold_at(rate: float, free: Sequence[Floats], period: float) -> float:
    """Return the least threshold with at most `rate` false alarms per hour."""
    hours = sum(each.size for each in free) * period / 3600.0
    calm = round(CALM / period)
    low, high = 0.0, 2.0 * float(max(each.max() for each in free))
    for _ in range(30):
        middle = 0.5 * (low + high)
        count = sum(alarms(each, middle, calm) for each in free)
        low, high = (middle, high) if count > rate * hours else (low, middle)
    return high


def summary(trials: Sequence[Trial], period: float = 0.001) -> dict[str, Any]:
    """Return thresholds, delays [s] and what is missed, by detector and rate."""
    trials = with_usual_limits(trials)
    found: dict[str, Any] = {
        'arms': len(trials),
        'hours': sum(trial.free[LEARNED].size for trial in trials) * period / 3600.0,
        'default': {
            'pick-ups taken for a contact': sum(t.pick_up_alarms > 0 for t in trials),
            'false alarms': sum(trial.false_alarms for trial in trials),
            'median delay': float(np.median([trial.delay for trial in trials])),
            'missed': float(np.mean([np.isinf(trial.delay) for trial in trials])),
        },
    }
    for name in DETECTORS:
        free = [trial.free[name] for trial in trials]
        pushed = [trial.pushed[name] for trial in trials]
        found[name] = {}
        for rate in RATES:
            threshold = threshold_at(rate, free, period)
            times = delays(pushed, threshold, period)
            found[name][f'{rate:g}'] = {
                'threshold': threshold,
                'median': float(np.median(times)),
                'nine in ten': float(np.sort(times)[math.ceil(0.9 * times.size) - 1]),
                'missed': float(np.isinf(times).mean()),
                'delays': [round(each, 4) for each in times.tolist()],
            }
    return found


def compare(
    folder: Path, arms: Sequence[str], count: int, forces: Sequence[float]
) -> dict[str, Any]:
    """Run `count` arms with each force; write contacts.json and contacts.png."""
    found = {}
    jobs = [(arms[k % len(arms)], k + 1) for k in range(count)]
    with ProcessPoolExecutor(cores()) as pool:
        for force in forces:
            names, seeds = zip(*jobs, strict=True)
            results = pool.map(run, names, seeds, [force] * count, chunksize=4)
            trials = [each for each in tqdm(results, total=count, unit='arm') if each]
            found[f'{force:g}'] = summary(trials)
    write_json(found, folder / 'contacts.json')
    draw(found, folder / 'contacts.png')
    return found


def format_results(found: Mapping[str, Any]) -> str:
    """Return a table for each force: delays [ms], and the share of missed pushes."""
    lines = []
    for force, results in found.items():
        default = results['default']
        hours = results['hours']
        lines.append(
            f'{force} N at the tip, {results["arms"]} arms, {hours:.3g} h of free motion'
        )
        rows = [
            [
                'false alarms per hour',
                *(f'{rate:g}' if rate else 'none' for rate in RATES for _ in range(3)),
            ],
            ['', *(['median [ms]', '90 % [ms]', 'missed'] * len(RATES))],
        ]
        for name in DETECTORS:
            row = [name]
            for rate in RATES:
                each = results[name][f'{rate:g}']
                row += [milliseconds(each[key]) for key in ('median', 'nine in ten')]
                row.append(f'{100 * each["missed"]:.1f} %')
            rows.append(row)
        lines.append(aligned(rows))
        lines.append(
            'with the default settings, which expect loads: '
            f'{default["pick-ups taken for a contact"]} of {results["arms"]} pick-ups taken for '
            f'a contact, {default["false alarms"] / hours:.2g} false alarms per hour, '
            f'median {milliseconds(default["median delay"])} ms, '
            f'{100 * default["missed"]:.1f} % missed'
        )
    return '\n'.join(lines)


def milliseconds(time: float) -> str:
    """Return a delay [s] in ms; a dash where it is not found."""
    return f'{1e3 * time:.0f}' if np.isfinite(time) else '-'


def draw(found: Mapping[str, Any], path: Path) -> None:
    """Draw the share of pushes found over time, at `DRAWN` false alarms per hour."""
    title = f'How soon a push is found, at {DRAWN:g} false alarms per hour'
    picture = Picture(1, len(found), title, (5.2, 3.6), share_time=False)
    for axes, (force, results) in zip(picture.axes[0], found.items(), strict=True):
        for name, colour in DETECTORS.items():
            times = np.sort(results[name][f'{DRAWN:g}']['delays'])
            share = 100.0 * np.arange(1, times.size + 1) / times.size
            label = name if axes is picture.axes[0, -1] else None
            axes.step(1e3 * times, share, where='post', color=colour, label=label)
        axes.set_xlim(0.0, 1e3 * WATCHED)
        axes.set_ylim(0.0, 100.0)
        axes.set_xlabel('since the push [ms]')
        axes.set_ylabel('found [%]')
        head(axes, f'{force} N at the tip')
    picture.save(path)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_configs(parser, 'panda_rigid', 'ur5e_rigid')
    parser.add_argument('--arms', type=positive, default=1000, help='arms (1000)')
    parser.add_argument(
        '--force',
        type=float,
        nargs='+',
        default=[10.0, 20.0],
        help='forces of the pushes [N] (10 20)',
    )
    add_out(parser, 'contacts')


def main(options: argparse.Namespace) -> None:
    """Push random arms; write contacts.json and contacts.png, and print the table."""
    folder = make_folder(options.out)
    with announced_compilation(print_notice):
        study = compare(folder, options.config, options.arms, options.force)
    print(format_results(study))
    print(f'wrote {options.out}: contacts.json, contacts.png')

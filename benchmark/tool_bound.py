# SPDX-License-Identifier: Apache-2.0
"""How tight and how safe a certified bound at the tool is.

    python -m benchmark tool-bound [--bound 0.005] [--truths 20] --out tool

Kinematics: random motions within the position limits, with random joint errors within
the joint bounds, of three kinds: independent from moment to moment, sines that rest on
the bounds, and a corner of the box that is kept.  At a posture of each motion all
corners are tried as well: the worst that the joint bounds allow there.

Closed loops: those of `laws.trial`, wrong URDFs that pick up a load, with the joint
bounds that follow from the bound at the tool, from the first sample on.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmark.options import add_configs, add_out, add_runs, positive
from blf_dsc_controller.analysis.figures import Picture, head
from blf_dsc_controller.analysis.metrics import measure
from blf_dsc_controller.analysis.output import aligned, write_json
from blf_dsc_controller.analysis.panels import BLUE, INK, MUTED, ORANGE
from blf_dsc_controller.cli.result_folder import make_folder
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, load_loop
from blf_dsc_controller.configuration.tool_bound import certified, tool_of
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies import laws
from blf_dsc_controller.studies.runs import cores
from blf_dsc_controller.supervision.reference_load import along
from blf_dsc_controller.tool.errors import BOUND, ERROR, Tool

_MOMENTS = 100  # of a random motion
_TONES = 3
_CHUNK = 100  # motions
_REFERENCE = 200  # postures of the preset's motion


class Motions(NamedTuple):
    """Figures of m random motions, [m]."""

    largest: Floats  # error at the tool
    there: Floats  # bound at the posture of that error
    share: Floats  # of the error in the bound at its posture, the largest
    corner: Floats  # largest error at any corner, at the first posture
    first: Floats  # bound at that posture


def limits_of(config: ControllerConfig) -> tuple[Floats, Floats]:
    """Return the position limits (n,), within half a turn each way [rad]."""
    lower = np.maximum(config.limits.position_lower, -np.pi)
    upper = np.minimum(config.limits.position_upper, np.pi)
    return lower, upper


def random_motions(
    config: ControllerConfig, count: int, random: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return postures and errors within the joint bounds (count, _MOMENTS, n) [rad]."""
    n = len(config.joints)
    lower, upper = limits_of(config)
    t = np.linspace(0.0, 1.0, _MOMENTS)[np.newaxis, :, np.newaxis]
    ends = np.sort(random.uniform(lower, upper, (2, count, 1, n)), axis=0)
    wave = np.zeros((count, _MOMENTS, n))
    for _ in range(_TONES):
        frequency = random.uniform(1.0, 20.0, (count, 1, n))
        wave += np.sin(frequency * t + random.uniform(0.0, 6.3, (count, 1, n))) / _TONES
    q = np.asarray(ends.mean(axis=0) + 0.5 * (ends[1] - ends[0]) * wave)
    shares = random.uniform(-1.0, 1.0, q.shape)
    frequency = random.uniform(1.0, 20.0, (count, 1, n))
    sines = np.sin(frequency * t + random.uniform(0.0, 6.3, (count, 1, n)))
    shares[1::3] = np.clip(1.5 * sines[1::3], -1.0, 1.0)
    corners = random.choice((-1.0, 1.0), (count, 1, n))
    shares[2::3] = np.broadcast_to(corners, q.shape)[2::3]
    return q, np.asarray(shares * np.array(config.barrier.bound))


def try_motions(config: ControllerConfig, runs: int, seed: int = 0) -> Motions:
    """Return the errors at the tool of random motions with random joint errors.

    Raises BlfDscError without a bound at the tool.
    """
    tool = tool_of(config)
    if tool is None:
        raise BlfDscError('a bound at the tool is needed: give barrier.tool_bound')
    random = np.random.default_rng(seed)
    k = np.array(config.barrier.bound)
    corners = corners_of(k)
    found: list[Floats] = []
    for begin in range(0, runs, _CHUNK):
        q, errors = random_motions(config, min(_CHUNK, runs - begin), random)
        values = tool.errors(q, errors, k)
        error, bound = values[..., ERROR], values[..., BOUND]
        at = error.argmax(axis=1)[:, np.newaxis]
        rows = [
            error.max(axis=1),
            np.take_along_axis(bound, at, axis=1)[:, 0],
            (error / bound).max(axis=1),
            worst_corners(tool, q[:, 0], corners),
            bound[:, 0],
        ]
        found.append(np.array(rows))
    return Motions(*np.hstack(found))


def corners_of(k: Floats) -> Floats:
    """Return the corners (2^n, n) of the box |e_i| <= k_i."""
    signs = np.array(list(product((-1.0, 1.0), repeat=k.size)))
    return np.asarray(k * signs)


def worst_corners(tool: Tool, q: Floats, corners: Floats) -> Floats:
    """Return the largest error (m,) [m] at corners (c, n), for q (m, n)."""
    shape = (len(q), *corners.shape)
    postures = np.broadcast_to(q[:, np.newaxis], shape)
    errors = np.broadcast_to(corners, shape)
    found = tool.errors(postures, errors, np.zeros(shape))[..., ERROR]
    return np.asarray(found.max(axis=1))


def closed_loop(seed: int, arm: str, given: dict[str, Any]) -> dict[str, Any]:
    """Return the figures at the tool of a closed loop, and whether it stopped."""
    loop = laws.trial(arm, seed, {CONTROLLER: given})
    metrics = measure(simulate(loop.controller, loop.plant).run())
    assert metrics.tool is not None  # noqa: S101 - of a loop with a bound there
    return {
        **metrics.tool,
        'largest joint error over its bound': metrics.max_error_ratio,
        'stops': [stop['text'] for stop in metrics.stops],
    }


def bounded(bound: float) -> dict[str, Any]:
    """Return the parameters of a bound at the tool [m] instead of joint bounds.

    Raises BlfDscError if it is not above 0.
    """
    if not bound > 0.0:
        raise BlfDscError(f'--bound: got {bound:g} m, but it must be above 0')
    return {'barrier.bound': None, 'barrier.tool_bound': bound}


def configured(arms: Sequence[str], bound: float) -> dict[str, ControllerConfig]:
    """Return the configurations of presets or files with a bound at the tool [m].

    Raises BlfDscError if there is none, or no trial of it.
    """
    given = {CONTROLLER: bounded(bound)}
    for arm in arms:
        laws.trial(arm, 1, given)
    return {arm: load_loop(arm, given).controller for arm in arms}


def compare(
    folder: Path,
    configs: Mapping[str, ControllerConfig],
    bound: float,
    runs: int,
    truths: int,
) -> dict[str, dict[str, Any]]:
    """Try everything; write tool.json and tool.png; return the figures by arm."""
    given = bounded(bound)
    found: dict[str, dict[str, Any]] = {}
    motions: dict[str, Motions] = {}
    for arm, config in configs.items():
        motions[arm] = try_motions(config, runs)
        found[arm] = figures_of(config, motions[arm])
    with ProcessPoolExecutor(cores()) as pool:
        for arm in configs:
            trials = pool.map(
                partial(closed_loop, arm=arm, given=given), range(1, truths + 1)
            )
            found[arm]['closed loops'] = list(trials)
    write_json(found, folder / 'tool.json')
    draw(motions, found, folder / 'tool.png')
    return found


def figures_of(config: ControllerConfig, of: Motions) -> dict[str, Any]:
    """Return the figures of an arm: lengths in m, joint bounds in rad."""
    tool = tool_of(config)
    assert tool is not None  # noqa: S101 - as in `try_motions`
    k = np.array(config.barrier.bound)
    everywhere, _ = certified(config)
    q = along(config, _REFERENCE)[0]
    worst = float(worst_corners(tool, q, corners_of(k)).max())
    at_postures = float(tool.at_postures(q, k)[:, 0].max())
    return {
        'joint bounds': dict(zip(config.joints, k.tolist(), strict=True)),
        'certified': everywhere,
        'along the reference': {
            'certified': at_postures,
            'worst corner': worst,
            'ratio': everywhere / worst,
        },
        'random runs': of.largest.size,
        'above the certified bound': int((of.largest > everywhere).sum()),
        'above that of their posture': int((of.share > 1.0).sum()),
        'largest error': float(of.largest.max()),
        'certified over measured': _quantiles(everywhere / of.largest),
        'certified at a posture over its worst corner': _quantiles(
            of.first / of.corner
        ),
        'certified over the worst corner of a posture': _quantiles(
            everywhere / of.corner
        ),
    }


def _quantiles(values: Floats) -> dict[str, float]:
    names = {'least': 0.0, '5 %': 5.0, 'median': 50.0, '95 %': 95.0, 'largest': 100.0}
    return {name: float(np.percentile(values, at)) for name, at in names.items()}


def format_figures(found: dict[str, dict[str, Any]]) -> str:
    """Return a table [mm]: a line for each arm."""
    rows = [
        [
            'mm at the tool',
            'certified',
            'worst of reference',
            'ratio',
            'random runs',
            'largest',
            'above',
            'ratio at a posture',
            'closed loops',
            'largest',
            'stops',
        ]
    ]
    for arm, of in found.items():
        path = of['along the reference']
        loops = of['closed loops']
        stops = sum(bool(each['stops']) for each in loops)
        lengths = of['certified'], path['worst corner'], of['largest error']
        everywhere, worst, largest = (f'{1e3 * each:.2f}' for each in lengths)
        ratios = of['certified at a posture over its worst corner']
        errors = [each['error'] for each in loops]
        rows.append(
            [
                arm,
                everywhere,
                worst,
                f'{path["ratio"]:.2f}',
                f'{of["random runs"]}',
                largest,
                f'{of["above the certified bound"]}',
                f'{ratios["least"]:.3f} to {ratios["largest"]:.3f}',
                f'{len(loops)}',
                f'{1e3 * max(errors, default=np.nan):.2f}',
                f'{stops}',
            ]
        )
    return aligned(rows)


def draw(
    motions: dict[str, Motions], found: dict[str, dict[str, Any]], path: Path
) -> None:
    """Draw how the errors are distributed below the bounds."""
    title = 'Error at the tool, and what is certified'
    picture = Picture(1, len(motions), title, (4.6, 3.8), share_time=False)
    for axes, (arm, of) in zip(picture.axes[0], motions.items(), strict=True):
        everywhere = 1e3 * found[arm]['certified']
        bins = np.linspace(0.0, 1.05 * everywhere, 60).tolist()
        for values, colour, label in (
            (of.largest, BLUE, 'largest of a random run'),
            (of.corner, ORANGE, 'worst corner at a posture'),
        ):
            axes.hist(1e3 * values, bins, histtype='step', color=colour, label=label)
        for number, each in enumerate(found[arm].get('closed loops', [])):
            label = '' if number else 'closed loops'
            axes.axvline(1e3 * each['error'], color=MUTED, linewidth=1.0, label=label)
        axes.axvline(everywhere, color=INK, linestyle='--', label='certified')
        axes.set_xlabel('mm')
        axes.set_ylabel('runs')
        axes.set_ylim(top=1.5 * axes.get_ylim()[1])  # room for the legend
        axes.legend(fontsize=7, loc='upper left')
        head(axes, arm, legend_at=0.0)
    picture.save(path)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_configs(parser, 'panda_rigid', 'ur5e_rigid', 'fr3')
    about = 'bound at the tool [m] (0.005)'
    parser.add_argument('--bound', type=float, default=0.005, help=about)
    add_runs(parser, 10_000, 'random motions')
    about = 'closed loops of each arm (5)'
    parser.add_argument('--truths', type=positive, default=5, help=about)
    add_out(parser, 'tool')


def main(options: argparse.Namespace) -> None:
    """Try a bound at the tool, write tool.json and tool.png, and print the table."""
    with announced_compilation(print_notice):
        configs = configured(options.config, options.bound)
        folder = make_folder(options.out)
        found = compare(folder, configs, options.bound, options.runs, options.truths)
    print(format_figures(found))
    print(f'wrote {options.out}: tool.json, tool.png')

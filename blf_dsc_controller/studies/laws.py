# SPDX-License-Identifier: Apache-2.0
"""Comparison of laws on arms from URDFs: tuning, validation and figures.

A law is one of the package, by its name, or one of a file (doc/tutorial_law.md), as
computed torque is here (`computed_torque.py`).  All run in the same loop.  `load_laws`
adds those that a file names.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.analysis.output import aligned, write_json
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import LoopConfig, load_loop
from blf_dsc_controller.configuration.plant import pick_ups
from blf_dsc_controller.configuration.schema import change, suggestion
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.factory.gains import law_gains
from blf_dsc_controller.factory.inertia import joint_inertia
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.progress import steps
from blf_dsc_controller.run import Floats
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.studies.monte_carlo import (
    UNSEEN,
    another_motion,
    torque_error,
    torque_rows,
)
from blf_dsc_controller.studies.runs import cores
from blf_dsc_controller.studies.tuning import (
    Gain,
    bounded,
    parameters_at,
    search,
    value_at,
)

PICK_UP = 15.0  # s
DURATION = 30.0  # s
INTERVALS = {
    'first 3 s': (0.0, 3.0),
    '8 to 15 s': (8.0, PICK_UP),
    'pick-up': (PICK_UP, 17.0),
    'from 20 s': (20.0, DURATION),
}
POPULATION = 16
GENERATIONS = 7  # of tuning, after the first
TRUTHS = 5  # on which a tuned law runs
ROUGHEST = 0.05
"""Largest rms change of a torque per sample, relative to its limit, unpenalised."""

COLUMNS = (*INTERVALS, 'model before', 'model after')
"""Largest errors [mrad]; model errors [%] before the pick-up and at the end."""
_BEFORE = PICK_UP - 0.01  # s, when the model is evaluated for the first time


class StudiedLaw(NamedTuple):
    """A law and its tuned gains; without any, all gains follow from the URDF."""

    label: str
    gains: tuple[Gain, ...] = ()
    law: str = 'blf_dsc'
    """The parameter `law`: a law of the package by its name, or a Python file."""
    learns: bool = True


COMPUTED_TORQUE = str(Path(__file__).with_name('computed_torque.py'))
"""Computed torque with an integrator, as a law of a file."""


_FEEDBACK = (
    Gain('feedback.joint_stiffness', 100.0, 1e4, inertial=True),
    Gain('feedback.joint_damping', 10.0, 200.0, inertial=True),
    Gain('disturbance.gain', 100.0, 3e4, inertial=True),
)
_SLOTINE_LI = (
    *_FEEDBACK[1:],
    Gain('gains.surface_gain', 5.0, 300.0),
    Gain('gains.adaptation_gain', 0.01, 30.0),
)
_PID = (
    Gain('gains.position', 100.0, 3e4),
    Gain('gains.velocity', 10.0, 200.0),
    Gain('gains.integral', 100.0, 3e6),
)

LAWS = {
    'proposed': StudiedLaw('proposed, gains from the URDF'),
    'no_learning': StudiedLaw('the same without learning', learns=False),
    'slotine_li': StudiedLaw(
        'Slotine-Li with integrator, the same gains', law='slotine_li'
    ),
    'computed_torque': StudiedLaw(
        'computed torque with integrator, the same gains', law=COMPUTED_TORQUE
    ),
    'proposed_tuned': StudiedLaw('proposed, tuned', _FEEDBACK),
    'no_learning_tuned': StudiedLaw('without learning, tuned', _FEEDBACK, learns=False),
    'slotine_li_tuned': StudiedLaw(
        'Slotine-Li with integrator, tuned', _SLOTINE_LI, 'slotine_li'
    ),
    'computed_torque_tuned': StudiedLaw(
        'computed torque with integrator, tuned', _PID, COMPUTED_TORQUE
    ),
}


@dataclass(frozen=True)
class Figures:
    """Figures of one run: largest true errors in INTERVALS, torque, model."""

    errors: tuple[float, ...]  # rad
    ratio: float  # largest error of the whole run, relative to the bound
    roughness: float  # of the function of this name
    # torque error on another motion: before the pick-up, at the end
    model: tuple[float, ...]


def law_changes(
    studied: StudiedLaw, config: ControllerConfig, values: Mapping[str, float]
) -> dict[str, object]:
    """Return the parameters for this law with these gains."""
    changes: dict[str, object] = {'law': studied.law}
    if studied.law != 'blf_dsc':  # which alone has a load observer
        changes['disturbance.observer_bandwidth'] = 0.0
    if studied.gains in (_FEEDBACK, _SLOTINE_LI):  # those of joints
        changes['feedback.inertia'] = 'none'
    config = change(config, changes)  # a law of a file has gains of its own
    if studied.law == 'slotine_li':  # the slope of the proposed law's surface at zero
        gains = law_gains(config)
        slope = np.array(gains.surface) / 2.0 + gains.mu
        changes['gains.surface_gain'] = float(slope.mean())
    elif studied.law == COMPUTED_TORQUE:  # of equal bandwidth
        position, velocity, integral = linear_gains(config).mean(axis=1).tolist()
        changes['gains.position'] = position
        changes['gains.velocity'] = velocity
        changes['gains.integral'] = integral
    elif not studied.learns:
        changes['learning.enabled'] = False
    tuned = studied.gains
    each = (values[gain.name] for gain in tuned)
    inertia = inertia_of_joints(config) if tuned else 1.0
    if tuned is _SLOTINE_LI:  # which has none, but the two are given together
        changes['feedback.joint_stiffness'] = np.asarray(inertia).tolist()
    return changes | parameters_at(config, tuned, each, inertia)


def inertia_of_joints(config: ControllerConfig) -> np.ndarray:
    """Return m (n,) [kg m^2]: the least inertia of a joint with the others free."""
    return joint_inertia(config, law_gains(config).initial_estimate)


def linear_gains(config: ControllerConfig) -> np.ndarray:
    """Return k_p [1/s^2], k_d [1/s], k_i [1/s^3] (3, n) of the proposed law.

    With r = K/2 + mu, tau = M0 (qr'' - k_p e - k_d e' - k_i int e) has

        k_p = omega_v r + (w + gamma) / m,   k_d = omega_v + r,   k_i = gamma r / m
    """
    m = inertia_of_joints(config)
    gains = law_gains(config)
    damping = gains.damping_rate + np.array(gains.feedback) / m
    slope = 0.5 * np.array(gains.surface) + gains.mu
    weight = np.array(gains.weight) / m
    integral = np.array(config.disturbance.gain) / m
    position = damping * slope + weight + integral
    return np.stack((position, damping + slope, integral * slope))


def run(
    name: str, loop: LoopConfig, values: Mapping[str, float], unseen: Floats
) -> Figures:
    """Run a law with `values` of its gains by name.

    `unseen` (k, p) are the rows of H on which the learned model is evaluated.
    """
    config = change(loop.controller, law_changes(LAWS[name], loop.controller, values))
    with np.errstate(all='ignore'):  # a run that diverges has figures too
        record = simulate(config, loop.plant, supervised=False)
        samples = sample_columns(record.samples, record.controller.settings)
        errors = record.true_errors()
        p = unseen.shape[1]
        model = tuple(
            torque_error(unseen, samples.estimate[row, :p], record.truths[row, :p])
            for row in (round(_BEFORE / config.sample_time), -1)
        )
        time = np.arange(len(errors)) * loop.plant.sample_time
        peaks = [
            float(np.abs(errors[(time >= begin) & (time < end)]).max(initial=0.0))
            for begin, end in INTERVALS.values()
        ]
        rough = roughness(samples.torque, config)
    ratio = np.abs(errors / config.barrier.bound).max()
    return Figures(tuple(peaks), float(ratio), rough, model)


def roughness(torque: Floats, config: ControllerConfig) -> float:
    """Return the largest rms change of torques (k, n) from sample to sample, of the limit."""
    steps = np.diff(torque, axis=0) / config.torque.limit
    return float(np.sqrt(np.mean(steps**2, axis=0)).max())


def load_laws(path: Path) -> list[str]:
    """Add the laws of a Python file, by name in its `LAWS`, and return their names.

    Raises BlfDscError if it has none, if it cannot be imported, or if a name is taken.
    """
    sys.path.insert(0, str(path.parent))
    try:
        module = importlib.import_module(path.stem)
    except Exception as error:
        reason = repr(error)
        if isinstance(error, SyntaxError):
            reason = f'line {error.lineno}: {error.msg}'
        raise BlfDscError(f'{path} cannot be imported: {reason}') from error
    finally:
        sys.path.remove(str(path.parent))
    if getattr(module, '__file__', '') != str(path):
        raise BlfDscError(
            f'{path}: there is another module of this name: rename the file'
        )
    added: dict[str, StudiedLaw] = getattr(module, 'LAWS', {})
    if not added or not all(isinstance(each, StudiedLaw) for each in added.values()):
        raise BlfDscError(
            f'{path}: LAWS must be a dict of StudiedLaw by name. For the law of a file, write a '
            "second one with LAWS = {'mine': StudiedLaw('my law', (), 'my_law.py')}, as in "
            'doc/tutorial_law.md'
        )
    for gain in (gain for law in added.values() for gain in law.gains):
        if not 0.0 < gain.least < gain.most:
            raise BlfDscError(
                f'{path}: got Gain({gain.name!r}, {gain.least:g}, {gain.most:g}), but its range '
                'must be above 0, the smaller end first'
            )
    for name, law in added.items():
        if LAWS.setdefault(name, law) is not law:
            raise BlfDscError(
                f'{path}: the study has a law {name} already: choose another name'
            )
    return list(added)


@dataclass(frozen=True)
class Result:
    """A law on one arm: tuned gains and cost (or None), validation runs."""

    gains: dict[str, float]
    cost: float | None
    runs: list[Figures]

    def columns(self) -> Floats:
        """Return the values of all runs for each of COLUMNS, in mrad or %."""
        rows = [(*figures.errors, *figures.model) for figures in self.runs]
        units = np.where(np.arange(len(COLUMNS)) < len(INTERVALS), 1e3, 1e2)
        return np.asarray((np.array(rows) * units).T)


def load_of(loop: LoopConfig) -> float:
    """Return what the arm picks up [kg]: the largest load of its file, or the rated one."""
    return max(loop.plant.events.payload, default=0.0) or loop.controller.robot.payload


def trial(
    name: str, seed: int, overrides: Mapping[str, Mapping[str, Any]] | None = None
) -> LoopConfig:
    """Return the loop of a preset, with truth and motion varied by the seed.

    `overrides` are those of `load_loop`.

    Raises BlfDscError if it has no arm of a URDF that follows sinusoids.
    """
    loop = load_loop(name, overrides)
    reference = loop.controller.reference
    if loop.controller.model != 'urdf' or reference.type != 'sinusoids':
        raise BlfDscError(
            f'--config {name}: got model {loop.controller.model} and reference {reference.type}, '
            'but an arm of a URDF that follows sinusoids is needed, as in config/panda.yaml'
        )
    plant = {
        'duration': DURATION,
        'seed': seed,
        'truth.seed': loop.plant.truth.seed + seed,
    } | pick_ups([PICK_UP], [load_of(loop)])
    law = another_motion(loop.controller, seed) if seed > 0 else loop.controller
    return loop._replace(controller=law, plant=change(loop.plant, plant))


def values_of(name: str, exponents: Floats) -> dict[str, float]:
    """Return the gains of a law from their decimal logarithms."""
    pairs = zip(LAWS[name].gains, exponents, strict=True)
    return {gain.name: value_at(exponent) for gain, exponent in pairs}


def cost_of(figures: Figures) -> float:
    """Return the mean over the intervals of log10 of the largest error in mrad.

    Each decade of torque roughness beyond ROUGHEST adds ten.
    """
    rough = max(np.log10(figures.roughness / ROUGHEST), 0.0)
    return bounded(np.mean(np.log10(1e3 * np.array(figures.errors))) + 10.0 * rough)


def tuning_cost(
    exponents: Floats, name: str, loop: LoopConfig, unseen: Floats
) -> float:
    """Return `cost_of` a law with one more sample of delay, for stability."""
    delayed = change(loop.plant, {'actuator.delay': loop.plant.actuator.delay + 1})
    values = values_of(name, exponents)
    return cost_of(run(name, loop._replace(plant=delayed), values, unseen))


def chosen_laws(given: Sequence[str]) -> list[str]:
    """Return names of laws from names and Python files, `proposed` first.

    Raises BlfDscError if there is no such law or file.
    """
    if not given:
        return list(LAWS)
    names = ['proposed']
    for name in given:
        if name not in LAWS and not Path(name).is_file():
            raise BlfDscError(
                f'--laws {name}: there is no such law or file{suggestion(name, LAWS)}; '
                f'expected a law of the study ({", ".join(LAWS)}), or a Python file with LAWS'
            )
        names += [name] if name in LAWS else load_laws(Path(name).resolve())
    return list(dict.fromkeys(names))


def compare(
    folder: Path, arms: Sequence[str], laws: Sequence[str]
) -> dict[str, dict[str, Result]]:
    """Tune and run everything, write figures.json, and return the results.

    `laws` are as in `chosen_laws`.
    """
    names = chosen_laws(laws)
    results: dict[str, dict[str, Result]] = {arm: {} for arm in arms}
    rows = [(arm, name) for arm in arms for name in names]
    with ProcessPoolExecutor(
        cores(), initializer=chosen_laws, initargs=(laws,)
    ) as pool:
        begun = f'tuning and running {len(rows)} laws: some minutes for each'
        for arm, name in steps(rows, len(rows), 'law', begun):
            results[arm][name] = _tuned_and_run(arm, name, pool)
    write_json(results, folder / 'figures.json')
    return results


def _tuned_and_run(arm: str, name: str, pool: ProcessPoolExecutor) -> Result:
    """Tune a law on an arm's first draw, and run it on the others."""
    first, *others = (trial(arm, seed) for seed in range(TRUTHS + 1))
    unseen = torque_rows(trial(arm, UNSEEN).controller)
    searched = LAWS[name].gains
    least = {gain.name: gain.least for gain in searched}
    run(name, first, least, unseen)  # compiles what the workers load
    gains, cost = {}, None
    if searched:
        of_gains = partial(tuning_cost, name=name, loop=first, unseen=unseen)
        options = {'workers': pool.map, 'updating': 'deferred'}
        found = search(of_gains, searched, POPULATION, GENERATIONS, **options)
        gains = values_of(name, found.x)
        cost = float(found.fun)
    runs = pool.map(partial(run, name, values=gains, unseen=unseen), others)
    return Result(gains, cost, list(runs))


def format_results(results: dict[str, Result]) -> str:
    """Return the worst figures on an arm, a line for each law, and tuned gains."""
    rows = [['worst', *COLUMNS, 'roughness', 'bound kept']]
    gains = []
    for name, result in results.items():
        label = LAWS[name].label
        worst = result.columns().max(axis=1)
        rough = 100.0 * np.max([figures.roughness for figures in result.runs])
        kept = sum(figures.ratio < 1.0 for figures in result.runs)
        cells = ['-' if np.isnan(value) else f'{value:.2f}' for value in worst]
        cells.append('-' if np.isnan(rough) else f'{rough:.1f} %')
        rows.append([label, *cells, f'{kept} of {len(result.runs)}'])
        if result.gains:
            each = ', '.join(
                f'{gain} {value:g}' for gain, value in result.gains.items()
            )
            gains.append(f'{label}: {each}')
    return '\n'.join([aligned(rows), *gains])

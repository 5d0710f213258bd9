# SPDX-License-Identifier: Apache-2.0
"""A study: a closed loop, the parameters that vary, and the run of each index.

Its file is a parameter file of the loop with one additional section:

    monte_carlo:
      ros__parameters:
        base: payload  # a preset or file that this one changes; none: the defaults
        runs: 10000
        vary:
          arm.m2: uniform(0.4, 0.6)
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, LoopConfig
from blf_dsc_controller.configuration.params_file import dump, format_value, load_loop, read
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build, change, flatten, parameter
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.monte_carlo.variations import Value, Variation, read_variations

WITHOUT = 'without.'
"""Prefix of the columns of a run without learning."""

_NODE = 'monte_carlo'
_VARY = 'vary.'
_ONE_STUDY = 'a study has one configuration from its first run to its last'


@dataclass(frozen=True)
class MonteCarloConfig:
    """Section `monte_carlo` of a study file: number of runs, and what is measured in each."""

    runs: int = parameter(
        1000, 'closed loops to run', at_least=1, at_most=100_000_000, read_only=_ONE_STUDY
    )
    seed: int = parameter(
        0, 'run i is determined by this seed and i alone', at_least=0, read_only=_ONE_STUDY
    )
    pairs: bool = parameter(
        default=False,
        description='run each plant with learning and without it (learning.weight: 0)',
        read_only=_ONE_STUDY,
    )
    settled_after: float = parameter(
        0.0,
        'time from which the rms and the largest settled error are computed, and pairs compared',
        unit='s',
        at_least=0.0,
        read_only=_ONE_STUDY,
    )
    moments: tuple[float, ...] = parameter(
        (),
        'times at which the parameter error is stored, besides the end',
        unit='s',
        at_least=0.0,
        may_be_empty=True,
        read_only=_ONE_STUDY,
    )

    def duration_problems(self, duration: float) -> list[str]:
        """Return the problems with times after the end of a run of this duration [s]."""
        if duration == 0.0:
            return ['sim_plant.duration: got 0 s, but every run must end: give its duration']
        problems = [
            f'moments: got {moment:g} s at entry {entry}, but a run ends at {duration:g} s'
            for entry, moment in enumerate(self.moments, 1)
            if moment > duration
        ]
        if self.settled_after >= duration:
            problems.append(
                f'settled_after: got {self.settled_after:g} s, but a run ends at {duration:g} s'
            )
        repeated = sorted({moment for moment in self.moments if self.moments.count(moment) > 1})
        return problems + [f'moments: {moment:g} s is repeated' for moment in repeated]


@dataclass(frozen=True)
class Study:
    """Everything that determines the results."""

    controller: ControllerConfig
    plant: PlantConfig
    settings: MonteCarloConfig
    variations: tuple[Variation, ...]

    def laws(self) -> dict[str, ControllerConfig]:
        """Return each law of a run by the prefix of its columns."""
        if not self.settings.pairs:
            return {'': self.controller}
        return {'': self.controller, WITHOUT: change(self.controller, {'learning.weight': 0.0})}

    def by_node(self) -> dict[str, Any]:
        """Return the configurations by node name."""
        return {PLANT: self.plant, CONTROLLER: self.controller, _NODE: self.settings}

    def flat(self) -> dict[str, object]:
        """Return every value by node and name, with the distributions as written."""
        values: dict[str, object] = {
            f'{node}.{name}': value
            for node, config in self.by_node().items()
            for name, value in flatten(config).items()
        }
        return values | {f'{_NODE}.{_VARY}{name}': text for name, text in self.varied().items()}

    def varied(self) -> dict[str, str | tuple[str, ...]]:
        """Return the distributions as written, in a list for each list parameter."""
        texts: dict[str, str | tuple[str, ...]] = {}
        for one in self.variations:
            text = str(one.distribution)
            texts[one.name] = text if one.entry < 0 else (*texts.get(one.name, ()), text)
        return texts


def load_study(path: str | Path, overrides: Mapping[str, object] | None = None) -> Study:
    """Read a study; `overrides` of the section `monte_carlo` take precedence over the file.

    Raises ConfigurationError with all problems of all sections, and their lines.
    """
    problems: list[str] = []
    loop: LoopConfig | None = None
    settings: MonteCarloConfig | None = None
    try:
        loop = load_loop(path)
    except ConfigurationError as error:
        problems += error.problems
    given, lines = _read_section(path)
    varied = {name.removeprefix(_VARY): given[name] for name in given if name.startswith(_VARY)}
    others = {name: given[name] for name in given if not name.startswith(_VARY)}
    own: list[str] = []
    try:
        settings = build(MonteCarloConfig, {**others, **(overrides or {})})
    except ConfigurationError as error:
        own += error.problems
    if loop is None:  # the number of events is unknown
        varied = {name: one for name, one in varied.items() if not name.startswith('events.')}
    variations, found = read_variations(varied, loop.plant if loop else PlantConfig())
    own += [f'{_VARY}{problem}' for problem in found]
    if loop and settings:
        own += settings.duration_problems(loop.plant.duration)
    for problem in own:
        name = problem.split(':', 1)[0]
        where = f'line {lines[name]}: ' if name in lines else ''
        problems.append(f'{_NODE}: {where}{problem}')
    if loop and loop.plant.joints != loop.controller.joints:
        problems.append(f'joints: {PLANT} and {CONTROLLER} have them in different orders')
    if problems or loop is None or settings is None:
        raise ConfigurationError(problems, str(path))
    return Study(loop.controller, loop.plant, settings, variations)


def write_study(study: Study, path: Path) -> None:
    """Write a study so that `load_study` returns the same one."""
    dump(path, study.by_node())
    with path.open('a', encoding='utf-8') as file:
        file.writelines(
            f'    {_VARY}{name}: {format_value(text)}\n' for name, text in study.varied().items()
        )


def _read_section(path: str | Path) -> tuple[dict[str, Any], dict[str, int]]:
    """Return values and lines of the section `monte_carlo`, by name."""
    entries = {
        name: entry
        for section in read(path)
        if section.matches(f'/{_NODE}') and not section.is_wildcard
        for name, entry in section.entries.items()
    }
    if not entries:
        problem = (
            f'there is no section {_NODE}, which sets the number of runs and what varies: '
            'see the preset monte_carlo'
        )
        raise ConfigurationError([problem], str(path))
    lines = {name: entry.line for name, entry in entries.items()}
    return {name: entry.value for name, entry in entries.items()}, lines


class Origin(NamedTuple):
    """Reference and bound at time 0, to which a start is relative."""

    qr: np.ndarray  # (n,) rad
    dqr: np.ndarray  # (n,) rad/s
    bound: np.ndarray  # (n,) rad


class Draw(NamedTuple):
    """The random numbers of one run."""

    run: int
    seed: int  # of the sensor noise
    values: tuple[Value, ...]  # of the variations, in their order


def draw(study: Study, index: int) -> Draw:
    """Draw run `index` from the seed of the study and the index alone.

    Each variation has its own random number, by its name and regardless of what else varies: two
    studies with the same seed that differ in one distribution have otherwise the same arms.
    """

    def bits(name: str) -> int:
        text = f'{study.settings.seed} {index} {name}'
        return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), 'big') >> 11

    values = tuple(one.distribution.at(bits(one.column) / 2**53) for one in study.variations)
    return Draw(index, bits('seed'), values)


def origin_of(controller: Controller) -> Origin:
    """Return the origin of a controller that has not begun."""
    qr, dqr, _ = controller.reference_at(0.0)
    return Origin(qr, dqr, controller.bound_at(0.0))


def plant_of_draw(study: Study, drawn: Draw, origin: Origin) -> PlantConfig:
    """Return the plant configuration of a run; `origin` is that of the study's controller."""
    changes: dict[str, dict[str, Any]] = {}
    for one, value in zip(study.variations, drawn.values, strict=True):
        group, _, field = one.name.partition('.')
        section = changes.setdefault(group, {})
        section[field] = value if one.entry < 0 else (*section.get(field, ()), value)
    relative = changes.pop('initial', {})
    start: dict[str, Any] = {}
    if 'error' in relative:
        start['position'] = tuple((origin.qr + origin.bound * relative['error']).tolist())
    if 'velocity_error' in relative:
        start['velocity'] = tuple((origin.dqr + relative['velocity_error']).tolist())
    if 'gap' in changes.get('events', {}):
        changes['events']['begin'] = tuple(np.cumsum(changes['events'].pop('gap')).tolist())
    groups = {
        group: dataclasses.replace(getattr(study.plant, group), **section)
        for group, section in (changes | {'initial': start}).items()
    }
    return dataclasses.replace(study.plant, seed=drawn.seed, **groups)

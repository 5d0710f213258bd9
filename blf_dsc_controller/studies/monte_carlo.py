# SPDX-License-Identifier: Apache-2.0
"""A Monte Carlo study: closed loop, distributions of its parameters, runs.

Its file is a parameter file of the loop with one additional section:

    monte_carlo:
      ros__parameters:
        base: payload  # a preset or file that this one changes; none: the defaults
        runs: 10000
        vary:
          arm.m2: uniform(0.4, 0.6)

The start is relative to the reference: `initial.error` is the tracking error xi1(0) as
a fraction of the bound, `initial.velocity_error` is dq(0) - dqr(0). So may be the
events: `events.gap` is the time from the beginning of the event before, or from the
start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any, cast

import numpy as np

from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.files import Entry
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    LoopConfig,
    load_loop,
    locate,
    read,
)
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import Value as Setting
from blf_dsc_controller.configuration.schema import (
    build,
    change,
    flatten,
    parameter,
)
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.factory.estimate import model_of
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.run import Floats
from blf_dsc_controller.studies.distributions import Drawn
from blf_dsc_controller.studies.variations import VARY, Variation, variations_of

WITHOUT = 'without.'
"""Prefix of the columns of a run without learning."""
NOISE = 'noise.'
"""Prefix of the columns of a run without learning and with other sensor noise."""

UNSEEN = 1000
"""Seed of the motion on which the torque of a learned model is evaluated."""

_ROWS = 200  # postures of that motion
_ROWS_FOR = 15.0  # s
_NODE = 'monte_carlo'


@dataclass(frozen=True)
class MonteCarloConfig:
    """Section `monte_carlo` of a study file."""

    runs: int = parameter(1000, 'closed loops to run', at_least=1, at_most=100_000_000)
    seed: int = parameter(0, 'run i is determined by this seed and i alone', at_least=0)
    pairs: bool = parameter(
        default=False,
        description='run each plant also without learning (learning.enabled: false), and once more '
        'so with other sensor noise',
    )
    settled_after: float = parameter(
        0.0,
        'time from which the rms and the largest settled error are computed, and pairs compared',
        unit='s',
        at_least=0.0,
    )


@dataclass(frozen=True)
class Study:
    """Everything that determines the results."""

    controller: ControllerConfig
    plant: PlantConfig
    settings: MonteCarloConfig
    variations: tuple[Variation, ...]

    def laws(self) -> dict[str, ControllerConfig]:
        """Return the law of each run of a plant, by the prefix of its columns."""
        if not self.settings.pairs:
            return {'': self.controller}
        without = change(self.controller, {'learning.enabled': False})
        return {'': self.controller, WITHOUT: without, NOISE: without}

    def values(self) -> dict[str, dict[str, Setting]]:
        """Return every value by node and name, with distributions as written."""
        own = flatten(self.settings)
        for variation in self.variations:
            name = f'{VARY}{variation.name}'
            text = str(variation.distribution)
            before = cast('tuple[str, ...]', own.get(name, ()))
            own[name] = text if variation.entry < 0 else (*before, text)
        return {
            PLANT: flatten(self.plant),
            CONTROLLER: flatten(self.controller),
            _NODE: own,
        }

    @cached_property
    def origin(self) -> tuple[Floats, Floats, Floats]:
        """Reference of a start: qr [rad], dqr [rad/s], bound [rad] at time 0."""
        controller = controller_of(self.controller)
        qr, dqr, _ = controller.reference_at(0.0)
        return qr, dqr, controller.bound_at(0.0)

    @cached_property
    def unseen(self) -> Floats | None:
        """Rows of H of a motion that is never run; None without sinusoids."""
        if self.controller.reference.type != 'sinusoids':
            return None
        return torque_rows(another_motion(self.controller, UNSEEN))


def another_motion(config: ControllerConfig, seed: int) -> ControllerConfig:
    """Return a configuration with other signs and phases of the sinusoids."""
    random = np.random.default_rng(seed)
    reference = config.reference
    signs = random.choice((-1.0, 1.0), len(reference.amplitude))
    motion = {
        'reference.amplitude': (signs * reference.amplitude).tolist(),
        'reference.phase': random.uniform(
            0.0, 2.0 * np.pi, len(reference.phase)
        ).tolist(),
    }
    return change(config, motion)


def torque_rows(config: ControllerConfig) -> Floats:
    """Return the rows of H(q, q', q', q'') (k, p) along the configured reference."""
    times = np.linspace(0.0, _ROWS_FOR, _ROWS)
    q, dq, ddq = np.moveaxis(sampled(reference_of(config), times), 1, 0)
    H = regressors_at(model_of(config), q, dq, dq, ddq)
    return H.reshape(-1, H.shape[2])


def torque_error(rows: Floats, estimate: Floats, P: Floats) -> float:
    """Return the relative torque error of a learned model on such rows."""
    return float(np.linalg.norm(rows @ (estimate - P)) / np.linalg.norm(rows @ P))


def load_study(
    path: str | Path,
    overrides: Mapping[str, object] | None = None,
    *,
    runs_law: bool = True,
) -> Study:
    """Read a study from a file or a preset's name.

    `overrides` take precedence over its section `monte_carlo`.

    Unless it `runs_law`, the law of a file is left out and not run.

    Raises ConfigurationError with all problems of all sections, and their lines.
    """
    path = locate(path)
    problems: list[str] = []  # of the loop
    loop: LoopConfig | None = None
    settings: MonteCarloConfig | None = None
    try:
        loop = load_loop(path, runs_law=runs_law)
    except ConfigurationError as error:
        problems += error.problems
    entries = _section(path)
    given = {name: entry.value for name, entry in entries.items()}
    varied = {name: given.pop(name) for name in entries if name.startswith(VARY)}
    if loop is None:  # the number of events is unknown
        varied = _without_events(varied)
    plant = loop.plant if loop else PlantConfig()
    variations, own = variations_of(varied, plant)  # problems of the section
    try:
        settings = build(MonteCarloConfig, {**given, **(overrides or {})})
    except ConfigurationError as error:
        own += error.problems
    if loop and settings:
        own += _problems_of_duration(loop.plant.duration, settings.settled_after)
    problems += [_located(problem, entries) for problem in own]
    if loop and loop.plant.joints != loop.controller.joints:
        problems.append(
            f'joints: {PLANT} and {CONTROLLER} have them in different orders'
        )
    if problems or loop is None or settings is None:
        raise ConfigurationError(problems, str(path))
    return Study(loop.controller, loop.plant, settings, variations)


def _without_events(varied: Mapping[str, object]) -> dict[str, object]:
    """Return the variations but those of events."""
    events = f'{VARY}events.'
    return {
        name: value for name, value in varied.items() if not name.startswith(events)
    }


def _problems_of_duration(duration: float, settled_after: float) -> Iterator[str]:
    """Yield why runs of a duration [s] have no settled error after a time [s]."""
    if duration == 0.0:
        yield 'sim_plant.duration: got 0 s, but every run must end: give its duration'
    elif settled_after >= duration:
        yield f'settled_after: got {settled_after:g} s, but a run ends at {duration:g} s'


def _located(problem: str, entries: Mapping[str, Entry]) -> str:
    """Return a problem of the section with the line of its parameter, if it has one."""
    name = problem.split(':', 1)[0]
    where = f'{entries[name].place}: ' if name in entries else ''
    return f'{_NODE}: {where}{problem}'


def _section(path: str | Path) -> dict[str, Entry]:
    """Return the section `monte_carlo`, by name."""
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
    return entries


def draw(study: Study, run: int) -> dict[str, Drawn]:
    """Return the random values of a run by column, from seed and number alone.

    Each variation has its own random number, by its name and regardless of what else
    varies: two studies with the same seed that differ in one distribution have
    otherwise the same arms.
    """

    def bits(name: str) -> int:
        text = f'{study.settings.seed} {run} {name}'
        return (
            int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), 'big') >> 11
        )

    drawn: dict[str, Drawn] = {'run': run, 'seed': bits('seed')}
    if study.settings.pairs:
        drawn[f'{NOISE}seed'] = bits('seed 1')
    for variation in study.variations:
        drawn[variation.column] = variation.distribution.at(
            bits(variation.column) / 2**53
        )
    return drawn


def plant_with(study: Study, drawn: Mapping[str, Drawn], law: str = '') -> PlantConfig:
    """Return the plant configuration of a run with the law of this prefix."""
    changes = _drawn_by_group(study, drawn)
    if 'initial' in changes:
        changes['initial'] = _start(study, changes['initial'])
    events = changes.get('events', {})
    if 'gap' in events:
        events['begin'] = tuple(np.cumsum(events.pop('gap')).tolist())
    groups = {
        group: replace(getattr(study.plant, group), **section)
        for group, section in changes.items()
    }
    seed = int(drawn.get(f'{law}seed', drawn['seed']))
    return replace(study.plant, seed=seed, **groups)


def _drawn_by_group(
    study: Study, drawn: Mapping[str, Drawn]
) -> dict[str, dict[str, Any]]:
    """Return the random values by group and field of the plant, lists as tuples."""
    changes: dict[str, dict[str, Any]] = {}
    for variation in study.variations:
        group, _, field = variation.name.partition('.')
        section = changes.setdefault(group, {})
        value = drawn[variation.column]
        is_list = variation.entry >= 0
        section[field] = (*section.get(field, ()), value) if is_list else value
    return changes


def _start(study: Study, relative: Mapping[str, Any]) -> dict[str, Any]:
    """Return position [rad] and velocity [rad/s] by errors from the reference's start."""
    qr, dqr, bound = study.origin
    start = {}
    if 'error' in relative:
        start['position'] = tuple((qr + bound * relative['error']).tolist())
    if 'velocity_error' in relative:
        start['velocity'] = tuple((dqr + relative['velocity_error']).tolist())
    return start

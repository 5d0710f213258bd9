# SPDX-License-Identifier: Apache-2.0
"""The file of a study: a parameter file of the loop with one section more, `monte_carlo`.

    monte_carlo:
      ros__parameters:
        runs: 10000
        vary:
          arm.m2: uniform(0.4, 0.6)

What varies are parameters of the plant: see `spread`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, LoopConfig
from blf_dsc_controller.configuration.params_file import dump, format_value, load_loop, read
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.monte_carlo.configuration import MonteCarloConfig
from blf_dsc_controller.monte_carlo.study import NODE, Study
from blf_dsc_controller.monte_carlo.variations import spreads

_VARY = 'vary.'


def load_study(path: str | Path, overrides: Mapping[str, object] | None = None) -> Study:
    """Read a study.

    Args:
        path: of the file.
        overrides: of the section `monte_carlo`, by name; they count more than the file.

    Raises:
        ConfigurationError: with all that is wrong in all sections, and the lines.
    """
    problems: list[str] = []
    loop: LoopConfig | None = None
    settings: MonteCarloConfig | None = None
    try:
        loop = load_loop(path)
    except ConfigurationError as error:
        problems += error.problems
    told, lines = _told(path)
    varied = {name.removeprefix(_VARY): told[name] for name in told if name.startswith(_VARY)}
    others = {name: told[name] for name in told if not name.startswith(_VARY)}
    try:
        settings = build(MonteCarloConfig, {**others, **(overrides or {})})
    except ConfigurationError as error:
        problems += [_placed(problem, lines) for problem in error.problems]
    joints = loop.plant.joints if loop else ('joint1', 'joint2')
    found, complaints = spreads(varied, joints)
    problems += [_placed(f'{_VARY}{complaint}', lines) for complaint in complaints]
    if loop and settings:
        complaints = settings.duration_problems(loop.plant.duration)
        problems += [_placed(complaint, lines) for complaint in complaints]
    if loop and loop.plant.joints != loop.controller.joints:
        problems.append(f'joints: {PLANT} and {CONTROLLER} have them in different orders')
    if problems or loop is None or settings is None:
        raise ConfigurationError(problems, str(path))
    return Study(loop.controller, loop.plant, settings, found)


def write_study(study: Study, path: Path) -> None:
    """Write a study so that `load_study` gives the same one."""
    nodes = {PLANT: study.plant, CONTROLLER: study.controller, NODE: study.settings}
    dump(path, nodes)
    with path.open('a', encoding='utf-8') as file:
        file.writelines(
            f'    {_VARY}{name}: {format_value(text)}\n' for name, text in study.varied().items()
        )


def _told(path: str | Path) -> tuple[dict[str, Any], dict[str, int]]:
    sections = [section for section in read(path) if section.matches(f'/{NODE}')]
    entries = {
        name: entry
        for section in sections
        if not section.is_wildcard
        for name, entry in section.entries.items()
    }
    if not entries:
        problem = (
            f'there is no section {NODE}, which says how many runs there are and what varies: '
            'see the preset monte_carlo'
        )
        raise ConfigurationError([problem], str(path))
    lines = {name: entry.line for name, entry in entries.items()}
    return {name: entry.value for name, entry in entries.items()}, lines


def _placed(problem: str, lines: Mapping[str, int]) -> str:
    name = problem.split(':', 1)[0]
    where = f'line {lines[name]}: ' if name in lines else ''
    return f'{NODE}: {where}{problem}'

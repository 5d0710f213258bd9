# SPDX-License-Identifier: Apache-2.0
"""Load and write the configurations of nodes as ROS 2 parameter files."""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    NODES,
    PLANT,
    RECORDER,
    LoopConfig,
    is_builtin,
    known_names,
)
from blf_dsc_controller.configuration.ros_yaml import Entry, Section, parse
from blf_dsc_controller.configuration.schema import build, flatten, parameters, unknown
from blf_dsc_controller.configuration.share import config_file
from blf_dsc_controller.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from blf_dsc_controller.configuration.schema import Value

Config = TypeVar('Config')


def locate(given: str | Path) -> Path:
    """Return the preset of this name, or the file of this path.

    A preset's name means the preset whatever lies in the current folder; `./name` means a file.
    Raises ConfigurationError, which lists the presets, where there is neither.
    """
    presets = sorted(preset.stem for preset in config_file('').glob('*.yaml'))
    path = Path(given)
    if str(given) in presets:
        return config_file(str(given))
    if path.is_file():
        return path
    if str(given).removesuffix('.yaml') in presets:
        return config_file(str(given))
    what = 'is a folder' if path.is_dir() else 'does not exist'
    problem = f'{given} {what}: give a parameter file, or a preset: {", ".join(presets)}'
    raise ConfigurationError([problem])


def read(path: str | Path) -> list[Section]:
    """Read the sections of a parameter file; ConfigurationError names the file and the line."""
    try:
        return parse(Path(path).read_text(encoding='utf-8'))
    except (UnicodeDecodeError, OSError) as error:
        raise ConfigurationError([str(error)], str(path)) from error
    except ConfigurationError as error:
        raise ConfigurationError(error.problems, str(path)) from error


def load(
    path: str | Path,
    node: str,
    cls: type[Config],
    overrides: Mapping[str, object] | None = None,
) -> Config:
    """Read what a file says to the node, whose name may carry a namespace (`/left/sim_plant`).

    `overrides`, by dotted name, count more than the file. Raises ConfigurationError with all
    problems and their lines. An unknown name in a section of that node is an error; in a section
    for several nodes it is one if no node of the package knows it.
    """
    sections = read(path)
    problems = list(_stray_names(sections))
    try:
        config = _load(sections, node, cls, overrides or {})
    except ConfigurationError as error:
        problems += error.problems
    if problems:
        raise ConfigurationError(problems, str(path))
    return config


def load_loop(
    path: str | Path, overrides: Mapping[str, Mapping[str, object]] | None = None
) -> LoopConfig:
    """Read what a file says to the plant, the controller and the recorder, all at once.

    `overrides`, by node and dotted name, count more than the file. Raises ConfigurationError with
    all problems of all nodes, and what plant and controller do not agree on.
    """
    sections = read(path)
    problems = [*_stray_names(sections), *_stray_sections(sections)]
    configs: dict[str, Any] = {}
    for node, cls in NODES.items():
        try:
            configs[node] = _load(sections, node, cls, (overrides or {}).get(node, {}))
        except ConfigurationError as error:
            problems += [f'{node}: {problem}' for problem in error.problems]
    if not problems:
        loop = LoopConfig(configs[PLANT], configs[CONTROLLER], configs[RECORDER])
        problems = loop.problems()
    if problems:
        raise ConfigurationError(problems, str(path))
    return loop


def _load(
    sections: list[Section], node: str, cls: type[Config], overrides: Mapping[str, object]
) -> Config:
    entries = _entries(sections, node, {one.name for one in parameters(cls)})
    values = {name: entry.value for name, entry in entries.items()}
    try:
        return build(cls, {**values, **overrides})
    except ConfigurationError as error:
        lines = {name: entry.line for name, entry in entries.items() if name not in overrides}
        raise ConfigurationError([_placed(problem, lines) for problem in error.problems]) from None


def _entries(sections: list[Section], node: str, known: set[str]) -> dict[str, Entry]:
    """Gather what speaks to the node; names for other nodes are left out of wildcard sections."""
    return {
        name: entry
        for section in sections
        if section.matches('/' + node.removeprefix('/'))
        for name, entry in section.entries.items()
        if name in known or not (section.is_wildcard or is_builtin(name))
    }


def _placed(problem: str, lines: Mapping[str, int]) -> str:
    """Add the line, which is known for a problem that begins with the name of a parameter."""
    name = problem.split(':', 1)[0]
    return f'line {lines[name]}: {problem}' if name in lines else problem


def _stray_names(sections: list[Section]) -> Iterator[str]:
    known = known_names()
    for section in sections:
        for name, entry in section.entries.items():
            if section.is_wildcard and name not in known and not is_builtin(name):
                yield f'line {entry.line}: {unknown(name, known)}'


def _stray_sections(sections: list[Section]) -> Iterator[str]:
    """Complain of a misspelt node, whose section would go unread without a word."""
    names = {section.pattern.rsplit('/', 1)[-1]: section for section in sections}
    absent = [node for node in NODES if node not in names]
    for name, section in names.items():
        close = difflib.get_close_matches(name, absent, n=1, cutoff=0.8)
        if close and name not in NODES:
            yield f'line {section.line}: no node is called {name}: did you mean {close[0]}?'


def dump(path: Path, configs: Mapping[str, object]) -> None:
    """Write every parameter of every node into the ROS 2 parameter file `path`.

    `configs` are configurations by the names of their nodes, which may carry a namespace.
    """
    path.write_text(dumps(configs), encoding='utf-8')


def dumps(configs: Mapping[str, object]) -> str:
    """Return what `dump` writes."""
    return dumps_values({node: flatten(config) for node, config in configs.items()})


def dumps_values(nodes: Mapping[str, Mapping[str, Value]]) -> str:
    """Return the parameter file of values by dotted name, for each node by its name."""
    return ''.join(_lines(nodes))


def format_value(value: Value) -> str:
    """Return a value as YAML that both ROS and YAML libraries read as the same type."""
    if isinstance(value, tuple):
        return '[' + ', '.join(format_value(entry) for entry in value) + ']'
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, float):
        return _number(value)
    return json.dumps(value, ensure_ascii=False)


def _number(value: float) -> str:
    """Keep a point in 1e-05, which is a text to many YAML libraries without it."""
    mantissa, exponent, power = repr(value).partition('e')
    return mantissa + ('' if '.' in mantissa or not exponent else '.0') + exponent + power


def _lines(nodes: Mapping[str, Mapping[str, Value]]) -> Iterator[str]:
    for node, values in nodes.items():
        yield f'/{node.removeprefix("/")}:\n  ros__parameters:\n'
        for name, value in values.items():
            yield f'    {name}: {format_value(value)}\n'

# SPDX-License-Identifier: Apache-2.0
"""The nodes by name: their configurations, files and presets."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from blf_dsc_controller.compiled.announcement import logged_compilation
from blf_dsc_controller.configuration import law_file, received, two_link
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.files import (
    Entry,
    Section,
    parse,
    read_text,
    share_folder,
)
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import (
    build,
    flatten,
    format_value,
    parameters,
    suggestion,
    unknown_names,
)
from blf_dsc_controller.configuration.side_nodes import (
    RecorderConfig,
    ViewConfig,
    WatchdogConfig,
)
from blf_dsc_controller.errors import ConfigurationError, check_type
from blf_dsc_controller.writing import write_text

PLANT = 'sim_plant'
CONTROLLER = 'blf_dsc_controller'
RECORDER = 'bag_recorder'
VIEW = 'view'
WATCHDOG = 'torque_watchdog'
DRIVE = 'drive'
STUDY = 'monte_carlo'
"""Name of the section of a study, which is no node."""

_SWITCHES_OF_ROS = ('use_sim_time', 'start_type_description_service')
_QOS = 'qos_overrides.'
_BASE = 'base'  # in a file: a preset or file that it changes
_ARM = 'robot.urdf'  # a file, which may be beside the one that names it
_PATH = 4096  # characters; longer ones are texts
Config = TypeVar('Config')


NODES: Mapping[str, Any] = {
    PLANT: PlantConfig,
    CONTROLLER: ControllerConfig,
    RECORDER: RecorderConfig,
    VIEW: ViewConfig,
    WATCHDOG: WatchdogConfig,
    DRIVE: DriveConfig,
}


class LoopConfig(NamedTuple):
    """The configurations of all nodes of a closed loop, as `load_loop` reads them."""

    plant: PlantConfig
    controller: ControllerConfig
    recorder: RecorderConfig

    @property
    def by_node(self) -> dict[str, PlantConfig | ControllerConfig | RecorderConfig]:
        """The configurations by node name."""
        return {PLANT: self.plant, CONTROLLER: self.controller, RECORDER: self.recorder}

    def problems(self) -> list[str]:
        """Check that plant and controller agree on sample time and joints."""
        plant, controller = self.plant, self.controller
        problems = []
        if plant.sample_time_ns != controller.sample_time_ns:
            problems.append(
                f'sample_time: {PLANT} has {plant.sample_time:g} s, but {CONTROLLER} has '
                f'{controller.sample_time:g} s: give it once, under /**'
            )
        if sorted(plant.joints) != sorted(controller.joints):
            problems.append(
                f'joints: {PLANT} has {", ".join(plant.joints)}, but {CONTROLLER} has '
                f'{", ".join(controller.joints)}: give them once, under /**'
            )
        return problems


def known_names() -> frozenset[str]:
    """Return the parameter names of all nodes of the package."""
    names = (param.name for cls in NODES.values() for param in parameters(cls))
    return two_link.NAMES.union(names)


def is_of_node(name: str, cls: type) -> bool:
    """Return whether a parameter in a section for several nodes is one of this node.

    The gains that only one law has are the controller's, whatever they are called, and so
    is the arm of two links.
    """
    if is_gain_of_law(name) or name in two_link.NAMES:
        return cls is ControllerConfig
    return name in {param.name for param in parameters(cls)}


def is_gain_of_law(name: str) -> bool:
    """Return whether the name is one of the gains that only one law has."""
    return name.startswith(f'{law_file.GROUP}.')


def is_builtin(name: str) -> bool:
    """Whether ROS itself, not this package, declares the parameter."""
    return name in _SWITCHES_OF_ROS or name.startswith(_QOS)


def locate(given: str | Path) -> Path:
    """Return the path of a preset by its name, or of a file by its path.

    A preset takes precedence over a file of the same name in the current folder;
    `./name` is the file. Raises ConfigurationError, which lists the presets, if neither
    exists.
    """
    remedy = 'give the name of a preset, or the path of a file'
    check_type('config', given, (str, Path), remedy)
    presets = {
        path.stem: path for path in sorted((share_folder() / 'config').glob('*.yaml'))
    }
    name, path = str(given), Path(os.path.expanduser(given))  # noqa: PTH111
    if path.is_file() and name not in presets:
        return path
    stem = name.removesuffix('.yaml')
    if stem in presets:
        return presets[stem]
    what = 'is a folder' if path.is_dir() else 'does not exist'
    if path.exists() and not path.is_dir():
        what = 'is no regular file'
    guess = suggestion(stem.removesuffix('.yml').lower(), presets)
    remedy = f'give a parameter file, or a preset: {", ".join(presets)}'
    raise ConfigurationError(
        [f'{name or "an empty name"} {what}{guess or ":"} {remedy}']
    )


def read(path: str | Path, based: tuple[Path, ...] = ()) -> Sequence[Section]:
    """Read the sections of a parameter file.

    ConfigurationError names the file and the line.

    Those of the preset or file that it names as `base`, under `/**` or `monte_carlo`, come
    first; `based` are the files that are based on it.
    """
    try:
        sections = _beside(parse(read_text(Path(path))), Path(path).parent)
        bases = [
            section.entries[_BASE].value for section in sections if _is_based(section)
        ]
        if not bases:
            return sections
        below = _based_on(str(bases[0]), Path(path).parent)
        above = (*based, Path(path).resolve())
    except OSError as error:
        raise ConfigurationError([str(error)], str(path)) from error
    except ConfigurationError as error:
        raise ConfigurationError(error.problems, str(path)) from error
    if below.resolve() in above:
        problem = f'base: {bases[0]!r} leads back to a file that is based on it'
        raise ConfigurationError([problem], str(path))
    below_it = (_of(below.name, each) for each in read(below, above))
    return [*below_it, *map(_without_base, sections)]


def _is_based(section: Section) -> bool:
    """Whether a section names what its file is based on."""
    may = section.is_wildcard or section.pattern.endswith(f'/{STUDY}')
    return may and _BASE in section.entries


def _without_base(section: Section) -> Section:
    if not _is_based(section):
        return section
    entries = {name: e for name, e in section.entries.items() if name != _BASE}
    return section._replace(entries=entries)


def _of(file: str, section: Section) -> Section:
    """Return a section whose entries know their file."""
    entries = {
        name: entry._replace(file=entry.file or file)
        for name, entry in section.entries.items()
    }
    return section._replace(entries=entries)


def with_base(
    given: Mapping[str, Any], node: str, cls: type, folder: Path
) -> dict[str, Any]:
    """Return the values that a node is given, with those of the `base` among them below.

    `node` is its full name; the base is a preset, or a file in the current folder or this one.
    """
    values = dict(given)
    base = values.pop(_BASE, None)
    if base is None:
        return values
    entries = _entries_of(read(_based_on(str(base), folder)), node, cls)
    return {name: entry.value for name, entry in entries.items()} | values


def _based_on(name: str, folder: Path) -> Path:
    """Return the path of a preset, or of a file in the current folder or in this one."""
    beside = folder / name
    return beside if beside.is_file() and not Path(name).is_file() else locate(name)


def _beside(sections: Sequence[Section], folder: Path) -> Sequence[Section]:
    """Return sections in which arms are found beside the file that names them.

    A file of the current folder takes precedence, one of `config/` does not.  Presets,
    which are in `config/` themselves, keep their names.
    """
    if folder.resolve() == (share_folder() / 'config').resolve():
        return sections
    return [section._replace(entries=_found(section, folder)) for section in sections]


def _found(section: Section, folder: Path) -> dict[str, Entry]:
    entry = section.entries.get(_ARM)
    if entry is None or not isinstance(entry.value, str) or len(entry.value) > _PATH:
        return section.entries
    with suppress(OSError, ValueError):  # no path
        beside = folder / entry.value
        if beside.is_file() and not Path(entry.value).expanduser().is_file():
            return section.entries | {_ARM: entry._replace(value=str(beside))}
    return section.entries


def load(
    path: str | Path,
    node: str,
    cls: type[Config],
    overrides: Mapping[str, object] | None = None,
    *,
    runs_law: bool = True,
) -> Config:
    """Load the configuration of one node.

    Its name may have a namespace (`/left/sim_plant`).

    `overrides`, by dotted name, take precedence over the file. Raises
    ConfigurationError with all problems and their line numbers. Unknown names are
    rejected; in a section for several nodes, a name that any node of the package knows
    is accepted. Unless it `runs_law`, the law of a file is left out and not run.
    """
    chosen = {node: overrides or {}}
    config: Config = _load_all(path, {node: cls}, chosen, runs_law=runs_law)[node]
    return config


@logged_compilation()
def load_loop(
    given: str | Path,
    overrides: Mapping[str, Mapping[str, object]] | None = None,
    *,
    runs_law: bool = True,
) -> LoopConfig:
    """Load plant, controller and recorder from a preset or a file.

    `overrides`, by node and dotted name, take precedence over the file; None removes
    what the file gives. Unless it `runs_law`, the law of a file is left out and not
    run. Raises ConfigurationError with the problems of all nodes, or if plant and
    controller disagree.
    """
    path = locate(given)
    _check_overrides(overrides or {})
    configs = _load_all(path, NODES, overrides or {}, runs_law=runs_law)
    loop = LoopConfig(configs[PLANT], configs[CONTROLLER], configs[RECORDER])
    if problems := loop.problems():
        raise ConfigurationError(problems, str(path))
    return loop


def _check_overrides(overrides: Mapping[str, Any]) -> None:
    """Raise ConfigurationError if overrides are not those of nodes by name."""
    expected = (
        f"give them by node and name, such as {{'{PLANT}': {{'duration': 10.0}}}}"
    )
    check_type('overrides', overrides, Mapping, expected)
    problems = [
        f'{name}: no node has this name{suggestion(name, NODES)}; {expected}'
        for name in overrides
        if name not in NODES
    ]
    problems += [
        f'{name}: got {values!r} instead of overrides; {expected}'
        for name, values in overrides.items()
        if name in NODES and not isinstance(values, Mapping)
    ]
    if problems:
        raise ConfigurationError(problems)


def _load_all(
    path: str | Path,
    nodes: Mapping[str, Any],
    overrides: Mapping[str, Mapping[str, object]],
    *,
    runs_law: bool,
) -> dict[str, Any]:
    """Load the configurations of some nodes; a problem of several is reported once."""
    sections = read(path)
    problems = [
        *_unknown_in_wildcards(sections),
        *unmatched_sections(sections, nodes),
        *_wrong_for_ros(sections, nodes),
    ]
    configs: dict[str, Any] = {}
    nodes_with: dict[str, list[str]] = {}
    for node, cls in nodes.items():
        entries = _entries_of(sections, node, cls)
        written = {name: entry.value for name, entry in entries.items()}
        chosen = overrides.get(node, {})
        given: dict[str, object] = {**written, **chosen}
        values = {name: value for name, value in given.items() if value is not None}
        if not runs_law:
            values = received.without_law(values)
        try:
            configs[node] = build(cls, values)
        except ConfigurationError as error:
            for problem in error.problems:
                located = _located(problem, entries, chosen)
                nodes_with.setdefault(located, []).append(node)
    for problem, names in nodes_with.items():
        problems.append(f'{", ".join(names)}: {problem}' if len(nodes) > 1 else problem)
    if problems:
        raise ConfigurationError(problems, str(path))
    return configs


def _unknown_in_wildcards(sections: Iterable[Section]) -> Iterator[str]:
    """Yield a problem for each name that no node has, in sections for several nodes."""
    known = known_names()
    for section in sections:
        if not section.is_wildcard:
            continue
        given = {
            name: entry.value
            for name, entry in section.entries.items()
            if not (is_builtin(name) or is_gain_of_law(name))
        }
        for problem in unknown_names(given, known):
            yield _located(problem, section.entries, {})


def _wrong_for_ros(sections: Iterable[Section], nodes: Iterable[str]) -> Iterator[str]:
    """Yield a problem for each switch of ROS itself that is neither true nor false.

    None of these nodes would start with it.
    """
    full = [_full(node) for node in nodes]
    for section in sections:
        if not any(map(section.matches, full)):
            continue
        for name in _SWITCHES_OF_ROS:
            entry = section.entries.get(name)
            if entry is not None and not isinstance(entry.value, bool):
                yield (
                    f'{entry.place}: {name}: got {format_value(entry.value)}, but a bool is '
                    f'expected: write true or false, without quotes'
                )


def _entries_of(sections: Iterable[Section], node: str, cls: type) -> dict[str, Entry]:
    """Return the entries for a node, without those of other nodes and of ROS."""
    return {
        name: entry
        for section in sections
        if section.matches(_full(node))
        for name, entry in section.entries.items()
        if not section.is_wildcard or is_of_node(name, cls)
        if not is_builtin(name)
    }


def _located(
    problem: str, entries: Mapping[str, Entry], chosen: Mapping[str, object]
) -> str:
    """Return a problem of a parameter with where its value comes from."""
    name = problem.split(':', 1)[0]
    if name in chosen:
        return f'{problem} (given as an override)'
    if name in entries:
        return f'{entries[name].place}: {problem}'
    return problem


def dump(path: Path, nodes: Mapping[str, object], comment: str = '') -> None:
    """Write all parameters of the nodes to a parameter file; loading it restores them exactly.

    `nodes` are configurations, or values by dotted name, by node name with or without a
    namespace.
    """
    lines = [comment]
    for node, config in nodes.items():
        lines.append(f'{_full(node)}:\n  ros__parameters:\n')
        values = config if isinstance(config, Mapping) else flatten(config)
        lines += [
            f'    {name}: {format_value(value)}\n' for name, value in values.items()
        ]
    write_text(path, ''.join(lines))


def unmatched_sections(
    sections: Sequence[Section], nodes: Iterable[str]
) -> Iterator[str]:
    """Yield a problem for each section of these nodes that would be ignored.

    Either its name is misspelt, or its namespace differs from the node's and no other
    section of that name matches. `nodes` are full names; in the root namespace the
    slash may be omitted.
    """
    by_name = {section.pattern.rsplit('/', 1)[-1]: section for section in sections}
    absent = [node for node in NODES if node not in by_name]
    for name, section in by_name.items():
        if name not in NODES and (guess := suggestion(name, absent, cutoff=0.8)):
            yield f'line {section.line}: unknown node {name}{guess}'
    for node in nodes:
        full = _full(node)
        name = node.rsplit('/', 1)[-1]
        if name in by_name and not any(
            section.matches(full) for section in sections if not section.is_wildcard
        ):
            section = by_name[name]
            yield (
                f'line {section.line}: {section.pattern} does not match {full}: write /**/{name} '
                'for the node in any namespace'
            )


def ignored_in(path: str | Path, nodes: Iterable[str]) -> str:
    """Return `ignored_sections` of a file, with its name."""
    found = ignored_sections(read(path), nodes)
    return f'{path}: {found}' if found else ''


def ignored_sections(sections: Sequence[Section], nodes: Iterable[str]) -> str:
    """Return the sections that no node of this package reads, in words; empty: none.

    They may belong to others in the same file, or be misspelt. `nodes` are those that
    are started.
    """
    full = [_full(node) for node in nodes]
    by_wildcard = [section for section in sections if section.is_wildcard]
    matches = {
        section.pattern: any(map(section.matches, full)) for section in by_wildcard
    }
    ignored = [section for section in sections if _is_of_others(section)]
    if not any(matches.values()):
        ignored += by_wildcard
    listed = ', '.join(f'{each.pattern} (line {each.line})' for each in ignored)
    if not listed:
        return ''
    known = ', '.join(NODES)
    return f'no node of this package reads the sections {listed}: its nodes are {known}'


def _is_of_others(section: Section) -> bool:
    name = section.pattern.rsplit('/', 1)[-1]
    return not section.is_wildcard and name not in (*NODES, STUDY)


def _full(node: str) -> str:
    """Return the full name of a node, whose slash may be omitted in the root namespace."""
    return '/' + node.removeprefix('/')

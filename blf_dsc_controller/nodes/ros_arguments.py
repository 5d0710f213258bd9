# SPDX-License-Identifier: Apache-2.0
"""Arguments of a node, as of `ros2 run`: mistakes that ROS ignores, and what `-p` gives.

`-p` is put before files: of all sections that match a node, ROS uses the last in the order
in which their names first appear, so a section `/**/sim_plant` of a file would override
`-p`, which belongs to `/**`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rclpy.utilities import remove_ros_args

from blf_dsc_controller.configuration.files import parse
from blf_dsc_controller.configuration.nodes import (
    ignored_sections,
    read,
    unmatched_sections,
)
from blf_dsc_controller.errors import BlfDscError, ConfigurationError


def refuse_unknown(argv: Sequence[str]) -> None:
    """Raise BlfDscError if there are arguments that ROS does not handle itself."""
    foreign = remove_ros_args(args=list(argv))[1:]
    if foreign:
        remedy = 'ROS reads only those after --ros-args'
        raise BlfDscError(f'unknown arguments {" ".join(foreign)}: {remedy}')


def check_sections(argv: Sequence[str], node: str) -> list[str]:
    """Return remarks on sections of parameter files that no node of this package reads.

    Raises ConfigurationError if a section meant for `node` (a full name) does not match
    it.
    """
    remarks = []
    for path in parameter_files(argv):
        sections = read(path)
        problems = list(unmatched_sections(sections, [node]))
        if problems:
            raise ConfigurationError(problems, path)
        ignored = ignored_sections(sections, [node])
        if ignored:
            remarks.append(f'{path}: {ignored}')
    return remarks


def parameter_files(argv: Sequence[str]) -> list[str]:
    """Return the parameter files that the arguments name."""
    return [path for option, path in _ros_options(argv) if option == '--params-file']


def assigned(argv: Sequence[str]) -> dict[str, object]:
    """Return the values of `-p name:=value`, except those for one node."""
    given: dict[str, object] = {}
    for option, rule in _ros_options(argv):
        name, _, value = rule.partition(':=')
        if option != '--params-file' and ':' not in name:
            (section,) = parse(f'/**:\n  ros__parameters:\n    {name}: {value}\n')
            given |= {key: entry.value for key, entry in section.entries.items()}
    return given


def _ros_options(argv: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield each parameter option with its value."""
    for_ros = False
    words = iter(argv)
    for word in words:
        if word in ('--ros-args', '--'):
            for_ros = word == '--ros-args'
        elif for_ros and word in ('-p', '--param', '--params-file'):
            yield word, next(words, '')

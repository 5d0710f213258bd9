# SPDX-License-Identifier: Apache-2.0
"""YAML of somebody else: not too large, not nested too deep, without references to itself.

A few lines that refer to each other can stand for a billion, and a row of brackets is deeper than
the interpreter can go.
"""

from __future__ import annotations

from typing import Any

import yaml

_MOST_NODES = 50_000
_DEEPEST = 50

_Parser: Any = getattr(yaml, 'CLoader', yaml.Loader)  # ten times as fast, where it is installed
_Loader: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


class UnreasonableYamlError(yaml.MarkedYAMLError):
    """YAML that would take too much memory or time."""


def check_yaml(text: str) -> None:
    """Raise UnreasonableYamlError, or another yaml.YAMLError if `text` is damaged."""
    depth = nodes = 0
    event: Any
    for event in yaml.parse(text, Loader=_Parser):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        nodes += isinstance(event, yaml.NodeEvent)
        problem = ''
        if isinstance(event, yaml.AliasEvent):
            problem = f'ROS does not support the reference *{event.anchor}'
        elif depth > _DEEPEST:
            problem = f'nested more than {_DEEPEST} deep'
        elif nodes > _MOST_NODES:
            problem = f'more than {_MOST_NODES} entries'
        if problem:
            raise UnreasonableYamlError(problem=problem, problem_mark=event.start_mark)


def load_yaml(text: str) -> Any:
    """Plain data of YAML; raises as `check_yaml`."""
    check_yaml(text)
    return yaml.load(text, Loader=_Loader)  # noqa: S506 - it is a safe one

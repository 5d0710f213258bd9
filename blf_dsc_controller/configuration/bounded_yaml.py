# SPDX-License-Identifier: Apache-2.0
"""Untrusted YAML: limited in size and nesting, and without aliases.

A few lines of aliases can expand to a billion entries, and deeply nested brackets exceed the
recursion limit of the interpreter.
"""

from __future__ import annotations

from typing import Any

import yaml

_MOST_NODES = 50_000
_DEEPEST = 50

_Parser: Any = getattr(yaml, 'CLoader', yaml.Loader)  # ten times as fast, if available
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
            problem = f'ROS does not support the alias *{event.anchor}'
        elif depth > _DEEPEST:
            problem = f'nested more than {_DEEPEST} levels deep'
        elif nodes > _MOST_NODES:
            problem = f'more than {_MOST_NODES} entries'
        if problem:
            raise UnreasonableYamlError(problem=problem, problem_mark=event.start_mark)


def load_yaml(text: str) -> Any:
    """Return the plain data of a YAML text; raises the errors of `check_yaml`."""
    check_yaml(text)
    return yaml.load(text, Loader=_Loader)  # noqa: S506 - a safe loader

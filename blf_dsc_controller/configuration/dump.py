# SPDX-License-Identifier: Apache-2.0
"""Parameter files as the exact record of a run: written so that they load back equal."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from blf_dsc_controller.configuration.schema import flatten

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from blf_dsc_controller.configuration.parameter import Value


def dump(path: Path, configs: Mapping[str, object]) -> None:
    """Write every parameter of every node into the ROS 2 parameter file `path`.

    `configs` are configurations by the names of their nodes, which may carry a namespace.
    """
    path.write_text(text(configs), encoding='utf-8')


def text(configs: Mapping[str, object]) -> str:
    """Return what `dump` writes."""
    return text_of_values({node: flatten(config) for node, config in configs.items()})


def text_of_values(nodes: Mapping[str, Mapping[str, Value]]) -> str:
    """Return the parameter file of values by dotted name, for each node by its name."""
    return ''.join(_lines(nodes))


def written(value: Value) -> str:
    """Return a value as YAML that both ROS and YAML libraries read as the same type."""
    if isinstance(value, tuple):
        return '[' + ', '.join(written(entry) for entry in value) + ']'
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
            yield f'    {name}: {written(value)}\n'

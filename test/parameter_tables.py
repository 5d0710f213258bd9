# SPDX-License-Identifier: Apache-2.0
"""The tables of the page of all parameters.

`python test/parameter_tables.py doc/parameters.md` writes them; what is above them stays.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from blf_dsc_controller.configuration import law_file, two_link
from blf_dsc_controller.configuration.nodes import NODES
from blf_dsc_controller.configuration.schema import (
    format_value,
    parameters,
)

HEADER = (
    '| name | default | unit | live | description | type and range |\n'
    '| --- | --- | --- | --- | --- | --- |\n'
)


def with_tables(page: str) -> str:
    """Return the page of all parameters; what is above its tables stays."""
    above = page.partition('\n## ')[0]
    tables: dict[str, str] = {}
    sections = [
        _section(node, parameters(cls), tables)
        + (_optional() if node == 'blf_dsc_controller' else '')
        for node, cls in NODES.items()
    ]
    return above + ''.join(sections)


def _optional() -> str:
    """Return tables of what the controller has with two links, and with some laws."""
    of_two_links = _of_group(
        'The arm of two links',
        'The controller has them without `robot.urdf`: the gains of an arm from a URDF follow '
        'from its stiffness and damping.',
        two_link.GROUP,
        two_link.TwoLink,
    )
    of_laws = [
        _of_group(
            f'Gains of {law}',
            f'Only the law `{law}` has them.',
            law_file.GROUP,
            law_file.gains_of(law_file.load_law(law)),
        )
        for law in law_file.PACKAGED
    ]
    return ''.join((of_two_links, *of_laws))


def _of_group(heading: str, text: str, group: str, cls: type) -> str:
    """Return the section of a group that the controller may have."""
    params = (replace(param, name=f'{group}.{param.name}') for param in parameters(cls))
    return f'\n### {heading}\n\n{text}\n\n{_table(params)}'


def _section(node: str, params: Iterable[Any], earlier: dict[str, str]) -> str:
    """Return a node's section: a table of its parameters for each group.

    One that is among the `earlier` tables, each with its heading, is linked to instead.
    """
    groups: dict[str, list[Any]] = {}
    for param in params:
        group, _, _ = param.name.rpartition('.')
        groups.setdefault(group, []).append(param)
    tables = [f'\n## {node}\n']
    for group, members in groups.items():
        title = f'{node}: {group}'
        heading = f'\n### {title}\n' if group else ''
        table = _table(members)
        if other := earlier.get(table):
            table = f'As [{other}](#{_anchor(other)}).\n'
        earlier.setdefault(table, title)
        tables.append(f'{heading}\n{table}')
    return ''.join(tables)


_SHORT = (
    (' array', 's'),
    ('; entries: joints', ' per joint'),
    ('; may be empty', ' or []'),
    ('at least ', '≥ '),
    ('at most ', '≤ '),
    ('above ', '> '),
    ('below ', '< '),
    (' and ', ', '),
    ('one of ', ''),
)
"""Shorter words for types and ranges, as the head of the page explains them."""


def _shortened(kind: str) -> str:
    for long, short in _SHORT:
        kind = kind.replace(long, short)
    return kind


def _anchor(heading: str) -> str:
    """Return how the site links to a heading."""
    return heading.lower().replace(': ', '-').replace('_', '-')


def _table(params: Iterable[Any]) -> str:
    return HEADER + ''.join(map(_row, params))


def _row(param: Any) -> str:
    symbol = f' ({param.symbol})' if param.symbol else ''
    kind = '; '.join(part for part in (param.kind, param.constraints) if part)
    cells = (
        f'`{param.name}`',
        f'`{format_value(param.default)}`',
        param.unit,
        '' if param.read_only else '•',
        f'{param.description}{symbol}',
        _shortened(kind),
    )
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |\n'


if __name__ == '__main__':
    path = Path(sys.argv[1])
    path.write_text(with_tables(path.read_text(encoding='utf-8')), encoding='utf-8')

# SPDX-License-Identifier: Apache-2.0
"""The table of all parameters for the documentation, made from the configurations themselves.

`python -m blf_dsc_controller.configuration.documentation doc/parameters.md` writes it anew.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from blf_dsc_controller.configuration.nodes import NODES
from blf_dsc_controller.configuration.params_file import format_value
from blf_dsc_controller.configuration.schema import parameters

if TYPE_CHECKING:
    from collections.abc import Iterator

    from blf_dsc_controller.configuration.schema import Parameter

_PREFACE = """\
# Parameters

Every parameter of every node, with its default: the recommended set. One parameter file serves all
nodes ([config/recommended.yaml](../config/recommended.yaml) shows all of it); a file need only say
what it changes. Numbers of type double need a point: `1.0`, not `1`. Lists have an entry for each
joint unless the range says otherwise.

A parameter with a dot under *live* can be changed while the node runs (`ros2 param set`); the
others are fixed at the start, and `ros2 param describe` says why.

This page is made from the code: `python -m blf_dsc_controller.configuration.documentation
doc/parameters.md`.
"""

_HEADER = (
    '| name | symbol | unit | type | default | range | live | what it is |\n'
    '| --- | --- | --- | --- | --- | --- | --- | --- |\n'
)


def reference_table() -> str:
    """Return the Markdown page of all parameters."""
    return _PREFACE + ''.join(
        f'\n## {node}\n\n{_HEADER}{"".join(_rows(parameters(cls)))}' for node, cls in NODES.items()
    )


def _rows(listed: list[Parameter]) -> Iterator[str]:
    for one in listed:
        cells = (
            f'`{one.name}`',
            one.rule.symbol,
            one.rule.unit,
            one.kind.value,
            f'`{format_value(one.default)}`',
            _range(one),
            '' if one.rule.read_only else '•',
            one.rule.description,
        )
        yield '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |\n'


def _range(one: Parameter) -> str:
    lengths = [name for name in one.rule.length if name != 'joints']
    if 'joints' in one.rule.length and lengths:
        lengths.insert(0, 'joint')
    each = 'an entry for each ' + ' and '.join(lengths) if lengths else ''
    return '; '.join(part for part in (one.allowed, each) if part)


if __name__ == '__main__':
    Path(sys.argv[1]).write_text(reference_table(), encoding='utf-8')

# SPDX-License-Identifier: Apache-2.0
"""Generation of the page of all parameters.

Run `python -m blf_dsc_controller.configuration.documentation doc/parameters.md` to write it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from blf_dsc_controller.configuration.nodes import NODES
from blf_dsc_controller.configuration.params_file import format_value
from blf_dsc_controller.configuration.schema import Parameter, parameters

_PREFACE = """\
# Parameters

All parameters of all nodes; the defaults are the recommended set. One parameter file serves all
nodes ([config/recommended.yaml](../config/recommended.yaml) has all of them); a file needs only the
parameters it changes. Values of type double need a decimal point: `1.0`, not `1`. Arrays have one
entry per joint unless the range says otherwise.

A dot under *live* marks a parameter that can change while the node runs (`ros2 param set`); the
others are fixed at the start, and `ros2 param describe` gives the reason.

This page is generated: `python -m blf_dsc_controller.configuration.documentation
doc/parameters.md`.
"""

_HEADER = (
    '| name | description | default | unit | range | live | type | symbol |\n'
    '| --- | --- | --- | --- | --- | --- | --- | --- |\n'
)


def parameter_page() -> str:
    """Return the Markdown page of all parameters."""
    page = _PREFACE
    for node, cls in NODES.items():
        page += f'\n## {node}\n\n{_HEADER}{"".join(_row(one) for one in parameters(cls))}'
    return page


def _row(one: Parameter) -> str:
    number = next((f'{length} entries' for length in one.length if length.isdigit()), '')
    lengths = [name for name in one.length if name != 'joints' and not name.isdigit()]
    if 'joints' in one.length and lengths:
        lengths.insert(0, 'joint')
    each = f'{number or "one entry"} per {" and ".join(lengths)}' if lengths else number
    if one.omittable:
        each = f'{each}, or none' if each else 'may be empty'
    cells = (
        f'`{one.name}`',
        one.description,
        f'`{format_value(one.default)}`',
        one.unit,
        '; '.join(part for part in (one.allowed, each) if part),
        '' if one.read_only else '•',
        one.kind.value,
        one.symbol,
    )
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |\n'


if __name__ == '__main__':
    Path(sys.argv[1]).write_text(parameter_page(), encoding='utf-8')

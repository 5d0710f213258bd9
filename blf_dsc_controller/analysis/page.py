# SPDX-License-Identifier: Apache-2.0
"""Self-contained HTML pages from the templates of the package."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined

_TEMPLATES = Environment(
    loader=PackageLoader('blf_dsc_controller'),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.policies['json.dumps_kwargs'] = {'allow_nan': False, 'separators': (',', ':')}
_TEMPLATES.filters['anchor'] = lambda title: title.lower().replace(' ', '-')
_TEMPLATES.filters['embedded'] = lambda png: (
    f'data:image/png;base64,{base64.b64encode(png.read_bytes()).decode("ascii")}'
)


class Cell(NamedTuple):
    """Table cell that is more than plain text.

    Styles: number, code, good, partly, bad; marked highlights the row.
    """

    text: str
    style: str = ''
    colour: str = ''  # of a swatch before the text


def write_page(path: Path, template: str, title: str, **values: object) -> None:
    """Render a template with its variables and write the page."""
    text = _TEMPLATES.get_template(template).render(title=title, **values)
    path.write_text(text, encoding='utf-8')

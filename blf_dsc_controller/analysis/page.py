# SPDX-License-Identifier: Apache-2.0
"""HTML pages that need nothing beside them: text, tables and figures, in sections."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeAlias

from jinja2 import Environment, PackageLoader, StrictUndefined

_TEMPLATES = Environment(
    loader=PackageLoader('blf_dsc_controller.analysis'),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_TEMPLATES.policies['json.dumps_kwargs'] = {'allow_nan': False, 'separators': (',', ':')}


class Cell(NamedTuple):
    """Cell of a table that is not plain text.

    Styles: number, code, good, partly, bad; marked highlights the row.
    """

    text: str
    style: str = ''
    colour: str = ''  # of a swatch before the text


@dataclass(frozen=True)
class Paragraph:
    """Text; style `lead` or `muted`."""

    kind: ClassVar = 'paragraph'
    text: str
    style: str = ''


@dataclass(frozen=True)
class Table:
    """Rows below a header; `numeric` aligns all columns but the first as numbers."""

    kind: ClassVar = 'table'
    header: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    numeric: bool = False
    folded: str = ''  # summary under which the table is folded away


@dataclass(frozen=True)
class Figure:
    """PNG file, embedded into the page."""

    kind: ClassVar = 'figure'
    path: Path
    caption: str

    @property
    def data(self) -> str:
        """Content as a data URI."""
        return f'data:image/png;base64,{base64.b64encode(self.path.read_bytes()).decode("ascii")}'


@dataclass(frozen=True)
class Listing:
    """Preformatted text under a heading."""

    kind: ClassVar = 'listing'
    title: str
    text: str
    colour: str = ''  # of a swatch before the title


@dataclass(frozen=True)
class Fragment:
    """Another template of this package, rendered in place."""

    kind: ClassVar = 'fragment'
    template: str
    values: Mapping[str, Any]

    @property
    def html(self) -> str:
        """Rendered template."""
        return _TEMPLATES.get_template(self.template).render(self.values)


Content: TypeAlias = Paragraph | Table | Figure | Listing | Fragment


class Section(NamedTuple):
    """Content under a heading."""

    title: str
    content: Sequence[Content]


@dataclass(frozen=True)
class Page:
    """A page; `links` are pairs of an element's id and the text of the link."""

    title: str
    introduction: Sequence[Content]
    sections: Sequence[Section]
    links: Sequence[tuple[str, str]] = field(default=())

    def write(self, path: Path) -> None:
        """Write the page as one HTML file."""
        text = _TEMPLATES.get_template('page.html').render(page=self)
        path.write_text(text, encoding='utf-8')

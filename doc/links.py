# SPDX-License-Identifier: Apache-2.0
"""Dead links of a built site: `python doc/links.py out/docs`, as `make docs` does."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urlsplit


class Page(HTMLParser):
    """Anchors, links and loaded resources of a page of the site."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str | None] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect what a tag has."""
        given = dict(attrs)
        self.anchors.add(given.get('id'))
        if tag == 'a':
            self.links += [link for link in (given.get('href'),) if link]
        else:
            self.loaded += [link for key in ('src', 'href') if (link := given.get(key))]


def read_pages(folder: Path) -> dict[Path, Page]:
    """Read every page of a site."""
    return {path: Page(path.read_text(encoding='utf-8')) for path in folder.rglob('*.html')}


def dead_links(site: Mapping[Path, Page]) -> Iterator[str]:
    """Yield each link within the site that leads nowhere, with its page."""
    for path, page in site.items():
        for link in page.links:
            url = urlsplit(link)
            target = (path.parent / url.path).resolve() if url.path else path
            if not url.scheme and not (
                target.is_file()
                and (not url.fragment or target not in site or url.fragment in site[target].anchors)
            ):
                yield f'{path.name}: {link}'


if __name__ == '__main__':
    dead = list(dead_links(read_pages(Path(sys.argv[1]).resolve())))
    sys.exit('\n'.join(['dead links:', *dead]) if dead else 0)

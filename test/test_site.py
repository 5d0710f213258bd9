# SPDX-License-Identifier: Apache-2.0
"""The documentation site: built without warnings, complete, and without external requests."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).resolve().parents[1]
DOC = ROOT / 'doc'


class Page(HTMLParser):
    """Anchors, links and loaded resources of a page of the site."""

    def __init__(self, text):
        super().__init__()
        self.anchors, self.links, self.loaded = set(), [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.anchors.add(given.get('id'))
        if tag == 'a' and 'href' in given:
            self.links.append(given['href'])
        elif tag != 'a':
            self.loaded += [given[key] for key in ('src', 'href') if given.get(key)]


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """Every page of the site, built as by `make docs`."""
    out = tmp_path_factory.mktemp('site')
    sphinx = [sys.executable, '-m', 'sphinx', '-q', '-W', '--keep-going', '-n', str(DOC), str(out)]
    built = subprocess.run(sphinx, check=False, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return {path: Page(path.read_text()) for path in out.rglob('*.html')}


def test_site_has_every_page_and_no_dead_link(site):
    names = {path.stem for path in site}
    assert {path.stem for path in DOC.iterdir() if path.suffix in ('.md', '.rst')} <= names
    for path, page in site.items():
        for link in page.links:
            url = urlsplit(link)
            if url.scheme:
                continue
            target = (path.parent / url.path).resolve() if url.path else path
            assert target.is_file(), (path.name, link)
            if url.fragment and target in site:
                assert url.fragment in site[target].anchors, (path.name, link)


def test_site_loads_no_external_resources(site):
    for path, page in site.items():
        for url in page.loaded:
            assert not urlsplit(url).netloc, (path.name, url)
            assert url.startswith(('#', 'data:')) or (path.parent / urlsplit(url).path).exists()
    (folder,) = {path.parent for path in site if path.name == 'index.html'}
    for sheet in folder.rglob('*.css'):
        assert not re.search(r'(url\(|@import)\s*["\']?(https?:)?//', sheet.read_text()), sheet


@pytest.mark.parametrize(
    'name', ['README.md', 'CONTRIBUTING.md', 'examples/mujoco_plant/README.md']
)
def test_links_outside_the_site_are_valid(name, site):
    page = ROOT / name
    anchors = {path.stem: parsed.anchors for path, parsed in site.items()}
    for link in re.findall(r'\]\(([^)\s]+)\)', page.read_text()):
        url = urlsplit(link)
        if not url.scheme:
            target = page.parent / url.path
            assert target.exists(), link
            assert not url.fragment or url.fragment in anchors[target.stem], link


def test_every_picture_has_a_make_command():
    text = (DOC / 'figures.md').read_text()
    shown = {path.name for folder in ('doc', 'benchmark') for path in (ROOT / folder).glob('*.png')}
    rows = re.findall(r'^\| \S*?([\w-]+\.png)\S* \| `make (\w+)', text, re.MULTILINE)
    assert {picture for picture, _ in rows} == shown

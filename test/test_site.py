# SPDX-License-Identifier: Apache-2.0
"""The documentation site: built without warnings, complete, and without external requests."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).resolve().parents[1]
DOC = ROOT / 'doc'
sys.path.append(str(DOC))
links = importlib.import_module('links')


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    """Every page of the site, built as by `make docs`."""
    out = tmp_path_factory.mktemp('site')
    sphinx = [sys.executable, '-m', 'sphinx', '-q', '-W', '--keep-going', '-n', str(DOC), str(out)]
    built = subprocess.run(sphinx, check=False, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return links.read_pages(out)


def test_site_has_every_page_and_no_dead_link(site):
    names = {path.stem for path in site}
    assert {path.stem for path in DOC.iterdir() if path.suffix in ('.md', '.rst')} <= names
    assert not list(links.dead_links(site))
    page = next(page for path, page in site.items() if path.stem == 'index')
    page.links += ['nowhere.html', '#nothing', 'https://example.org/elsewhere']
    assert list(links.dead_links(site)) == ['index.html: nowhere.html', 'index.html: #nothing']


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

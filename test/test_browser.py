# SPDX-License-Identifier: Apache-2.0
"""The pages of report and view in a browser; runs in `make test-browser`.

Their contents are checked without a browser in test_analysis_report.py, test_view.py and
test_view_live.py.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import chromium
import pytest
import recorded_run

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')
pytest.importorskip('yourdfpy', reason='needs viser: pip install blf_dsc_controller[view]')

from blf_dsc_controller.analysis.report import read_bag, write_report
from blf_dsc_controller.view.bag import BagPlayer
from blf_dsc_controller.view.page import Page

pytestmark = [
    pytest.mark.skipif(chromium.find() is None, reason='there is no Chromium here'),
    pytest.mark.skipif(not os.environ.get('BROWSER_TESTS'), reason='runs in make test-browser'),
]

SHOTS = Path(os.environ.get('BROWSER_SHOTS') or tempfile.gettempdir())
TEXT = '(document.body?.innerText ?? "")'
HARMLESS = ('THREE.Clock', 'GPU stall due to ReadPixels')  # warnings of libraries that viser uses
PLOTS = "document.querySelectorAll('.js-plotly-plot')"


@pytest.fixture
def browser(tmp_path, request):
    SHOTS.mkdir(exist_ok=True)
    chrome = chromium.Browser(tmp_path / 'profile', *getattr(request, 'param', ()))
    yield chrome
    chrome.close()


@pytest.fixture(scope='module')
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp('pages')
    first = recorded_run.record(folder / 'one', 4.0)
    other = recorded_run.record(folder / 'other', 4.0, **{'feedback.gain': [30.0, 10.0]})
    write_report([read_bag(first)], folder / 'one.html')
    write_report([read_bag(first), read_bag(other)], folder / 'both.html')
    return folder


def show(browser, path):
    browser.call('Page.navigate', url=path.as_uri())
    browser.wait('window.reportReady')


def ranges(browser):
    return browser.value(f'Array.from({PLOTS}).map(p => p.layout.xaxis.range)')


@pytest.mark.parametrize('name', ['one', 'both'])
@pytest.mark.parametrize('width', [400, 1400])
def test_every_panel_is_drawn_and_fits_the_window(browser, pages, name, width):
    """Legends cover no title and no axis."""
    metrics = {'width': width, 'height': 900, 'deviceScaleFactor': 1, 'mobile': False}
    browser.call('Emulation.setDeviceMetricsOverride', **metrics)
    show(browser, pages / f'{name}.html')
    drawn = browser.value(f"Array.from({PLOTS}).filter(p => p.querySelector('.trace')).length")
    assert drawn == browser.value('data.panels.length')
    assert drawn >= 12  # two joints, each with error, position, torque; parameters; excitation
    lines = browser.value("document.querySelectorAll('.scatterlayer path.js-line').length")
    assert lines > drawn
    assert browser.value('document.documentElement.scrollWidth') <= width
    covered = browser.value(
        f'Array.from({PLOTS}).filter((plot) => {{'
        '  const box = (part) => plot.querySelector(part)?.getBoundingClientRect();'
        "  const legend = box('.legend .bg');"
        "  const others = ['.gtitle', '.xtitle', '.ytitle', '.plot'].map(box);"
        '  return legend && others.some((other) => other && legend.left < other.right'
        '    && other.left < legend.right && legend.top < other.bottom'
        '    && other.top < legend.bottom); }).map((plot) => plot.layout.title.text)'
    )
    assert covered == []
    assert browser.value('performance.getEntriesByType("resource").length') == 0
    browser.screenshot(SHOTS / f'report_{name}_{width}.png', whole=True)
    assert browser.errors == []


def test_dragging_zooms_all_time_panels(browser, pages):
    show(browser, pages / 'one.html')
    before = ranges(browser)
    assert all(limits == pytest.approx([0.0, 4.0]) for limits in before)
    box = browser.value(
        f"(() => {{ const r = {PLOTS}[0].querySelector('.nsewdrag').getBoundingClientRect();"
        'return [r.left, r.top, r.width, r.height]; })()'
    )
    left, top, width, height = box
    middle = top + height / 2
    browser.drag((left + width * 0.25, middle), (left + width * 0.5, middle))
    browser.wait(f'{PLOTS}[0].layout.xaxis.range[1] < 2.5')
    browser.wait(f'Array.from({PLOTS})[3].layout.xaxis.range[1] < 2.5')
    for low, high in ranges(browser):
        assert low == pytest.approx(1.0, abs=0.05)
        assert high == pytest.approx(2.0, abs=0.05)
    browser.screenshot(SHOTS / 'report_zoomed.png')
    assert browser.errors == []


for_3d = pytest.mark.parametrize(
    'browser', [(*chromium.WEBGL, '--window-size=1000,700')], indirect=True, ids=['3d']
)


def show_view(browser, page):
    browser.call('Page.navigate', url=page.url)
    browser.wait(f"{TEXT}.includes('largest error')")
    browser.wait("document.querySelector('canvas') !== null")


def errors(browser):
    return [line for line in browser.errors if not any(w in f'{line}' for w in HARMLESS)]


def assert_local(browser, page):
    own = (page.url, 'data:', 'blob:')
    assert [url for url in browser.requests if not url.startswith(own)] == []
    assert browser.requests


@for_3d
def test_bag_is_played_in_the_browser(browser, tmp_path):
    page = Page('127.0.0.1', 18280)
    try:
        player = BagPlayer(page, recorded_run.record(tmp_path / 'bag', 4.0))
        show_view(browser, page)
        player.slider.value = 3.0
        player.update(0.0)
        browser.wait(f"{TEXT}.includes('t = 2.9') || {TEXT}.includes('t = 3.0')")
        browser.screenshot(SHOTS / 'view_bag.png')
        browser.click('Play / Pause')
        wait_until(browser, lambda: player._playing)
        player.update(0.5)
        browser.wait(f"{TEXT}.includes('t = 3.4') || {TEXT}.includes('t = 3.5')")
        browser.click('Events')
        browser.wait(f"{TEXT}.includes('learning')")
        browser.screenshot(SHOTS / 'view_events.png')
        assert errors(browser) == []
        assert_local(browser, page)
    finally:
        page.close()


def wait_until(browser, condition):
    while not condition():
        browser.value('1')

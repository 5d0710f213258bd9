# SPDX-License-Identifier: Apache-2.0
"""The pages of report and view in a browser; runs in `make test-browser`.

Their contents are checked without a browser in test_analysis_report.py and
test_view.py.
"""

from __future__ import annotations

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path

import chromium
import pytest
import recorded_run

pytest.importorskip('playwright', reason='make test-browser installs it')
pytest.importorskip('plotly', reason='needs plotly: pip install .[report]')
pytest.importorskip('yourdfpy', reason='needs viser: pip install .[view]')

from blf_dsc_controller.analysis.report import read_bag, write_report
from blf_dsc_controller.view.node import ViewNode

pytestmark = [
    pytest.mark.skipif(chromium.find() is None, reason='there is no Chromium here'),
    pytest.mark.skipif(
        not os.environ.get('BROWSER_TESTS'), reason='runs in make test-browser'
    ),
]

SHOTS = Path(os.environ.get('BROWSER_SHOTS') or tempfile.gettempdir())
TEXT = '(document.body?.innerText ?? "")'
# warnings of libraries that viser uses
HARMLESS = ('THREE.Clock', 'GPU stall due to ReadPixels')
PLOTS = "document.querySelectorAll('.js-plotly-plot')"


@pytest.fixture(scope='module')
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp('pages')
    first = recorded_run.record(folder / 'one', 4.0)
    other = recorded_run.record(
        folder / 'other', 4.0, **{'two_link.feedback_gain': [30.0, 10.0]}
    )
    write_report([read_bag(first)], folder / 'one.html')
    write_report([read_bag(first), read_bag(other)], folder / 'both.html')
    return folder


@contextmanager
def shown(path, width=1400, height=900):
    with chromium.opened(width, height) as (page, log):
        page.goto(path.as_uri())
        page.wait_for_function('window.reportReady')
        yield page
        assert log == []


@pytest.mark.parametrize('name', ['one', 'both'])
@pytest.mark.parametrize('width', [400, 1400])
def test_every_panel_is_drawn_and_fits_the_window(pages, name, width):
    """Legends cover no title and no axis."""
    with shown(pages / f'{name}.html', width) as page:
        drawn = f"Array.from({PLOTS}).filter(p => p.querySelector('.trace')).length"
        panels = page.evaluate(drawn)
        assert panels == page.evaluate('data.panels.length')
        # two joints, each with error, position, torque; parameters; excitation
        assert panels >= 12
        assert page.locator('.scatterlayer path.js-line').count() > panels
        assert page.evaluate('document.documentElement.scrollWidth') <= width
        covered = page.evaluate(
            f'Array.from({PLOTS}).filter((plot) => {{'
            '  const box = (part) => plot.querySelector(part)?.getBoundingClientRect();'
            "  const legend = box('.legend .bg');"
            "  const others = ['.gtitle', '.xtitle', '.ytitle', '.plot'].map(box);"
            '  return legend && others.some((other) => other && legend.left < other.right'
            '    && other.left < legend.right && legend.top < other.bottom'
            '    && other.top < legend.bottom); }).map((plot) => plot.layout.title.text)'
        )
        assert covered == []
        assert page.evaluate('performance.getEntriesByType("resource").length') == 0
        page.screenshot(path=SHOTS / f'report_{name}_{width}.png', full_page=True)


GRIDLINES = (
    'Object.values(window.__viserTestpoints.uplots).map(({chart}) => chart)'
    '.filter((chart) => chart.scales.y.distr == 3)'
    '.map((chart) => [chart.axes[1]._splits, chart.axes[1]._values])'
)


def test_view_of_a_loop_in_the_browser(ros):
    view = ros.add(ViewNode, port=18280)
    arm, _ = ros.loop({'events.begin': [1.0], 'events.payload': [0.25]})
    ros.until(lambda: view.past and view.past[-1].time > 3.0)
    with chromium.opened(1000, 700, chromium.WEBGL) as (page, log):
        page.goto(view.page.url)
        page.wait_for_function(f"{TEXT}.includes('largest error')")
        page.wait_for_selector('canvas')
        decades = [[0.1, 1, 10, 100], ['0.1', '1', '10', '100']]
        assert page.evaluate(GRIDLINES) == [decades]
        for name in ('view', 'view_later'):
            ros.run(arm, 500)
            ros.until(lambda: view.past[-1].time > 1e-3 * arm.plant.sample - 0.1)
            view.page.plot(list(view.past))
            page.wait_for_function(f"{TEXT}.includes('t = {view.past[-1].time:.2f} s')")
            page.screenshot(path=SHOTS / f'{name}.png')
        page.get_by_text('Events', exact=True).click()
        page.wait_for_function(f"{TEXT}.includes('0.25 kg picked up')")
        page.screenshot(path=SHOTS / 'view_events.png')
    assert [
        line for line in log if not any(word in f'{line}' for word in HARMLESS)
    ] == []
    own = (view.page.url, 'data:', 'blob:')
    assert log.requests
    assert [url for url in log.requests if not url.startswith(own)] == []
    view.close()

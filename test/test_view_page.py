# SPDX-License-Identifier: Apache-2.0
"""The live view in a browser: the 3-D scene, no external requests, and working controls.

`make test-browser`. What is drawn is checked without a browser in test_view.py, what the controls
do in test_view_live.py.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import chromium
import pytest
import recorded_run

pytest.importorskip('yourdfpy', reason='needs viser: pip install blf_dsc_controller[view]')

from blf_dsc_controller.view.bag import BagPlayer
from blf_dsc_controller.view.page import Page

pytestmark = [
    pytest.mark.skipif(chromium.find() is None, reason='there is no Chromium here'),
    pytest.mark.skipif(not os.environ.get('BROWSER_TESTS'), reason='runs in make test-browser'),
]

SHOTS = Path(os.environ.get('BROWSER_SHOTS') or tempfile.gettempdir())
TEXT = '(document.body?.innerText ?? "")'
HARMLESS = ('THREE.Clock', 'GPU stall due to ReadPixels')  # warnings of libraries that viser uses


@pytest.fixture
def browser(tmp_path):
    SHOTS.mkdir(exist_ok=True)
    chrome = chromium.Browser(tmp_path / 'profile', *chromium.WEBGL, '--window-size=1000,700')
    yield chrome
    chrome.close()


def show(browser, page):
    browser.call('Page.navigate', url=page.url)
    browser.wait(f"{TEXT}.includes('largest error')")
    browser.wait("document.querySelector('canvas') !== null")


def errors(browser):
    return [line for line in browser.errors if not any(w in f'{line}' for w in HARMLESS)]


def assert_local(browser, page):
    own = (page.url, 'data:', 'blob:')
    assert [url for url in browser.requests if not url.startswith(own)] == []
    assert browser.requests


def test_bag_is_played_in_the_browser(browser, tmp_path):
    page = Page('127.0.0.1', 18280)
    try:
        player = BagPlayer(page, recorded_run.record(tmp_path / 'bag', 4.0))
        show(browser, page)
        player.slider.value = 3.0
        player.update(0.0)
        browser.wait(f"{TEXT}.includes('t = 2.9') || {TEXT}.includes('t = 3.0')")
        browser.screenshot(SHOTS / 'view_bag.png')
        browser.click('Play / Pause')
        wait_until(browser, lambda: player._playing)
        player.update(0.5)
        browser.wait(f"{TEXT}.includes('t = 3.4') || {TEXT}.includes('t = 3.5')")
        for tab, word in (('Estimates', 'truth'), ('Events', 'learning')):
            browser.click(tab)
            browser.wait(f'{TEXT}.includes({word!r})')
            browser.screenshot(SHOTS / f'view_{tab.lower()}.png')
        assert errors(browser) == []
        assert_local(browser, page)
    finally:
        page.close()


def wait_until(browser, condition):
    while not condition():
        browser.value('1')


def test_running_loop_is_shown_and_pushed(browser):
    pytest.importorskip('rclpy', reason='needs ROS 2')
    from ros_rig import RosRig

    from blf_dsc_controller.view.node import ViewNode

    rig = RosRig()
    try:
        view = rig.add(ViewNode, port=18290)
        arm, law = rig.loop({'load.payload': 0.25})
        rig.until(lambda: 'Push' in view.buttons)
        show(browser, view.page)
        rig.until(lambda: view.past and view.past[-1].time > 8.0)
        browser.wait(f"{TEXT}.includes('OK tracking')")
        browser.screenshot(SHOTS / 'view_running.png')
        browser.click('Try')
        browser.click('Push')
        rig.until(lambda: arm.config.load.torque == (2.0, 0.0))
        rig.until(lambda: arm.config.load.torque == (0.0, 0.0))
        browser.screenshot(SHOTS / 'view_try.png')
        rig.kill(law)
        rig.until(lambda: view.page._state[0] == 'ERROR')
        browser.wait(f"{TEXT}.includes('the controller is gone')")
        assert errors(browser) == []
        assert_local(browser, view.page)
    finally:
        rig.close()

# SPDX-License-Identifier: Apache-2.0
"""Pages in the headless Chromium of this computer, driven by playwright."""

from __future__ import annotations

import shutil
from contextlib import contextmanager

# 3D scenes are rendered by the CPU.
WEBGL = (
    '--use-angle=swiftshader',
    '--enable-unsafe-swiftshader',
    '--ignore-gpu-blocklist',
)
NAMES = ('chromium', 'chromium-browser', 'google-chrome')
PATIENCE = 60e3  # ms, until a test gives up on what should take seconds


def find():
    """Return the path of a Chromium, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Log(list):
    """Errors and warnings of the console and of scripts, with the `requests` of the page."""

    def __init__(self, page):
        super().__init__()
        self.requests = []
        page.on('console', self._note)
        page.on('pageerror', lambda error: self.append(error.message))
        page.on('request', lambda request: self.requests.append(request.url))

    def _note(self, message):
        if message.type in ('error', 'warning', 'assert'):
            self.append(message.text)


@contextmanager
def opened(width=1400, height=1000, flags=('--disable-gpu',)):
    """Provide a page of this size [px] and its log."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as api:
        browser = api.chromium.launch(executable_path=find(), args=[*flags])
        page = browser.new_page(viewport={'width': width, 'height': height})
        page.set_default_timeout(PATIENCE)
        yield page, Log(page)
        browser.close()

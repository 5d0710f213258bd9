# SPDX-License-Identifier: Apache-2.0
"""A headless Chromium, controlled over its DevTools pipe: no driver is needed."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import time

FLAGS = (
    '--headless',
    '--no-sandbox',
    '--disable-gpu',
    '--disable-quic',
    '--no-first-run',
    '--disable-background-networking',
    '--disable-component-update',
    '--disable-sync',
    '--remote-debugging-pipe',
    '--window-size=1400,1000',
)
# 3D scenes are rendered by the CPU.
WEBGL = ('--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist')
NAMES = ('chromium', 'chromium-browser', 'google-chrome')
PATIENCE = 300.0  # s, until a test gives up on what should take seconds
_PLACE = """(() => {{
    const found = [...document.querySelectorAll('*')].find(
        one => one.children.length === 0 && one.textContent.trim() === {text!r});
    if (!found) return null;
    const box = found.getBoundingClientRect();
    return [box.left + box.width / 2, box.top + box.height / 2];
}})()"""


def find():
    """Return the path of a Chromium, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page in a browser of its own.

    Attributes:
        errors: errors of the console and of scripts.
        requests: URLs that the page requested.
    """

    def __init__(self, profile, *flags):
        theirs_in, self._to = os.pipe()
        self._from, theirs_out = os.pipe()
        launch = f'exec {find()} "$@" 3<&{theirs_in} 4>&{theirs_out}'
        self._process = subprocess.Popen(
            ['/bin/bash', '-c', launch, 'chromium', *FLAGS, *flags, f'--user-data-dir={profile}'],
            pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._number = 0
        self._pending = b''
        self._session = None
        self.errors = []
        self.requests = []
        target = self.call('Target.createTarget', url='about:blank')['targetId']
        attached = self.call('Target.attachToTarget', targetId=target, flatten=True)
        self._session = attached['sessionId']
        for domain in ('Page', 'Runtime', 'Log', 'Network'):
            self.call(f'{domain}.enable')

    def call(self, method, **parameters):
        """Call a method of DevTools and return its result."""
        self._number += 1
        request = {'id': self._number, 'method': method, 'params': parameters}
        if self._session:
            request['sessionId'] = self._session
        os.write(self._to, json.dumps(request).encode() + b'\0')
        while True:
            answer = self._take()
            if answer.get('id') == self._number:
                assert 'error' not in answer, answer
                return answer['result']

    def value(self, expression):
        """Return the value of an expression in the page."""
        answer = self.call('Runtime.evaluate', expression=expression, returnByValue=True)
        assert 'exceptionDetails' not in answer, answer
        return answer['result'].get('value')

    def wait(self, expression):
        """Wait until an expression in the page is true, and return its value."""
        deadline = time.monotonic() + PATIENCE
        while not (value := self.value(expression)):
            assert time.monotonic() < deadline, f'still waiting for {expression}'
            time.sleep(0.05)
        return value

    def mouse(self, kind, x, y):
        """Move the mouse, or press or release its left button, at a position in the window."""
        self.call(
            'Input.dispatchMouseEvent',
            type=kind,
            x=x,
            y=y,
            button='left',
            buttons=0 if kind == 'mouseReleased' else 1,
            clickCount=1,
        )

    def click(self, text):
        """Click on the element with this text, once it exists."""
        self.wait(_PLACE.format(text=text))
        x, y = self.value(_PLACE.format(text=text))
        self.mouse('mousePressed', x, y)
        self.mouse('mouseReleased', x, y)

    def drag(self, start, end):
        """Drag from one position in the window to another."""
        (x0, y0), (x1, y1) = start, end
        self.mouse('mousePressed', x0, y0)
        for k in range(1, 6):
            self.mouse('mouseMoved', x0 + (x1 - x0) * k / 5, y0 + (y1 - y0) * k / 5)
        self.mouse('mouseReleased', x1, y1)

    def screenshot(self, path, *, whole=False):
        """Write the visible part of the page, or the whole page, as PNG."""
        answer = self.call('Page.captureScreenshot', captureBeyondViewport=whole, format='png')
        path.write_bytes(base64.b64decode(answer['data']))

    def close(self):
        """Kill the browser."""
        self._process.kill()
        self._process.wait()
        os.close(self._to)
        os.close(self._from)

    def _take(self):
        deadline = time.monotonic() + PATIENCE
        while b'\0' not in self._pending:
            ready, _, _ = select.select([self._from], [], [], 1.0)
            assert time.monotonic() < deadline, 'the browser does not respond'
            if ready:
                received = os.read(self._from, 1 << 20)
                assert received, 'the browser has ended'
                self._pending += received
        raw, self._pending = self._pending.split(b'\0', 1)
        message = json.loads(raw)
        self._note(message)
        return message

    def _note(self, message):
        params = message.get('params', {})
        if message.get('method') == 'Runtime.exceptionThrown':
            self.errors.append(params['exceptionDetails'])
        elif message.get('method') == 'Runtime.consoleAPICalled':
            if params['type'] in ('error', 'warning', 'assert'):
                self.errors.append(params['args'])
        elif message.get('method') == 'Network.requestWillBeSent':
            self.requests.append(params['request']['url'])
        elif message.get('method') == 'Log.entryAdded' and params['entry']['level'] == 'error':
            self.errors.append(params['entry'])

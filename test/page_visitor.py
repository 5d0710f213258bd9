# SPDX-License-Identifier: Apache-2.0
"""Visitors of the live view's page: what a browser sends, without a browser."""

from __future__ import annotations

import asyncio
import threading
from contextlib import contextmanager, suppress
from http.client import HTTPConnection

import msgspec
import viser
import websockets

_CAMERA = {
    'type': 'ViewerCameraMessage',
    'wxyz': (1.0, 0.0, 0.0, 0.0),
    'position': (0.0, 0.0, 1.0),
    'fov': 1.0,
    'near': 0.1,
    'far': 100.0,
    'image_height': 100,
    'image_width': 1000,
    'look_at': (0.0, 0.0, 0.0),
    'up_direction': (0.0, 0.0, 1.0),
}
"""With its first one, a browser has opened the page."""


def get(port, host):
    """Return the status of the page that is asked for at this host."""
    connection = HTTPConnection('127.0.0.1', port, timeout=10.0)
    connection.request('GET', '/', headers={'Host': host})
    status = connection.getresponse().status
    connection.close()
    return status


def refusal(port, host, origin):
    """Return the status with which a websocket is refused; 101 if it is not."""

    async def knock():
        path = f'ws://{host}'
        page = websockets.connect(
            path,
            origin=origin,
            subprotocols=[f'viser-v{viser.__version__}'],
            host='127.0.0.1',
            port=port,
        )
        try:
            async with page:
                return 101
        except websockets.InvalidStatus as error:
            return error.response.status_code

    return asyncio.run(knock())


@contextmanager
def visitor(port, *messages):
    """Open the page, say these messages, and follow what is drawn in a thread."""
    over = threading.Event()

    async def visit():
        page = websockets.connect(
            f'ws://127.0.0.1:{port}',
            origin=f'http://127.0.0.1:{port}',
            subprotocols=[f'viser-v{viser.__version__}'],
            max_size=None,
        )
        async with page as connection:
            for message in (_CAMERA, *messages):
                await connection.send(msgspec.msgpack.encode(message))
            while not over.is_set():
                with suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(connection.recv(), 0.05)

    thread = threading.Thread(target=lambda: asyncio.run(visit()))
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()

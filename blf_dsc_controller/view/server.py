# SPDX-License-Identifier: Apache-2.0
"""The server of the page, which answers the page's own visitors only.

A browser lets every page that it shows connect to a websocket of this computer, and a
name of somebody else's may lead here (DNS rebinding). The first shows in the request's
Origin, the second in its Host.
"""

from __future__ import annotations

import http
import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import viser
from websockets.asyncio import server as websockets
from websockets.datastructures import Headers

from blf_dsc_controller.errors import BlfDscError


class PageServer(viser.ViserServer):  # type: ignore[misc]
    """A server of viser for its own page, on this computer only unless `host` says more.

    Raises:
        BlfDscError: this release of viser leaves no way to check who asks.
    """

    def __init__(self, host: str, port: int) -> None:
        with _checked(host) as checks:
            super().__init__(host, port, label='blf_dsc', verbose=False)
        if not checks:
            self.stop()
            raise BlfDscError(
                f'viser {viser.__version__} serves pages in a way in which this package cannot '
                "refuse other pages' requests: install viser 1.1"
            )

    def request_share_url(self, verbose: bool = True) -> None:  # noqa: FBT001, FBT002 - viser's
        """Publish nothing: any visitor can ask viser for a public link."""

    def disconnect_share_url(self) -> None:
        """Do nothing: there is no public link."""


@contextmanager
def _checked(host: str) -> Iterator[list[str]]:
    """Let servers that are made meanwhile refuse requests; yield a list of their hosts.

    viser has no parameter for it.
    """
    serve = websockets.serve
    made: list[str] = []

    def serve_visitors(*given: Any, process_request: Any, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            problem = refusal(request.headers, host)
            if problem:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f'{problem}\n')
            return process_request(connection, request)

        made.append(host)
        return serve(*given, process_request=answer, **options)

    vars(websockets)['serve'] = serve_visitors
    try:
        yield made
    finally:
        vars(websockets)['serve'] = serve


def refusal(headers: Headers, host: str) -> str:
    """Return why a request to the page at `host` is refused; empty if it is answered.

    The page has its address, and the names of its host and of this computer. A port may
    be another one, that of a tunnel. Only programs that are no browsers send no Origin.
    """
    hosts = headers.get_all('Host')
    origins = headers.get_all('Origin')
    if len(hosts) != 1 or not _is_own(hosts[0], host):
        return (
            f'This page is not at {", ".join(hosts) or "no host"}: open it by the address that '
            'arm_view prints.'
        )
    if [_authority(each) for each in origins] not in ([], [hosts[0].lower()]):
        return f'{", ".join(origins)} is another page, which may not read this one.'
    return ''


def _is_own(authority: str, host: str) -> bool:
    """Whether a name, with or without a port, is one of this computer's, or an address."""
    try:
        name = urlsplit(f'//{authority}').hostname or ''
    except ValueError:
        return False
    own = socket.gethostname().lower()
    if name in ('localhost', host.lower(), own, f'{own}.local'):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _authority(origin: str) -> str:
    """Return host and port of an Origin; empty if it has none, such as `null`."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ''

# SPDX-License-Identifier: Apache-2.0
"""Host and port of the page, which is served to this computer only by default."""

from __future__ import annotations

import importlib.util
import socket

from blf_dsc_controller.errors import BlfDscError, MissingExtraError

LOCAL = ('127.0.0.1', 'localhost', '::1')
"""Hosts that can be reached from this computer only."""

_PORTS = 100  # tried, from the requested one on
_NOT_HERE = 99  # EADDRNOTAVAIL


def url_of(host: str, port: int) -> str:
    """Return the address to open in a browser."""
    return f'http://{"localhost" if host in LOCAL else host}:{port}'


def open_to_others(host: str) -> str:
    """Return the warning about a page that is not served to this computer only."""
    return f'at {host} the page and its controls are open to other computers, without a password'


def require_viser() -> None:
    """Raise MissingExtraError unless viser and its URDF support are installed."""
    for module in ('viser', 'yourdfpy'):
        if importlib.util.find_spec(module) is None:
            raise MissingExtraError(module, 'view', 'the page')


def free_port(host: str, port: int) -> int:
    """Return the first free port from `port` on; BlfDscError if `host` is not this computer."""
    for candidate in range(port, min(port + _PORTS, 65536)):
        family = socket.AF_INET6 if ':' in host else socket.AF_INET
        with socket.socket(family) as claim:
            claim.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                claim.bind((host, candidate))
            except PermissionError as error:
                reason = f'port {candidate} needs privileges: choose one above 1023'
                raise BlfDscError(reason) from error
            except OSError as error:
                if isinstance(error, socket.gaierror) or error.errno == _NOT_HERE:
                    reason = f'the page cannot be served at {host!r}: {error.strerror}; give an '
                    raise BlfDscError(f'{reason}address of this computer') from error
                continue
            return candidate
    raise BlfDscError(f'no free port from {port} to {port + _PORTS - 1}: choose another')

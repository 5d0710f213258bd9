# SPDX-License-Identifier: Apache-2.0
"""A ROS domain for one run alone, so that two runs at once do not hear each other."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from blf_dsc_controller.errors import BlfDscError

_DOMAINS = range(1, 101)  # 0 is everybody's, and above 101 are the ports that the system hands out


@contextmanager
def own_domain() -> Iterator[int]:
    """Hold a domain that no other run on this machine holds.

    Raises:
        BlfDscError: all are taken.
    """
    first = os.getpid() % len(_DOMAINS)
    with socket.socket(socket.AF_UNIX) as claim:
        for domain in (*_DOMAINS[first:], *_DOMAINS[:first]):
            try:
                claim.bind(f'\0blf_dsc_controller domain {domain}')
            except OSError:  # held by another process; the system lets go of it when that ends
                continue
            yield domain
            return
    raise BlfDscError(f'{len(_DOMAINS)} runs are going on at once: name a ROS domain by --domain')

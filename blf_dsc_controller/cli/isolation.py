# SPDX-License-Identifier: Apache-2.0
"""Environment in which the nodes of a run hear no others, and survive one that is killed."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import rclpy

from blf_dsc_controller.configuration.share import share_folder
from blf_dsc_controller.errors import BlfDscError

_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_DOMAINS = range(1, 101)  # 0 is the default; above 101, ports are ephemeral


def localhost_environment() -> dict[str, str]:
    """Return the environment in which nodes find only those on this computer.

    A profile that the user has chosen, and middleware other than Fast DDS, are left as they are.
    """
    profiles = str(share_folder() / 'config/fastdds.xml')
    chosen = os.environ.get(_PROFILES, profiles)
    if chosen != profiles or 'fastrtps' not in rclpy.get_rmw_implementation_identifier():
        return {_RANGE: 'LOCALHOST'}
    # With LOCALHOST, rmw_fastrtps would add shared memory to the transports of the profile.
    return {_RANGE: 'SYSTEM_DEFAULT', 'ROS_LOCALHOST_ONLY': '', _PROFILES: profiles}


@contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Temporarily change the environment of this process and its children.

    A caller in Python must not stay in a domain that the next run may claim.
    """
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


@contextmanager
def own_domain() -> Iterator[int]:
    """Claim a ROS domain that no other run on this machine holds; BlfDscError if none is free."""
    first = os.getpid() % len(_DOMAINS)
    with socket.socket(socket.AF_UNIX) as claim:
        for domain in (*_DOMAINS[first:], *_DOMAINS[:first]):
            try:
                claim.bind(f'\0blf_dsc_controller domain {domain}')
            except OSError:  # held by another process, and released when that exits
                continue
            yield domain
            return
    raise BlfDscError(f'{len(_DOMAINS)} runs are active: choose a ROS domain with --domain')

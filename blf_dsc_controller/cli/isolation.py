# SPDX-License-Identifier: Apache-2.0
"""The environment in which nodes meet nobody but each other."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata

import rclpy

from blf_dsc_controller.configuration.files import share_folder

_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_NO_OTHERS = {
    'ROS_LOCALHOST_ONLY': '',
    'ROS_STATIC_PEERS': '',
    'ROS_DISCOVERY_SERVER': '',
    'FASTDDS_ENVIRONMENT_FILE': '',
    'SKIP_DEFAULT_XML_FILE': '1',  # DEFAULT_FASTRTPS_PROFILES.xml in the current folder
}


def localhost_environment() -> dict[str, str]:
    """Return the environment in which nodes exchange messages on this computer only.

    Whatever else the shell names is overruled: a profile, peers or a server of other
    computers. Other middleware than Jazzy's Fast DDS looks for nobody elsewhere, but
    answers whoever finds it (doc/topics.md): the Fast DDS of Kilted rejects this
    package's profile, and would then find the whole network.
    """
    if not _is_jazzys_fast_dds():
        return {_RANGE: 'LOCALHOST', **_NO_OTHERS}
    # With LOCALHOST, rmw_fastrtps would add shared memory to the transports of the
    # profile.
    profiles = str(share_folder() / 'config/fastdds.xml')
    return {_RANGE: 'SYSTEM_DEFAULT', **_NO_OTHERS, _PROFILES: profiles}


def _is_jazzys_fast_dds() -> bool:
    name = rclpy.get_rmw_implementation_identifier()
    return 'fastrtps' in name and metadata.version('rclpy').startswith('7.')


@contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Temporarily change the environment of this process and its children.

    A caller in Python must not stay in a domain that the next run may claim.
    """
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)

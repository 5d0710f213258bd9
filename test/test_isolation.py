# SPDX-License-Identifier: Apache-2.0
"""The middleware's settings for the nodes of a run."""

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from blf_dsc_controller.cli import isolation
from blf_dsc_controller.cli.isolation import localhost_environment

LOCALHOST = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def test_profile_of_the_user_is_kept(monkeypatch):
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', 'own.xml')
    assert localhost_environment() == LOCALHOST


def test_other_middleware_is_limited_to_this_computer_as_well(monkeypatch):
    monkeypatch.setattr(
        isolation.rclpy, 'get_rmw_implementation_identifier', lambda: 'rmw_cyclonedds_cpp'
    )
    assert localhost_environment() == LOCALHOST

# SPDX-License-Identifier: Apache-2.0
"""The environment of the nodes of a run: the middleware's settings, and numpy's threads."""

import os
import subprocess
import sys

import pytest
from command import finished

pytest.importorskip('rclpy', reason='needs ROS 2')

from blf_dsc_controller.cli import session as isolation
from blf_dsc_controller.cli.session import localhost_environment
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.studies.runs import cores

MULTIPLY = """
import os, sys
from blf_dsc_controller.cli import main
code = getattr(main, sys.argv.pop(1))()
import numpy as np
np.ones((500, 500)) @ np.ones((500, 500))
print(code, len(os.listdir('/proc/self/task')))
"""
LOCALHOST = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def test_profile_of_the_user_is_kept_and_other_middleware_limited_as_well(monkeypatch):
    with monkeypatch.context() as own:
        own.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', 'own.xml')
        assert localhost_environment() == LOCALHOST
    name = 'get_rmw_implementation_identifier'
    monkeypatch.setattr(isolation.rclpy, name, lambda: 'rmw_cyclonedds_cpp')
    assert localhost_environment() == LOCALHOST


@pytest.mark.parametrize(
    'command',
    [('main', 'plot', '/none'), ('blf_dsc_controller', '--ros-args', '--params-file', '/none')],
)
def test_libraries_start_no_threads_unless_the_environment_asks_for_them(command):
    """Such a thread would spin beside the nodes, and at the priority of a real-time node."""
    outputs = []
    for given in ({}, {'OPENBLAS_NUM_THREADS': '1'}, {'OPENBLAS_NUM_THREADS': '2'}):
        kept = {name: value for name, value in os.environ.items() if 'NUM_THREADS' not in name}
        run = finished(sys.executable, '-c', MULTIPLY, *command, env=kept | given)
        outputs.append([int(number) for number in run.stdout.split()])
    (code, threads), same, more = outputs
    assert same == [code, threads]
    assert more == [code, threads + (cores() > 1)]  # never more than cores


def test_domain_is_held_until_the_last_node_of_a_run_has_ended(monkeypatch):
    mine = 1000 + os.getpid()  # that no other test claims
    monkeypatch.setattr(isolation, '_DOMAINS', (mine,))
    with isolation.own_domain():
        node = subprocess.Popen(
            [sys.executable, '-c', 'input()'], stdin=subprocess.PIPE, close_fds=False
        )
    with pytest.raises(BlfDscError, match='choose a ROS domain'), isolation.own_domain():
        pass
    node.communicate(b'\n')
    with isolation.own_domain() as domain:
        assert domain == mine

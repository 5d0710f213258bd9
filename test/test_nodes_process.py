# SPDX-License-Identifier: Apache-2.0
"""A node's process ends cleanly, even if a shutdown fails; what it asks of the system."""

from __future__ import annotations

import ctypes
import errno
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import finished

from blf_dsc_controller.cli import session as isolation
from blf_dsc_controller.cli.session import localhost_environment
from blf_dsc_controller.configuration.robot import Realtime
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.process import request_realtime
from blf_dsc_controller.studies.runs import cores

BROKEN = """
from pathlib import Path
import rclpy
from rclpy._rclpy_pybind11 import RCLError
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.process import run

class Broken({node}):
    def _on_poll(self):
        self.finished = True

    def close(self):
        raise {error}('the middleware is gone')

code = run(Broken)
names = [(task / 'comm').read_text().strip() for task in Path('/proc/self/task').iterdir()]
print(code, rclpy.ok(), [name for name in names if name.startswith('dds.')])
"""


@pytest.mark.parametrize(
    ('node', 'error'),
    [('ControllerNode', 'RCLError'), ('PlantNode', 'OSError'), ('PlantNode', 'BlfDscError')],
)
def test_middleware_ends_with_the_node_even_if_its_shutdown_fails(node, error):
    """And not only with the process: otherwise its threads may crash at the end."""
    process = finished(sys.executable, '-c', BROKEN.format(node=node, error=error))
    assert process.stdout == '0 False []\n', process.stderr
    assert process.stderr.endswith(' could not shut down cleanly: the middleware is gone\n')
    assert 'Traceback' not in process.stderr


@pytest.mark.parametrize('refused', [False, True])
def test_real_time_is_requested_for_all_threads_and_a_refusal_named_with_its_remedy(
    monkeypatch, refused
):
    """Whether the system refuses depends on the user, so it is replaced here."""
    scheduled, lines = set(), []

    def schedule(thread, policy, parameters):
        if refused:
            raise PermissionError(errno.EPERM, 'Operation not permitted')
        scheduled.add((thread, policy, parameters.sched_priority))

    def mlockall(flags):
        assert flags == 1 | 2  # MCL_CURRENT | MCL_FUTURE of Linux
        ctypes.set_errno(errno.ENOMEM)
        return -refused

    monkeypatch.setattr(os, 'sched_setscheduler', schedule)
    monkeypatch.setattr(ctypes, 'CDLL', lambda *_, **__: SimpleNamespace(mlockall=mlockall))
    log = SimpleNamespace(warning=lines.append)
    request_realtime(Realtime(), log)
    assert (scheduled, lines) == (set(), [])
    request_realtime(Realtime(priority=50, lock_memory=True), log)
    if refused:
        wanted = ['(Operation not permitted)', 'rtprio', '(Cannot allocate memory)', 'memlock']
        assert all(word in lines[k // 2] for k, word in enumerate(wanted))
        return
    threads = {int(name) for name in os.listdir('/proc/self/task')}  # noqa: PTH208
    assert scheduled == {(thread, os.SCHED_FIFO, 50) for thread in threads}
    assert lines == []


# The environment of the nodes of a run: the middleware's settings, domains, numpy's threads.

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
    with pytest.raises(BlfDscError, match='no ROS domain is free'), isolation.own_domain():
        pass
    node.communicate(b'\n')
    with isolation.own_domain() as domain:
        assert domain == mine

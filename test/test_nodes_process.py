# SPDX-License-Identifier: Apache-2.0
"""A node's process ends cleanly, and so does the middleware in it, even if a shutdown fails."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

BROKEN = """
import rclpy
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.process import PlainNode, run
from blf_dsc_controller.nodes.endpoints import RCLError

class Broken(PlainNode):
    finished = True

    def close(self):
        raise {error}('the middleware is gone')

    def destroy_node(self):
        super().destroy_node()
        print('destroyed')

print(run(lambda: Broken('broken')), rclpy.ok())
"""


ENDED = """
from pathlib import Path
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.process import run
from blf_dsc_controller.nodes.plant_node import PlantNode

class Ended({node}):
    def _on_poll(self):
        self.finished = True

print(run(Ended))
names = [(task / 'comm').read_text().strip() for task in Path('/proc/self/task').iterdir()]
print(sorted(name for name in names if name.startswith('dds.')))
"""


@pytest.mark.parametrize('node', ['ControllerNode', 'PlantNode'])
def test_middleware_ends_with_the_node_and_not_only_with_the_process(node):
    process = subprocess.run(
        [sys.executable, '-c', ENDED.format(node=node)], capture_output=True, text=True, check=False
    )
    assert process.stdout == '0\n[]\n', process.stderr


@pytest.mark.parametrize('error', ['RCLError', 'OSError', 'BlfDscError'])
def test_error_during_shutdown_leaves_neither_node_nor_context(error):
    process = subprocess.run(
        [sys.executable, '-c', BROKEN.format(error=error)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.stdout == 'destroyed\n0 False\n', process.stderr
    assert process.stderr.endswith('broken could not shut down cleanly: the middleware is gone\n')
    assert 'Traceback' not in process.stderr

# SPDX-License-Identifier: Apache-2.0
"""A node's process ends cleanly, even if its shutdown fails."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

BROKEN = """
import rclpy
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.process import PlainNode, run
from blf_dsc_controller.nodes.rclpy_internals import RCLError

class Broken(PlainNode):
    finished = True

    def close(self):
        raise {error}('the middleware is gone')

    def destroy_node(self):
        super().destroy_node()
        print('destroyed')

print(run(lambda: Broken('broken')), rclpy.ok())
"""


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

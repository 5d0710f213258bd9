# SPDX-License-Identifier: Apache-2.0
"""Some seconds of the soak test, in a separate process; `make soak` runs half an hour."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')


@pytest.mark.nightly
def test_loop_survives_a_short_soak():
    """The script checks by itself: the bound outside of faults, memory and handles."""
    script = Path(__file__).with_name('soak.py')
    run = subprocess.run(
        [sys.executable, str(script), '--minutes', '0.3', '--seed', '2'],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert 'largest error against the bound' in run.stderr

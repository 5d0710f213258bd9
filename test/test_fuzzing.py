# SPDX-License-Identifier: Apache-2.0
"""A few fixed examples of each property in fuzzing.py, and some seconds of soak.py.

`make fuzz` tries more examples, `make soak` runs half an hour.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import fuzzing
import pytest
from hypothesis import HealthCheck, Phase, settings

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')

pytestmark = pytest.mark.nightly

FEW = settings(
    max_examples=8,
    phases=(Phase.generate,),
    suppress_health_check=list(HealthCheck),
)


@pytest.mark.parametrize('check', fuzzing.PROPERTIES, ids=lambda check: check.__name__)
def test_arbitrary_input_is_survived(check):
    FEW(check)()


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

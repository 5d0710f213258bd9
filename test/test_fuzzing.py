# SPDX-License-Identifier: Apache-2.0
"""A few examples of each property of fuzzing.py, always the same; `make fuzz` looks for more."""

from __future__ import annotations

import fuzzing
import pytest
from hypothesis import HealthCheck, Phase, settings

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')

FEW = settings(
    max_examples=8,
    deadline=None,
    derandomize=True,
    phases=(Phase.generate,),
    suppress_health_check=list(HealthCheck),
)


@pytest.mark.parametrize('one', fuzzing.PROPERTIES, ids=lambda one: one.__name__)
def test_whatever_comes_from_outside_is_survived(one):
    FEW(one)()

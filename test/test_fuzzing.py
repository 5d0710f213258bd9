# SPDX-License-Identifier: Apache-2.0
"""A few fixed examples of each property in fuzzing.py; `make fuzz` tries more."""

from __future__ import annotations

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

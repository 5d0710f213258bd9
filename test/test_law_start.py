# SPDX-License-Identifier: Apache-2.0
"""A start outside the barrier is rejected, naming joint, error and bound."""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import JOINTS, START, controller, recommended

from blf_dsc_controller.errors import BlfDscError, OutsideBarrierError


@pytest.mark.parametrize('error', [0.002, -0.0021, 1.5, np.nan])
@pytest.mark.parametrize('joint', [0, 1])
def test_start_outside_the_barrier_is_rejected_by_name(joint, error):
    law = controller(recommended())
    q = np.array([1.9935, 1.3961]) + 0.3  # the reference at t = 0
    law.check_start(JOINTS, q)
    q[joint] += error * (1.0 + 1e-9)

    with pytest.raises(OutsideBarrierError) as caught:
        law.check_start(JOINTS, q)

    assert isinstance(caught.value, BlfDscError)
    assert (caught.value.joint, caught.value.bound) == (JOINTS[joint], 0.002)
    assert caught.value.error == pytest.approx(error, rel=1e-6, nan_ok=True)
    for part in (JOINTS[joint], f'{error:+.6g} rad', '0.002 rad'):
        assert part in str(caught.value)


def test_start_is_checked_against_the_reference_at_its_time():
    law = controller(recommended())
    law.check_start(JOINTS, np.array(START))
    with pytest.raises(OutsideBarrierError):
        law.check_start(JOINTS, np.array(START), t=0.2)

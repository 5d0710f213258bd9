# SPDX-License-Identifier: Apache-2.0
"""The supervisor's short way past a stamp that is as it should be, against the long one."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from blf_dsc_controller.configuration.controller import Safety
from blf_dsc_controller.supervision.reasons import Phase
from blf_dsc_controller.supervision.supervisor import Supervisor, Verdict

STILL = np.zeros(2)
SAFETY = Safety()
# Repeated, early, usual, jittering, missed and much too late; now and then backwards.
STEPS = st.sampled_from([0, 1, 499_999, 500_001, 1_000_000, 1_000_001, 1_499_999, 1_500_001])
RARE_STEPS = st.sampled_from([2_000_000, 3_000_000, 41_000_000, 50_000_000, -1_000_000])


class Careful(Supervisor):
    """Takes the long way with each stamp."""

    def _is_next(self, _stamp):
        return False


@given(steps=st.lists(STEPS | RARE_STEPS | st.just(1_000_000), max_size=60))
def test_the_quick_look_at_a_stamp_is_the_careful_one(steps):
    quick, careful = Supervisor(['joint1', 'joint2'], 1e-3), Careful(['joint1', 'joint2'], 1e-3)
    for one in (quick, careful):
        one.enter(Phase.STARTING)
        one.enter(Phase.TRACKING)
    stamp = 1_000_000_000
    for step in steps:
        stamp += step
        verdicts = [one.check_state(SAFETY, stamp, STILL, STILL) for one in (quick, careful)]
        assert verdicts[0] is verdicts[1]
        for of in ('reason', 'text', 'repeated', 'stops', 'revision'):
            assert getattr(quick, of) == getattr(careful, of)
        assert vars(quick.overruns) == vars(careful.overruns)


def test_a_velocity_is_looked_at_on_the_quick_way_too():
    supervisor = Supervisor(['joint1', 'joint2'], 1e-3)
    supervisor.enter(Phase.STARTING)
    supervisor.enter(Phase.TRACKING)
    assert supervisor.check_state(SAFETY, 1_000_000_000, STILL, STILL) is Verdict.USE
    too_fast = np.array([0.0, 2.0 * SAFETY.velocity_limit])
    assert supervisor.check_state(SAFETY, 1_001_000_000, STILL, too_fast) is Verdict.STOP

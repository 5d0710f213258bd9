# SPDX-License-Identifier: Apache-2.0
"""Injected faults: when they are detected, what is commanded from then on, and the reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fault_table import FAULTS, page, run

from blf_dsc_controller.supervision.supervisor import Reason

LIMIT = 20.0  # N m, the default torque limit


@pytest.mark.parametrize('fault', FAULTS, ids=lambda fault: fault.name)
def test_fault_is_detected_and_named_and_the_loop_recovers(fault):
    outcome = run(fault)

    assert outcome.reason is fault.reason, outcome.text
    for commands in (outcome.before, outcome.after):
        assert np.isfinite(commands).all()
        assert (np.abs(commands) <= LIMIT).all()
    # A controller that never started stays silent.
    assert bool(len(outcome.after)) == (fault.reason is not Reason.START_REJECTED)
    if fault.reason is Reason.NONE:
        assert outcome.noticed == -1
        assert outcome.error < 1.0
    else:
        assert 1 <= outcome.noticed <= fault.within
        assert outcome.text
        # The default safe torque is zero; above all, the last torque is not repeated.
        assert not outcome.after.any()
        assert outcome.last.all()
    assert outcome.recovered


def test_invalid_command_is_counted_and_does_no_harm():
    invalid = [fault for fault in FAULTS if fault.name.startswith('one command')]
    assert [run(fault).rejected for fault in invalid] == [1] * 4


def test_at_least_thirty_distinct_faults_cover_the_reasons():
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 30
    assert {fault.reason for fault in FAULTS} == set(Reason) - {Reason.FAILED}


def test_faults_page_is_up_to_date():
    path = Path(__file__).parents[1] / 'doc/faults.md'
    assert path.read_text() == page(), 'run: python test/fault_table.py doc/faults.md'

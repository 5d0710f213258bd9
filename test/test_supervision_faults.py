# SPDX-License-Identifier: Apache-2.0
"""What is injected, when it is noticed, the commands from then on, and the reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fault_table import FAULTS, page, run

from blf_dsc_controller.supervision.supervisor import Reason

LIMIT = 20.0  # N m, the default torque limit


@pytest.mark.parametrize('fault', FAULTS, ids=lambda fault: fault.name)
def test_a_fault_is_detected_named_and_overcome(fault):
    outcome = run(fault)

    assert outcome.reason is fault.reason, outcome.text
    for commands in (outcome.before, outcome.after):
        assert np.isfinite(commands).all()
        assert (np.abs(commands) <= LIMIT).all()
    assert len(outcome.after)
    if fault.reason is Reason.NONE:
        assert outcome.noticed == -1
        assert outcome.error < 1.0
    else:
        assert 1 <= outcome.noticed <= fault.within
        assert outcome.text
        # The safe torque is the default one; above all it is not the last one over again.
        assert not outcome.after.any()
        assert outcome.last.all()
    assert outcome.recovered


def test_a_command_that_will_not_do_is_counted_and_does_no_harm():
    wrong = [fault for fault in FAULTS if fault.name.startswith('one command')]
    assert [run(fault).rejected for fault in wrong] == [1] * 4


def test_there_are_thirty_faults_that_differ():
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 30
    assert {fault.reason for fault in FAULTS} == set(Reason) - {Reason.FAILED}


def test_the_page_of_faults_is_current():
    path = Path(__file__).parents[1] / 'doc/faults.md'
    assert path.read_text() == page(), 'run: python test/fault_table.py doc/faults.md'

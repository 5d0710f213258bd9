# SPDX-License-Identifier: Apache-2.0
"""The study of contacts: what it counts, and that it is one command."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmark import contacts
from benchmark.__main__ import main

MS = 0.001  # s, a sample


def test_alarm_counts_once_until_it_has_been_calm():
    distance = np.zeros(1000)
    distance[[100, 150, 400, 401]] = 5.0
    assert contacts.alarms(distance, 4.0, calm=200) == 2
    assert contacts.alarms(distance, 4.0, calm=20) == 3
    assert contacts.alarms(distance, 5.0, calm=20) == 0


def test_threshold_has_at_most_the_wanted_false_alarms():
    """Of two hours with alarms of the heights 1 to 40, 10 per hour leave 20."""
    hours = [np.zeros(3600), np.zeros(3600)]
    for k in range(40):
        hours[k % 2][80 * (k // 2 + 1)] = k + 1.0
    assert contacts.threshold_at(10.0, hours, 1.0) == pytest.approx(20.0, abs=1e-6)
    assert contacts.threshold_at(0.0, hours, 1.0) == pytest.approx(40.0, abs=1e-6)


def test_delay_is_that_of_the_first_sample_past_the_threshold():
    pushed = [np.array([0.0, 1.0, 3.0]), np.array([0.0, np.nan, np.nan])]
    assert contacts.delays(pushed, 2.0, MS).tolist() == [2.0 * MS, np.inf]


def test_learned_model_finds_pushes_sooner_than_the_urdf(tmp_path, capsys):
    """Of two arms, without any false alarm; the table and the picture are there."""
    out = tmp_path / 'study'
    assert main(['contacts', '--arms', '2', '--force', '20', '--out', str(out)]) == 0
    (found,) = json.loads((out / 'contacts.json').read_text()).values()
    median = {name: found[name]['0']['median'] for name in contacts.DETECTORS}
    assert median[contacts.LEARNED] < 0.5 * median[contacts.TOLD]
    assert median[contacts.LEARNED] < 0.5 * median[contacts.USUAL]
    assert found['default']['pick-ups taken for a contact'] == 0
    printed = capsys.readouterr().out
    assert '20 N at the tip, 2 arms' in printed
    assert (out / 'contacts.png').stat().st_size > 10_000

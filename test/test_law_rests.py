# SPDX-License-Identifier: Apache-2.0
"""Motions with rests, and friction unlike the assumed one: only true changes and loads."""

from __future__ import annotations

import numpy as np
import pytest

from benchmark import nothing_changes


@pytest.fixture
def study():
    return nothing_changes


def run_of(study, arm, motion, seed, load):
    return study.found(
        study.recorded(study.loop_of(arm, seed, load), motion, seed), load
    )


def test_insertion_by_an_arm_whose_friction_is_unknown_is_no_change(study):
    """Eight changes were found in 32 s, and 38 % of the weights were outside their intervals."""
    run = run_of(study, 'ur5e_rigid', 'insertion', 10, 0.0)
    assert run.changes.size == 0
    assert len(run.readings) > 100
    assert study.outside(run.readings).mean() <= 0.05


def test_true_load_is_found_as_soon_in_the_same_insertion(study):
    """It was found after 0.13 s, among seven changes that were none."""
    run = run_of(study, 'ur5e_rigid', 'insertion', 10, study.LOAD)
    assert run.changes == pytest.approx([study.PICK_UP + 0.2], abs=0.2)
    held = run.readings[run.readings[:, 0] > study.PICK_UP + 5.0]
    assert len(held) > 50
    assert not study.outside(held).any()
    assert np.median(held[:, 2]) == pytest.approx(study.LOAD, abs=0.2)

# SPDX-License-Identifier: Apache-2.0
"""Motions with rests, and friction unlike the assumed one: only true changes and loads."""

from __future__ import annotations

import numpy as np
import pytest

from benchmark import nothing_changes


@pytest.fixture
def study():
    return nothing_changes


def run_of(study, arm, motion, seed, load, **friction):
    loop = study.loop_of(arm, seed, load, **friction)
    return study.found(study.recorded(loop, motion, seed), load)


def test_insertion_by_an_arm_whose_friction_is_unknown_is_no_change(study):
    """Eight changes were found in 32 s, and 38 % of the weights were outside their intervals."""
    run = run_of(study, 'ur5e_rigid', 'insertion', 10, 0.0)
    assert run.changes.size == 0
    assert len(run.readings) > 100
    assert study.outside(run.readings).mean() <= 0.05


@pytest.mark.parametrize(
    ('seed', 'motion'), [(13, 'pick'), (101, 'trapezoids'), (208, 'pick')]
)
def test_first_stop_of_an_arm_whose_drives_are_heavier_than_guessed_is_no_change(
    study, monkeypatch, seed, motion
):
    """Five times as heavy.  A change was found at 2.1 s, as the arm stopped and moved on."""
    monkeypatch.setattr(study, 'DURATION', 3.0)
    guess = study.load_loop('ur5e').controller.robot
    truth = study.load_loop('ur5e').plant.truth.rotor_inertia
    chain = guess.chain(study.load_loop('ur5e').controller.joints)
    np.testing.assert_allclose(truth, 5.0 * guess.rotors(chain))
    assert run_of(study, 'ur5e', motion, seed, 0.0).changes.size == 0


def test_load_of_such_an_arm_is_found_although_it_has_moved_for_a_second_only(
    study, monkeypatch
):
    """1.5 kg.  No change was found within 3.5 s: the wrong drives had raised the noise."""
    monkeypatch.setattr(study, 'DURATION', 2.5)
    monkeypatch.setattr(study, 'PICK_UP', 1.0)
    run = run_of(study, 'ur5e', 'sinusoids', 1, 1.5)
    assert run.changes == pytest.approx([study.PICK_UP + 0.3], abs=0.1)


def test_true_load_is_found_as_soon_in_the_same_insertion(study):
    """It was found after 0.13 s, among seven changes that were none."""
    run = run_of(study, 'ur5e_rigid', 'insertion', 10, study.LOAD)
    assert run.changes == pytest.approx([study.PICK_UP + 0.2], abs=0.2)
    held = run.readings[run.readings[:, 0] > study.PICK_UP + 5.0]
    assert len(held) > 50
    assert not study.outside(held).any()
    assert np.median(held[:, 2]) == pytest.approx(study.LOAD, abs=0.2)


def test_load_is_weighed_though_gears_lose_15_percent_of_the_torque_they_carry(study):
    """57 % of the weights were outside of their intervals, by up to six times these."""
    run = run_of(study, 'panda', 'trapezoids', 1, 2.0, load_share=0.15)
    assert len(run.readings) > 200
    assert study.outside(run.readings).mean() <= 0.05
    assert np.median(run.readings[-50:, 3]) < 0.05  # kg: no wider than before


def test_load_is_weighed_though_friction_falls_by_40_percent(study):
    """It was 2.61 +- 0.40 kg after 8 s."""
    friction = {'warm_factor': 0.6, 'warm_time': 10.0}
    run = run_of(study, 'ur5e', 'trapezoids', 1, 2.0, **friction)
    held = run.readings[run.readings[:, 0] > study.PICK_UP]
    assert len(held) > 100
    assert study.outside(held).mean() <= 0.05


@pytest.mark.parametrize('arm', nothing_changes.ARMS)
def test_law_is_told_what_its_arm_shows_as_efforts(study, arm):
    """A rigid arm was told to have torque sensors behind its gears: 38 of 43 false contacts."""
    loop = study.loop_of(arm, 11, 0.0)
    robot, friction = loop.controller.robot, loop.plant.disturbance
    assert robot.torque_loop == (loop.plant.actuator.loop_gain > 0.0)
    if not robot.torque_loop:
        assumed = robot.friction(robot.chain(loop.controller.joints))
        ratio = np.array(friction.coulomb) / assumed['coulomb']
        assert np.all((ratio >= study.FRICTION[0]) & (ratio <= study.FRICTION[1]))

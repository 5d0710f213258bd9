# SPDX-License-Identifier: Apache-2.0
"""What the drives are told of a weighed load, step by step, and what the law makes of it."""

from __future__ import annotations

import numpy as np
import pytest

from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.factory.controller import controller_of
from blf_dsc_controller.law.contact import QUIET, TOUCHED
from blf_dsc_controller.law.torque import added_torque
from blf_dsc_controller.supervision.drive_load import DriveLoad, DriveLoads
from blf_dsc_controller.supervision.guard import Guard

CONFIG = change(
    load_loop('fr3_direct').controller,
    {'load.tell_drive': True, 'robot.drive_payload': 0.5},
)
CENTRE = (0.01, -0.02, 0.05)  # m
SURE = (0.01, 0.005, 0.005, 0.005)  # kg and m, standard deviations


@pytest.fixture
def law():
    """A law whose arm rests in the posture of the preset's reference."""
    law = controller_of(CONFIG)
    q = np.array(CONFIG.reference.offset)
    law.update(0.0, 1e-3, np.concatenate((q, np.zeros(14))))
    return law


def weigh(law, mass, deviations=SURE):
    """Let the law have weighed a load [kg] with these deviations [kg, m, m, m]."""
    law.state.weighing.load[:] = (mass, *CENTRE, *deviations)


def added_mass(law, before):
    """Return by how much more mass [kg] of the last link the law leaves to the drives."""
    change = law.settings.torque.drive_inertias - before
    return float(change.reshape(-1, 4)[-1, 0])


def test_load_is_told_in_steps_of_half_a_percent_of_a_torque_limit(law):
    loads = DriveLoads(CONFIG)
    weigh(law, 2.0)
    told = []
    while (load := loads.begin_step(law)) is not None:
        before = law.state.saturation.added.copy()
        loads.take(law, load)
        told.append(load.mass)
        step = np.abs(law.state.saturation.added - before) / law.settings.torque.limit
        assert step.max() < 0.005 * (1.0 + 1e-9)
    assert len(told) > 10
    assert (np.diff(told) > 0.0).all()
    assert loads.in_force.mass == pytest.approx(2.5)  # with the declared 0.5 kg
    np.testing.assert_allclose(loads.in_force.moments[1:], 2.0 * np.array(CENTRE))


@pytest.mark.parametrize(
    ('mass', 'deviations', 'phase', 'is_told'),
    [
        (2.0, SURE, QUIET, True),
        (2.0, SURE, TOUCHED, False),  # something touches the arm
        (0.04, SURE, QUIET, False),  # kg, within 0.05: no change
        (0.06, SURE, QUIET, True),
        (2.0, (0.05, 0.0, 0.005, 0.005), QUIET, False),  # no interval of the centre yet
        (2.0, (0.05, 0.005, 0.005, 0.005), QUIET, True),  # 0.098 kg, less than 5 %
        (2.0, (0.052, 0.005, 0.005, 0.005), QUIET, False),
        (0.5, (0.025, 0.005, 0.005, 0.005), QUIET, True),  # 0.049 kg, less than 0.05
        (0.5, (0.026, 0.005, 0.005, 0.005), QUIET, False),
        (2.0, (0.0, 0.005, 0.005, 0.005), QUIET, False),  # not weighed yet
        (2.0, (0.01, 0.005, 0.005, 0.015), QUIET, True),  # 0.0294 m, less than 0.03
        (2.0, (0.01, 0.005, 0.005, 0.016), QUIET, False),
    ],
)
def test_only_a_load_that_is_well_known_is_told(law, mass, deviations, phase, is_told):
    weigh(law, mass, deviations)
    law.state.contact.phase[0] = phase
    assert (DriveLoads(CONFIG).begin_step(law) is not None) == is_told


def test_no_load_is_told_while_the_law_is_not_in_command():
    guard = Guard(change(CONFIG, {'safety.first_torque': 'send'}))
    guard.starting.activate()
    weigh(guard.controller, 2.0)
    assert guard.load_to_tell() is None
    rest = np.concatenate((CONFIG.reference.offset, np.zeros(14)))
    assert guard.update(10**9, rest) is not None
    weigh(guard.controller, 2.0)
    assert guard.load_to_tell() is not None
    guard.fail('why')
    assert guard.load_to_tell() is None


def test_load_that_the_drives_have_is_left_to_them_by_other_gains():
    guard = Guard(CONFIG)
    guard.take_over(DriveLoad(2.5, CENTRE))
    told = guard.controller.settings.torque.drive_inertias.copy()
    guard.retune(change(CONFIG, {'learning.weight': 2.0}))
    np.testing.assert_array_equal(guard.controller.settings.torque.drive_inertias, told)


def test_law_leaves_to_the_drives_what_they_were_told_since_it_began(law):
    """After a reset it knows of no load, so what they have been told holds that load."""
    loads = DriveLoads(CONFIG)
    before = law.settings.torque.drive_inertias.copy()
    loads.take(law, DriveLoad(2.5, CENTRE))
    assert added_mass(law, before) == pytest.approx(2.0)
    loads.forget(law)
    assert added_mass(law, before) == 0.0
    loads.take(law, DriveLoad(3.5, CENTRE))
    assert added_mass(law, before) == pytest.approx(1.0)


def test_reset_of_a_stopped_arm_carries_on_without_what_the_drives_hold():
    """The whole torque stays: what the law forgets of the drives is in no command."""
    given = {'safety.first_torque': 'send', 'safety.torque': 'hold_gravity'}
    guard = Guard(change(CONFIG, given))
    guard.starting.activate()
    q = np.array(CONFIG.reference.offset)
    rest = np.concatenate((q, np.zeros(14)))
    assert guard.update(10**9, rest) is not None
    guard.take_over(DriveLoad(2.5, CENTRE))
    guard.fail('why')
    guard.update(10**9 + 10**6, rest)
    law = guard.controller
    carried = guard.safe_stop.carried(guard.config.safety)
    added = added_torque(law.settings.torque, q)
    guard.starting.reset()
    forgotten = added - added_torque(law.settings.torque, q)
    assert np.abs(forgotten).max() > 1.0  # N m
    now = guard.starting._takeover.carried
    np.testing.assert_allclose(now, carried - forgotten, atol=1e-9)


def test_load_that_is_put_down_after_a_reset_leaves_what_it_held(law):
    """The law then weighs the whole load as negative, in the frame of its own begin."""
    loads = DriveLoads(CONFIG)
    loads.take(law, DriveLoad(2.5, CENTRE))
    loads.forget(law)
    weigh(law, -1.0)
    for _ in range(100):
        load = loads.begin_step(law)
        if load is None:
            break
        loads.take(law, load)
    assert loads.in_force.mass == pytest.approx(1.5)
    np.testing.assert_allclose(loads.in_force.centre, CENTRE)


def test_told_load_is_left_as_it_is_until_another_is_weighed(law):
    """Small changes are told as the rest of a load only, not as one of its own."""
    loads = DriveLoads(CONFIG)
    loads.take(law, DriveLoad(2.5, CENTRE))
    weigh(law, 2.05)
    assert loads.begin_step(law) is None
    weigh(law, 2.2)
    assert loads.begin_step(law) is not None  # the first of several steps ...
    weigh(law, 2.05)
    assert loads.begin_step(law) is not None  # ... which are carried on
    loads.forget(law)
    weigh(law, 0.0)
    assert loads.begin_step(law) is None

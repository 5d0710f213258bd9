# SPDX-License-Identifier: Apache-2.0
"""What a law keeps at each start, by the table of `law.start` and by its effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenario import Scenario, carrying

import blf_dsc_controller as blf
from blf_dsc_controller.law.start import KEPT, Start
from sim_plant.plant import plant_of

STRETCHED = [0.0, -0.2, 0.2, 0.0, 0.0, 0.0]
FOLDED = [3.0, -2.94, -0.2, -3.0, 0.0, 0.0]


def leaves(part):
    """Return all numbers of a part of the state, one after the other."""
    if isinstance(part, tuple):
        return np.concatenate([leaves(each) for each in part])
    return np.ravel(part)


@pytest.mark.parametrize('start', Start)
def test_part_goes_on_at_a_start_if_the_table_names_it_and_else_begins_as_at_the_first(
    start,
):
    law = blf.controller_of(blf.load_loop('ur5e').controller)
    law.reset()
    initial = {name: leaves(part).copy() for name, part in law.state._asdict().items()}
    law.state_vector[:] = np.random.default_rng(1).uniform(
        1.0, 2.0, law.state_vector.size
    )
    before = {name: leaves(part).copy() for name, part in law.state._asdict().items()}
    law.begin(start)
    for name, part in law.state._asdict().items():
        expected = before if name in KEPT[start] else initial
        np.testing.assert_array_equal(leaves(part), expected[name], err_msg=name)


def test_gap_that_is_allowed_leaves_the_weighed_load_alone():
    """States that were missing for 35 ms, of 40, made 2.00 kg of it 0.00 +- 0.08 kg."""
    arm = Scenario('ur5e', plant=carrying(2.0, 4.0))
    before = arm.run(10.0)
    assert arm.controller.load.mass == pytest.approx(2.0, abs=0.1)
    arm.run(0.035, spoil=lambda _: ())
    after = arm.run(0.2)
    assert arm.is_running, arm.text
    assert after.ratio < max(0.3, before.ratio)
    assert arm.controller.load.mass == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize('back', ['start', 'reset'])
def test_arm_that_is_elsewhere_by_the_next_activation_gets_no_torque_of_its_old_posture(
    back,
):
    """A UR5e with 5 kg got 13 of 59 N m, and fell by 0.27 rad at 1.05 rad/s."""
    hold = {'reference.type': 'hold'}
    arm = Scenario('ur5e', hold, plant=carrying(5.0) | {'initial.position': STRETCHED})
    arm.run(3.0)
    arm.controller.stop()
    arm.run(1.0)
    given = {'sim_plant': carrying(5.0) | {'initial.position': FOLDED}}
    elsewhere = blf.load_loop('ur5e', given).plant
    fresh = Scenario('ur5e', hold, plant=plant_of(elsewhere))
    arm.plant = plant_of(elsewhere)
    expected = fresh.run(1.0)
    getattr(arm.controller, back)()
    found = arm.run(1.0, spoil=lambda state: [replace(state, stamp=state.stamp + 20.0)])
    np.testing.assert_allclose(found.torque[0], expected.torque[0], atol=1.0)
    assert found.speed.max() < expected.speed.max() + 0.1


def test_load_that_came_during_a_stop_is_carried_by_the_law_that_is_activated_again():
    """The stop has found it, and d^3 from before the fault has not."""
    arm = Scenario('panda', {'reference.type': 'hold'}, plant=carrying(2.0, 2.0, 0.5))
    arm.run(1.0)
    arm.controller.fail('by hand')
    resting = arm.run(4.0)
    assert resting.speed[-1].max() < 0.01
    arm.controller.start()
    after = arm.run(0.5)
    assert arm.is_running, arm.text
    np.testing.assert_allclose(after.torque[0], resting.torque[-1], atol=0.5)
    assert np.abs(after.q - resting.q[-1]).max() < 0.01

# SPDX-License-Identifier: Apache-2.0
"""Torque ripple that `identify` finds, and that which is not there."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from random_arm import reference_of

from benchmark.ripple import amplitudes_of, config_of, found_along, found_of
from blf_dsc_controller.commissioning.slow_motion import slow_frequencies
from blf_dsc_controller.configuration.nodes import PLANT, load_loop
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.identification.ripple import (
    NOTHING,
    Ripple,
    Ripples,
    listed_cycles,
)
from blf_dsc_controller.identification.summary import ripple_table
from blf_dsc_controller.simulation.loop import simulate

LOAD = {'begin': [10.0], 'duration': [100.0], 'payload': [3.0]}


def found_in(
    cycles, preset='ur5e', *, seed=0, pace=1.0, reach=1.0, events=None, load=None
):
    """Return what is found of an arm with N of each joint, and the true amplitudes."""
    config = config_of(preset, seed, **(events or {}))
    reference = reference_of(config.robot.chain(config.joints), seed)
    reference = reference._replace(amplitude=reach * reference.amplitude)
    n = len(config.joints)
    true = [cycles[i % len(cycles)] for i in range(n)]
    return found_of(config, true, reference, pace, load), amplitudes_of(config)


def check(found, amplitudes, cycles):
    """Check that all joints have these ripples, and no others."""
    for i, (own, amplitude) in enumerate(zip(found, amplitudes, strict=True)):
        true = cycles[i % len(cycles)]
        assert sorted(each.cycles for each in own.found) == pytest.approx(
            true, rel=0.02
        )
        for each in own.found:
            assert each.amplitude == pytest.approx(amplitude, rel=0.4)


@pytest.mark.parametrize(
    ('preset', 'cycles', 'pace'),
    [
        ('ur5e', [[12.5]], 1.0),
        ('ur5e', [[20.0, 50.0]], 1.0),
        ('ur5e', [[20.0], [50.0]], 1.0),
        ('ur5e', [[100.0]], 1.0),
        ('panda', [[30.0]], 1.0),
    ],
)
def test_ripples_are_found(preset, cycles, pace):
    found, amplitudes = found_in(cycles, preset, pace=pace)
    check(found, amplitudes, cycles)
    every = sorted({N for own in cycles for N in own})
    assert sorted(listed_cycles(found)) == pytest.approx(every, rel=5e-3)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('preset', ['ur5e', 'panda'])
def test_no_ripple_is_claimed_where_there_is_none(preset, seed):
    found, amplitudes = found_in([[]], preset, seed=seed)
    assert not any(own.found for own in found)
    assert listed_cycles(found) == ()
    assert all(own.is_known for own in found)
    least = np.array([own.least for own in found])
    assert (least < 2.0 * amplitudes).all()


def test_a_load_that_is_picked_up_does_not_hide_a_ripple():
    found, amplitudes = found_in([[30.0]], events=LOAD, load=10.0)
    check(found, amplitudes, [[30.0]])


@cache
def along_reference(preset, *, slow, ripple):
    """Return what is found of an arm in its closed loop, for 30 s without a load."""
    nothing = {f'events.{name}': () for name in ('begin', 'duration', 'payload')}
    given = {'duration': 30.0, 'actuator.ripple': ripple, **nothing}
    loop = load_loop(preset, {PLANT: given})
    controller = loop.controller
    if slow:
        rates = list(slow_frequencies(controller))
        controller = change(controller, {'reference.frequency': rates})
    return found_along(simulate(controller, loop.plant).run(), controller)


def test_motion_that_repeats_is_told():
    """An FR3's drives compensate friction, not exactly: that repeats, and passes for ripples."""
    found = along_reference('fr3', slow=False, ripple=0.0)
    assert listed_cycles(found)
    assert all(own.repeats for own in found)
    assert listed_cycles(along_reference('fr3', slow=True, ripple=0.0)) == ()


def test_an_arm_that_hardly_moves_shows_no_ripple():
    found, _ = found_in([[30.0]], reach=0.02)
    assert found == (NOTHING,) * 6


def test_a_list_has_what_disturbs_most_once():
    def joint(*found, seen=5.0):
        return Ripples(found, (seen, 200.0), 0.1, 0.5)

    a = Ripple(29.97, 0.02, 1.2, 0.02)
    same = Ripple(30.06, 0.05, 1.1, 0.02)
    weak = Ripple(60.0, 0.1, 0.3, 0.02)
    weakest = Ripple(101.0, 0.2, 0.1, 0.02)
    other = Ripple(12.5, 0.02, 0.6, 0.02)
    joints = [joint(weak, a), joint(same), joint(weakest), NOTHING, joint(other)]
    assert listed_cycles(joints) == (30.0, 12.5, 60.0)
    assert listed_cycles([NOTHING]) == ()


def test_the_table_has_units_and_the_line_to_paste():
    joints = [
        SimpleNamespace(name='turns', kind='revolute'),
        SimpleNamespace(name='slides', kind='prismatic'),
        SimpleNamespace(name='quiet', kind='revolute'),
        SimpleNamespace(name='rests', kind='revolute'),
    ]
    ripples = (
        Ripples((Ripple(29.98, 0.05, 1.2, 0.02),), (5.0, 200.0), 0.1, 0.5),
        Ripples((Ripple(250.0, 0.1, 3.0, 0.5),), (50.0, 300.0), 0.1, 3.0),
        Ripples((), (5.0, 180.0), 0.123, 0.5),
        NOTHING,
    )
    arm = SimpleNamespace(chain=SimpleNamespace(joints=joints), ripples=ripples)
    (text,) = ripple_table(arm)
    # a motion that repeats has one line more
    arm.ripples = (ripples[0]._replace(repeats=True), *ripples[1:])
    (warned,) = ripple_table(arm)
    first, last = warned.rsplit('\n', 1)
    assert first == text
    assert last.startswith('the motion repeats, ')
    lines = [' '.join(line.split()) for line in text.splitlines()]
    assert lines[1:] == [
        'turns 1.2 +- 0.039 N m at 29.98 +- 0.098',
        'slides 3 +- 0.98 N at 250 +- 0.2 rad/m',
        'quiet none above 0.12 N m at 5 to 180',
        'rests cannot be known: the joint moved too little',
        'the controller learns to compensate it with this parameter:',
        'learning.ripple_cycles: [30.0, 250.0]',
    ]

# SPDX-License-Identifier: Apache-2.0
"""Efforts that are not what they are said to be: units, signs, mounting, limits, turns."""

from __future__ import annotations

import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from random_arm import (
    GRAVITY,
    PANDA,
    PANDA_CHAIN,
    PANDA_TEXT,
    measured,
    recording_of,
    reference_of,
    shake,
    truth_of,
)

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.model import regressors_at
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification import signs as signs_module
from blf_dsc_controller.identification.identify import identify_arm
from blf_dsc_controller.identification.joint_alone import _Fit, _sign, errors_alone
from blf_dsc_controller.identification.left_out import transmitted_torques
from blf_dsc_controller.identification.mounting import gravity_columns
from blf_dsc_controller.identification.problem import problem_of
from blf_dsc_controller.identification.problems import is_usable, problems_of
from blf_dsc_controller.identification.regression import correlation_length
from blf_dsc_controller.identification.summary import notes_of
from blf_dsc_controller.identification.values import (
    COULOMB,
    OFFSET,
    ROTOR_INERTIA,
    VISCOUS,
    parts,
)

ROBOT = Robot(urdf=PANDA_TEXT, tip='panda_hand_tcp')
TRUTH = truth_of(PANDA_CHAIN, 1)
TORQUE = 2  # row of a state
EVERY = 5  # samples of 1 ms


def moved(truth=TRUTH, reach=None, seed=2):
    """States (N, 3, n) at 200 Hz of a motion, which may be at most so wide [rad]."""
    reference = reference_of(PANDA_CHAIN, seed)
    if reach is not None:
        amplitude = reach / tones if (tones := len(reference.amplitude)) else 0.0
        reference = reference._replace(
            amplitude=np.full_like(reference.amplitude, amplitude)
        )
    return measured(shake(PANDA_CHAIN, truth, reference, 20.0), 3)[::EVERY]


def recorded(states):
    return recording_of(states, period=1e-3 * EVERY)


def with_torque(states, torque):
    changed = states.copy()
    changed[:, TORQUE] = torque
    return changed


@pytest.fixture(scope='module')
def wide():
    return moved()


@pytest.fixture(scope='module')
def narrow():
    """Half a radian: the torque is mostly the mean of gravity and friction."""
    return moved(reach=0.5)


def problem(states, robot=ROBOT):
    return problem_of(recorded(states), robot, 'torque', None, find_signs=True)


# those nearest to 1 are the hardest to see
FACTORS = (0.1, 10.0, 1000.0) if os.environ.get('NIGHTLY') else (0.1, 10.0)


@pytest.mark.parametrize('motion', ['wide', 'narrow'])
def test_efforts_in_other_units_are_refused_and_right_ones_are_not(motion, request):
    states = request.getfixturevalue(motion)
    found = identify_arm(recorded(states), ROBOT)
    assert not list(problems_of(found, 'torque'))
    assert found.gravity == pytest.approx(1.0, abs=0.3)  # masses are off by 30 %
    for factor in FACTORS:
        other = with_torque(states, factor * states[:, TORQUE])
        wrong = identify_arm(recorded(other), ROBOT)
        assert not is_usable(wrong)
        named = 'IS DOUBLE' if factor > 1.0 else 'IS MISSING'
        assert named in next(problems_of(wrong, 'torque'))


def heavier_on_the_other_side():
    """The last body 4 times as heavy, its centre 10 cm beyond the axis of joint 6."""
    bodies = PANDA_CHAIN.inertias.copy()
    centre = bodies[-1, 1:4] / bodies[-1, 0]
    T = np.eye(4)
    T[:3, 3] = -2.0 * centre
    T[0, 3] -= 0.2
    bodies[-1] = inertia_of(4.0 * T @ pseudo_inertia(bodies[-1]) @ T.T)
    return TRUTH._replace(inertias=bodies)


def test_right_signs_stay_where_links_are_heavier_than_the_urdf_says():
    """Of joint 6 and 7, gravity of the URDF points the other way."""
    states = moved(heavier_on_the_other_side())
    assert not problem(states).reversed.any()
    found = identify_arm(recorded(states), ROBOT)
    share = found.score.errors[2] / found.score.torque
    assert (share[5:] < 0.05).all()  # of torques with 1 % of noise


@pytest.mark.parametrize('signs', [(1, 1, 1, 1, 1, -1, 1), (-1, 1, -1, -1, 1, 1, -1)])
def test_opposite_signs_are_found_by_the_fit_of_the_whole_arm(wide, narrow, signs):
    for states in (wide, narrow):
        other = with_torque(states, states[:, TORQUE] * signs)
        assert problem(other).reversed.tolist() == (np.array(signs) < 0).tolist()


MOUNTINGS = {
    'ceiling': (0.0, 0.0, 9.81),
    'wall': (9.81, 0.0, 0.0),
    'tilted': (0.0, 6.94, -6.94),
}


@pytest.mark.parametrize('given', MOUNTINGS)
def test_wrong_mounting_is_named_instead_of_reversed_efforts(wide, given):
    """The arm stands upright, though it is said to be mounted otherwise."""
    robot = replace(ROBOT, gravity=MOUNTINGS[given])
    other = wide * [[1.0], [1.0], [-1.0]]
    for states, is_reversed in ((wide, False), (other, True)):
        found = problem(states, robot)
        np.testing.assert_allclose(found.other_gravity, GRAVITY, atol=0.01)
        assert (found.reversed == is_reversed).all()


@pytest.mark.parametrize(
    'given',
    [
        'ceiling',
        *(pytest.param(k, marks=pytest.mark.nightly) for k in ('wall', 'tilted')),
    ],
)
def test_wrong_mounting_is_not_taken_for_a_load_or_other_joints(wide, given):
    short = wide[:2000]
    wrong = identify_arm(recorded(short), replace(ROBOT, gravity=MOUNTINGS[given]))
    left = np.linalg.norm(wrong.score.errors[2]) / np.linalg.norm(wrong.score.torque)
    assert left > 0.1
    assert not is_usable(wrong)
    (named,) = problems_of(wrong, 'torque')
    assert '--gravity 0 0 -9.81' in named


def test_right_mounting_is_not_doubted(wide):
    assert problem(wide).other_gravity is None
    assert problem(moved(heavier_on_the_other_side())).other_gravity is None


def test_columns_of_gravity_are_those_of_the_regressor():
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 7))
    still = np.zeros_like(q)
    for gravity in (GRAVITY, (1.0, -2.0, 3.0)):
        parameters = base_parameters(PANDA_CHAIN, gravity)
        P = parameters.of(PANDA_CHAIN.inertias, np.zeros(7))
        expected = regressors_at(parameters.model, q, still, still, still) @ P
        found = gravity_columns(PANDA_CHAIN, q) @ gravity
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_rows_with_clipped_torques_are_left_out_and_said(wide):
    """At 0.7 of each joint's peak; where they are not left out, the error is 10 times as large."""
    torque = wide[:, TORQUE]
    limit = 0.7 * np.abs(torque).max(axis=0)
    states = with_torque(wide, np.clip(torque, -limit, limit))
    found = identify_arm(recorded(states), ROBOT)
    assert (found.clipped > 0.0).all()
    plain = identify_arm(recorded(wide), ROBOT)
    assert not plain.clipped.any()
    assert found.score.total[2] < 2.0 * plain.score.total[2]
    said = [note for note in notes_of(found) if 'is clipped' in note]
    assert len(said) == 7
    assert not any('is clipped' in note for note in notes_of(plain))


def test_torques_that_are_recorded_in_steps_are_not_clipped(wide):
    torque = wide[:, TORQUE]
    step = 0.02 * np.abs(torque).max(axis=0)
    states = with_torque(wide, step * np.round(torque / step))
    assert not problem(states).rows.clipped.any()


def test_joint_whose_effort_has_another_unit_than_the_others_is_named(wide):
    states = wide * np.ones(7)
    states[:, TORQUE, 3] *= 0.2
    found = identify_arm(recorded(states), ROBOT)
    named = [line for line in problems_of(found, 'torque') if 'DOES NOT FIT' in line]
    assert any(line.startswith(PANDA[3]) for line in named)
    assert not is_usable(found)


@pytest.mark.parametrize(
    ('viscous', 'coulomb', 'sign'),
    [(2.0, 1.0, 1.0), (-2.0, -1.0, -1.0), (-2.0, 1.0, 0.0), (2.0, -1.0, 0.0)],
)
def test_friction_shows_a_sign_only_if_both_of_its_parts_agree(viscous, coulomb, sign):
    """Each value is known to 1e-3, with residuals of one sample."""
    z = np.array([viscous, coulomb, 0.0])
    fit = _Fit(np.ones(3), z, 1e3 * np.eye(3), 1.0, 1.0, 1.0)
    assert _sign(fit, [0, 1], 1.0) == sign


@pytest.mark.parametrize(
    ('residual', 'length', 'sign'),
    [(100.0, 1.0, 1.0), (300.0, 1.0, 0.0), (100.0, 16.0, 0.0)],
)
def test_friction_shows_a_sign_if_it_is_five_deviations_long(residual, length, sign):
    """Of 1; its deviation is 1e-3 of the residual, times the root of the length."""
    z = np.array([2.0, 1.0, 0.0])
    fit = _Fit(np.ones(3), z, 1e3 * np.eye(3), 1.0, residual, 1.0)
    assert _sign(fit, [0, 1], length) == sign


def test_errors_of_joints_alone_are_what_their_values_and_delays_leave():
    random = np.random.default_rng(4)
    X, rate = random.normal(size=(9, 2, 3)), random.normal(size=(9, 2))
    values, left = random.normal(size=(2, 4)), random.normal(size=(9, 2))
    u = np.einsum('kia,ia->ki', X, values[:, :3]) - rate * values[:, 3] - left
    rows = SimpleNamespace(
        u_and_rate=lambda _: (u, rate),
        blocks=lambda _: [slice(0, 2), slice(2, 5)],
        matrix=lambda windows: X[windows],
        rms=lambda values, _: np.sqrt(np.mean(values**2, axis=0)),
    )
    test = np.array([1, 2, 4, 5, 8])
    found = errors_alone(rows, test, SimpleNamespace(values=values))
    np.testing.assert_allclose(found, np.sqrt(np.mean(left[test] ** 2, axis=0)))


@pytest.mark.parametrize(
    ('residual', 'length'),
    [
        ([0.0, 0.0, 0.0, 0.0], 1.0),  # an exact fit
        ([1.0, 1.0, 1.0, 1.0], 1.0 + 2.0 * (3.0 + 2.0 + 1.0) / 4.0),
        ([1.0, -1.0, 1.0, -1.0], 1.0),
        ([1.0, 1.0, -1.0, -1.0], 1.0 + 2.0 * 1.0 / 4.0),
    ],
)
def test_residuals_count_as_long_as_they_are_alike(residual, length):
    assert correlation_length(np.array(residual)) == pytest.approx(length)


@pytest.mark.parametrize(('recorded', 'chosen'), [(1.01, 1.0), (1.03, -1.0)])
def test_reversed_signs_must_explain_the_torques_by_two_percent_better(
    recorded, chosen, monkeypatch
):
    class Fit:
        def __init__(self, *_):
            pass

        def bounds(self, signs):
            return np.array([self.cost(each) for each in signs])

        def cost(self, signs):
            return 1.0 if signs[0] < 0.0 and signs[1] > 0.0 else recorded

    monkeypatch.setattr(signs_module, '_Fit', Fit)
    alone = SimpleNamespace(friction=np.zeros(2))
    signs, _ = signs_module.likely_signs(alone, None, None)
    np.testing.assert_array_equal(signs, [chosen, 1.0])


def test_link_gets_the_torque_without_rotor_friction_and_offset():
    """Of one joint, 3 + 4 t, in straight lines, which smoothing leaves as they are."""
    h = 1e-3
    t = h * np.arange(300)[:, np.newaxis]
    dq, s = 1.0 + 2.0 * t, np.ones_like(t)
    link = 3.0 + 4.0 * t
    torque = link + 0.1 * 2.0 + 0.5 * dq + 0.7 * s + 0.2
    values = np.zeros(31)
    terms = parts(values).terms
    terms[[ROTOR_INERTIA, VISCOUS, COULOMB, OFFSET]] = [[0.1], [0.5], [0.7], [0.2]]
    rows = SimpleNamespace(period=h, q=t, dq=dq, torque=torque, sliding=s)
    found = np.array(transmitted_torques(rows, values))
    np.testing.assert_allclose(found[:, :1], link, atol=1e-9)
    np.testing.assert_allclose(found[:, 1:], 4.0, atol=1e-6)

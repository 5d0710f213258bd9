# SPDX-License-Identifier: Apache-2.0
"""Forms with few unknowns: their torques, and the arms that they can represent."""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import random_urdf
from test_arms_base_parameters import CHAINS, PANDA_CHAIN, WALL

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.forms import TRUSTED, learned_parameters
from blf_dsc_controller.arms.inertia import INERTIA_NAMES, inertia_of
from blf_dsc_controller.arms.prior import LINKS, ROTORS
from blf_dsc_controller.arms.urdf import read_chain
from sim_plant.rigid_arm import rigid_arm

RATED = 3.0  # kg
ONE_JOINT = read_chain(random_urdf(1, 0)[0], 'base', 'tip', ('j1',))
FORMS = ('payload', 'scale')


class Case:
    """A chain with rotors, all its base parameters, and a form of it."""

    def __init__(self, chain, form):
        self.chain, self.n = chain, len(chain.joints)
        self.rotors = np.linspace(0.02, 0.2, self.n)
        self.base = base_parameters(chain, WALL)
        self.form = learned_parameters(chain, self.base, form, RATED, self.rotors)
        self.names = self.form.model.parameter_names

    def assert_same_torques(self, P, inertias, rotors):
        """All regressors times P agree with those of the base parameters and with each other."""
        random = np.random.default_rng(1)
        expected = self.base.of(inertias, rotors)
        for _ in range(5):
            q, dq, v, a = random.normal(size=(4, self.n))
            H, Yp, Yr = np.full((3, self.n, P.size + 2), np.nan)
            separate = np.full((3, self.n, P.size), np.nan)
            whole = np.zeros((3, self.n, expected.size))
            self.form.model.regressors(q, dq, v, a, H, Yp, Yr)
            self.form.model.regressor(q, dq, v, a, separate[0])
            self.form.model.momentum_regressor(q, dq, *separate[1:])
            self.base.model.regressors(q, dq, v, a, *whole)
            for combined, alone, other in zip((H, Yp, Yr), separate, whole, strict=True):
                np.testing.assert_array_equal(combined[:, :-2], alone)
                np.testing.assert_allclose(alone @ P, other @ expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize('form', FORMS)
@pytest.mark.parametrize('chain', [*CHAINS, ONE_JOINT])
def test_initial_parameters_give_the_torques_of_the_base_parameters(chain, form):
    case = Case(chain, form)
    assert case.form.model.p == case.form.initial.size == len(case.form.model.parameter_units)
    case.assert_same_torques(case.form.initial, chain.inertias, case.rotors)


def load_at(chain):
    """Inertial parameters of a random load in the frame of the tip, and of all bodies with it."""
    random, inertias = np.random.default_rng(2), chain.inertias
    points = np.vstack((random.normal(0.05, 0.1, (3, 5)), np.ones(5)))
    load = points @ np.diag(random.uniform(0.1, 0.8, 5)) @ points.T
    inertias[-1] += inertia_of(chain.tip_placement @ load @ chain.tip_placement.T)
    return inertia_of(load), inertias


@pytest.mark.parametrize('chain', [c for c in CHAINS if len(c.joints) > 5])
def test_parameters_represent_any_load(chain):
    case = Case(chain, 'payload')
    ten, inertias = load_at(chain)
    heavier = case.rotors.copy()
    heavier[-1] *= 1.3
    P = case.form.initial.copy()
    P[[case.names.index(f'load {name}') for name in INERTIA_NAMES]] = ten
    P[case.names.index(f'rotor{case.n}')] = heavier[-1]
    case.assert_same_torques(P, inertias, heavier)


@pytest.mark.parametrize('chain', [ONE_JOINT, *(c for c in CHAINS if len(c.joints) < 6)])
def test_short_arm_with_fewer_load_parameters_still_represents_any_load(chain):
    case = Case(chain, 'payload')
    assert len(case.names) < case.n + 11
    _, inertias = load_at(chain)
    known = case.base.of(inertias, case.rotors)
    motions = np.random.default_rng(5).normal(size=(40, 4, case.n))
    H, whole = np.zeros((40, case.n, len(case.names))), np.zeros((40, case.n, known.size))
    for motion, rows, all_rows in zip(motions, H, whole, strict=True):
        case.form.model.regressor(*motion, rows)
        case.base.model.regressor(*motion, all_rows)
    P = np.linalg.lstsq(np.vstack(H), np.vstack(whole) @ known, rcond=None)[0]
    case.assert_same_torques(P, inertias, case.rotors)


def test_load_parameters_agree_with_the_payload_of_the_plant():
    """The plant uses Newton-Euler, an independent algorithm, with a point mass at the tip."""
    case = Case(PANDA_CHAIN, 'payload')
    arm = rigid_arm(PANDA_CHAIN, WALL, PANDA_CHAIN.inertias, case.rotors, case.base)
    P = case.form.initial + 2.0 * case.form.load
    assert P[case.names.index('load m')] == 2.0
    H, found = np.zeros((7, P.size)), np.zeros(7)
    for q, dq, ddq in np.random.default_rng(3).normal(size=(5, 3, 7)):
        case.form.model.regressor(q, dq, dq, ddq, H)
        arm.accelerate(2.0, q, dq, H @ P, found)
        np.testing.assert_allclose(found, ddq, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('chain', CHAINS)
def test_parameters_represent_any_scale_factors_of_the_bodies(chain):
    case = Case(chain, 'scale')
    kept = [i for i in range(case.n) if f'scale{i + 1}' in case.names]
    assert len(kept) >= case.n - 1
    factors = np.ones(case.n)
    factors[kept] = np.random.default_rng(4).uniform(0.7, 1.3, len(kept))
    P = case.form.initial.copy()
    P[[case.names.index(f'scale{i + 1}') for i in kept]] = factors[kept]
    case.assert_same_torques(P, factors[:, None] * chain.inertias, case.rotors)


def test_first_body_of_an_arm_on_the_floor_is_learned_with_its_rotor():
    base = base_parameters(PANDA_CHAIN)
    learned = learned_parameters(PANDA_CHAIN, base, 'scale', RATED, np.full(7, 0.2))
    assert learned.model.parameter_names[:2] == ('rotor1', 'rotor2')
    assert 'scale1' not in learned.model.parameter_names
    assert learned.initial[0] == pytest.approx(0.2 + PANDA_CHAIN.inertias[0, -1])
    assert set(learned.initial[7:]) == {1.0}


def test_prior_is_wide_for_what_the_form_learns_and_tight_elsewhere():
    deviation = {}
    for form in FORMS:
        case = Case(PANDA_CHAIN, form)
        covariance = case.form.L @ case.form.L.T
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
        deviation |= dict(zip(case.names, np.sqrt(np.diag(covariance)), strict=True))
        assert deviation['rotor7'] == pytest.approx(ROTORS * case.rotors[-1])
    assert deviation['load m'] == pytest.approx(RATED)
    assert deviation['links'] == pytest.approx(TRUSTED)
    assert deviation['scale3'] == pytest.approx(LINKS)
    heaviest = PANDA_CHAIN.inertias[-1, 0] + RATED
    assert deviation['scale7'] >= heaviest / PANDA_CHAIN.inertias[-1, 0] - 1.0


def test_units_distinguish_prismatic_from_revolute_joints():
    for chain in CHAINS[2:]:
        for form in FORMS:
            model = Case(chain, form).form.model
            units = dict(zip(model.parameter_names, model.parameter_units, strict=True))
            for i, joint in enumerate(chain.joints, 1):
                prismatic = joint.kind == 'prismatic'
                assert units[f'rotor{i}'] == ('kg' if prismatic else 'kg m^2')
                assert units.get(f'scale{i}', '') == ''
    assert Case(PANDA_CHAIN, 'payload').form.model.parameter_units[7:9] == ('kg', 'kg m')

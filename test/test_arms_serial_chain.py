# SPDX-License-Identifier: Apache-2.0
"""Chains of a URDF: regressors, base parameters, and their prior."""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import chain_of

from blf_dsc_controller.arms.base_parameters import (
    CENTRE,
    base_parameters,
    deviations,
    payload_inertia,
    prior_factor,
)
from blf_dsc_controller.arms.serial_chain import ROTOR, serial_chain
from blf_dsc_controller.arms.urdf import inertia_of, pseudo_inertia

WALL = (0.0, 9.81, 0.0)


def test_chosen_columns_keep_their_values_names_and_units():
    chain, (q, dq) = chain_of('three'), np.random.default_rng(0).normal(size=(2, 3))
    chosen = [(0, ROTOR), (1, 0), (1, 3), (1, ROTOR), (2, 9), (2, ROTOR)]
    part, whole = serial_chain(chain, WALL, chosen), serial_chain(chain, WALL)
    columns = [body * (ROTOR + 1) + entry for body, entry in chosen]
    # Wider, as with disturbance columns beside them.
    rows, every = np.full((2, 3, 8), np.nan), np.full((2, 3, whole.p), np.nan)
    part.momentum_regressor(q, dq, *rows)
    whole.momentum_regressor(q, dq, *every)
    np.testing.assert_array_equal(rows[:, :, :6], every[:, :, columns])
    assert np.isnan(rows[:, :, 6:]).all()
    assert part.parameter_names == ('rotor1', 'm2', 'm*cz2', 'rotor2', 'Izz3', 'rotor3')
    first, *others = ('kg' if j.kind == 'prismatic' else 'kg m^2' for j in chain.joints)
    assert part.parameter_units == (first, 'kg', 'kg m', others[0], 'kg m^2', others[1])
    assert {joint.kind for joint in chain.joints} > {'prismatic'}


PANDA_CHAIN, UR5E_CHAIN, *RANDOM = map(chain_of, ('panda', 'ur5e', 'three', 'nine'))
CHAINS = [PANDA_CHAIN, UR5E_CHAIN, *RANDOM]


@pytest.mark.parametrize('chain', CHAINS)
def test_base_parameters_are_the_smallest_set_that_gives_the_same_torques(chain):
    base = base_parameters(chain, WALL)
    whole = serial_chain(chain, WALL)
    n, p = base.model.n, base.model.p
    random = np.random.default_rng(5)
    inertias, joint_rotors = random.normal(size=(n, 10)), random.normal(size=n)
    P, phi = base.of(inertias, joint_rotors), np.column_stack((inertias, joint_rotors)).ravel()
    H, rows = np.zeros((n, p)), np.zeros((p, n, whole.p))
    for full in rows:
        q, dq, v, a = random.normal(size=(4, n))
        whole.regressor(q, dq, v, a, full)
        base.model.regressor(q, dq, v, a, H)
        np.testing.assert_allclose(H @ P, full @ phi, rtol=1e-8, atol=1e-8)
    singular = np.linalg.svd(rows.reshape(-1, whole.p), compute_uv=False)
    assert singular[p - 1] > 1e-3
    assert singular[p] < 1e-7  # pi / 2 has ten digits in the UR5e's file


def test_base_parameters_agree_with_the_literature():
    """43 for a Panda (Gaz et al., 2019), 36 for an arm like the UR; rotors except at the base."""
    for chain, inertial, rotors in ((PANDA_CHAIN, 43, 5), (UR5E_CHAIN, 36, 4)):
        names = base_parameters(chain).model.parameter_names
        found = sum(name.startswith('rotor') for name in names)
        assert (len(names) - found, found) == (inertial, rotors)
    base = base_parameters(PANDA_CHAIN)
    sums = dict(zip(base.model.parameter_names, base.combinations, strict=True))
    assert sums['Ixx7'] == 'Ixx7 - Iyy7'
    assert sums['m*cx7'] == 'm*cx7'
    assert sums['m*cx6'] == 'm*cx6 + 0.088 m7'
    assert not any(name.startswith(('m7', 'm*cz', 'Iyy')) for name in sums)


@pytest.mark.parametrize('chain', CHAINS)
def test_prior_covers_heavier_links_moved_centres_and_the_payload(chain):
    """A deviation in a single respect has a distance of at most 1, larger ones have more."""
    base, T = base_parameters(chain, WALL), np.eye(4)
    T[0, 3] = CENTRE / 100.0  # small, as this holds to first order only
    rotors, tip = np.full(base.model.n, 0.02), np.append(chain.tip_placement[:3, 3], 1.0)
    L = prior_factor(chain, base, 3.0, rotors)

    def distance(body, changed, rotor=0.02):
        inertias, others = chain.inertias, rotors.copy()
        inertias[body], others[-1] = changed, rotor
        off = base.of(inertias, others) - base.of(chain.inertias, rotors)
        return np.linalg.norm(np.linalg.lstsq(L, off, rcond=None)[0])  # the least that gives it

    for i, ten in enumerate(chain.inertias):
        assert distance(i, 1.3 * ten) < 1.0 + 1e-6
        assert distance(i, inertia_of(T @ pseudo_inertia(ten) @ T.T)) < 1.05 / 100.0
    load = inertia_of(3.0 * np.outer(tip, tip))
    assert distance(-1, ten + load) < 1.5  # a point mass, where an extended body is expected
    assert distance(-1, ten + 10.0 * load) > 2.0
    assert distance(-1, ten, rotor=0.04) < 1.0 + 1e-6


def test_prior_without_payload_is_tighter():
    base = base_parameters(UR5E_CHAIN)
    loaded, empty = (prior_factor(UR5E_CHAIN, base, load, np.full(6, 0.02)) for load in (5.0, 0.0))
    assert np.linalg.matrix_rank(empty) == base.model.p
    assert np.linalg.eigvalsh(loaded @ loaded.T - empty @ empty.T)[0] > -1e-12
    tool = base.model.parameter_names.index('m*cx6')
    assert np.linalg.norm(empty[tool]) == pytest.approx(0.365 * CENTRE)


def test_prior_of_a_ball_is_the_same_in_every_direction():
    J, turn = payload_inertia(2.0), np.eye(4)
    turn[:3, :3] = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    ten = deviations(J, 0.3, CENTRE)
    turned = np.transpose([inertia_of(turn @ pseudo_inertia(d) @ turn.T) for d in ten.T])
    np.testing.assert_allclose(turned @ turned.T, ten @ ten.T, atol=1e-15)

# SPDX-License-Identifier: Apache-2.0
"""Base parameters: their number, their torques, and a prior that covers likely arms."""

from __future__ import annotations

import numpy as np
import pytest
from random_arm import CONFIG, PANDA, UR5E, random_urdf

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.chain_kernels import ROTOR
from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.prior import CENTRE, prior_factor
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.arms.urdf import read_chain

WALL = (0.0, 9.81, 0.0)
PANDA_CHAIN = read_chain(
    (CONFIG / 'panda.urdf').read_text(), 'panda_link0', 'panda_hand_tcp', PANDA
)
UR5E_CHAIN = read_chain((CONFIG / 'ur5e.urdf').read_text(), 'world', 'tool0', UR5E)
RANDOM = [(text, joints) for text, joints in (random_urdf(4, 2), random_urdf(7, 3))]
CHAINS = [PANDA_CHAIN, UR5E_CHAIN, *(read_chain(t, 'base', 'tip', j) for t, j in RANDOM)]


@pytest.mark.parametrize('rotors', [True, False])
@pytest.mark.parametrize('chain', CHAINS)
def test_base_parameters_are_the_smallest_set_that_gives_the_same_torques(chain, rotors):
    base = base_parameters(chain, WALL, rotors=rotors)
    whole = serial_chain(chain, WALL)
    n, p = base.model.n, base.model.p
    random = np.random.default_rng(5)
    inertias, joint_rotors = random.normal(size=(n, 10)), random.normal(size=n) * rotors
    P, phi = base.of(inertias, joint_rotors), np.column_stack((inertias, joint_rotors)).ravel()
    H, rows = np.zeros((n, p)), np.zeros((p, n, whole.p))
    for full in rows:
        q, dq, v, a = random.normal(size=(4, n))
        whole.regressor(q, dq, v, a, full)
        base.model.regressor(q, dq, v, a, H)
        np.testing.assert_allclose(H @ P, full @ phi, rtol=1e-8, atol=1e-8)
    shown = [k for k in range(whole.p) if rotors or k % (ROTOR + 1) != ROTOR]
    singular = np.linalg.svd(rows[:, :, shown].reshape(-1, len(shown)), compute_uv=False)
    assert singular[p - 1] > 1e-3
    assert p == len(shown) or singular[p] < 1e-7  # pi / 2 has ten digits in the UR5e's file


def test_number_of_base_parameters_on_the_floor_agrees_with_the_literature():
    """43 for a Panda (Gaz et al., 2019), 36 for an arm like the UR; rotors except at the base."""
    for chain, inertial, rotors in ((PANDA_CHAIN, 43, 5), (UR5E_CHAIN, 36, 4)):
        assert base_parameters(chain, rotors=False).model.p == inertial
        assert base_parameters(chain).model.p == inertial + rotors


def test_combinations_have_the_usual_grouping():
    base = base_parameters(PANDA_CHAIN, rotors=False)
    sums = dict(zip(base.model.parameter_names, base.combinations, strict=True))
    assert sums['Ixx7'] == 'Ixx7 - Iyy7'
    assert sums['m*cx7'] == 'm*cx7'
    assert sums['m*cx6'] == 'm*cx6 + 0.088 m7'
    assert not any(name.startswith(('m7', 'm*cz', 'Iyy')) for name in sums)


@pytest.mark.parametrize('chain', CHAINS)
def test_prior_covers_heavier_links_moved_centres_and_the_payload(chain):
    """A deviation in a single respect has a distance of at most 1, larger ones have more."""
    base = base_parameters(chain, WALL)
    n = base.model.n
    rotors = np.full(n, 0.02)
    L = prior_factor(chain, base, 3.0, rotors)
    P = base.of(chain.inertias, rotors)

    def distance(inertias, rotors=rotors):
        off = base.of(inertias, rotors) - P
        return np.linalg.norm(np.linalg.solve(L, off))

    for i in range(n):
        heavier = chain.inertias
        heavier[i] *= 1.3
        assert distance(heavier) < 1.0 + 1e-6
        moved = chain.inertias
        T = np.eye(4)
        T[0, 3] = CENTRE / 100.0  # small, as this holds to first order only
        moved[i] = inertia_of(T @ pseudo_inertia(moved[i]) @ T.T)
        assert distance(moved) < 1.05 / 100.0
    loaded = chain.inertias
    tip = chain.tip_placement[:3, 3]
    point = np.append(tip, 1.0)
    loaded[-1] += inertia_of(3.0 * np.outer(point, point))
    assert distance(loaded) < 1.5  # a point mass, where an extended body is expected
    other = rotors.copy()
    other[-1] += 0.02
    assert distance(chain.inertias, other) < 1.0 + 1e-6

    loaded[-1] += 9.0 * (loaded[-1] - chain.inertias[-1])
    assert distance(loaded) > 2.0


def test_prior_without_payload_is_tighter():
    base = base_parameters(UR5E_CHAIN)
    loaded, empty = (prior_factor(UR5E_CHAIN, base, load, np.full(6, 0.02)) for load in (5.0, 0.0))
    for L in (loaded, empty):
        np.testing.assert_array_equal(L, np.tril(L))
        assert (np.diag(L) > 0.0).all()
    assert np.linalg.eigvalsh(loaded @ loaded.T - empty @ empty.T)[0] > -1e-12
    tool = base.model.parameter_names.index('m*cx6')
    assert np.linalg.norm(empty[tool]) == pytest.approx(0.365 * CENTRE)

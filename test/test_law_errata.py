# SPDX-License-Identifier: Apache-2.0
"""The paper's printed arm and law against the corrected ones: each erratum by its number.

Each test shows the printed form failing and the corrected form, as the package has it, holding.
"""

from __future__ import annotations

import numpy as np
import pytest
from closed_loop_case import (
    JOINTS,
    START,
    P,
    R,
    controller,
    recommended,
)
from plain_law import dynamics

from blf_dsc_controller.errors import OutsideBarrierError
from blf_dsc_controller.law import surface


def work_around_a_circle(torque, radius=0.3, centre=(2.0, np.pi / 2.0), points=400):
    """Work [J] of a torque field; the rectangle rule is exact to rounding over a period."""
    phi = np.arange(points) * 2.0 * np.pi / points
    circle = radius * np.column_stack([np.cos(phi), np.sin(phi)])
    along = radius * np.column_stack([-np.sin(phi), np.cos(phi)])
    power = [torque(centre + at) @ step for at, step in zip(circle, along, strict=True)]
    return np.mean(power) * 2.0 * np.pi


def test_erratum_4_first_gravity_term_has_cos_q1():
    """(34) prints cos q2: a gravity that does work along a closed path."""

    def corrected(q):
        return dynamics(P, R, q, (0.0, 0.0))[2]

    def printed(q):
        outer = P[2] * R * np.cos(q[0] + q[1])
        return np.array([P[0] * R * np.cos(q[1]) + outer, outer])

    assert abs(work_around_a_circle(corrected)) < 1e-12
    # The curl of the printed field is P1 r sin q2, 9.8 N m/rad over a circle of 0.28 rad^2.
    assert abs(work_around_a_circle(printed)) == pytest.approx(2.74, abs=0.01)
    stretched = np.array([0.0, np.pi])
    assert np.abs(printed(stretched) - corrected(stretched)).max() == pytest.approx(19.6)


def test_erratum_5_arm_starts_inside_its_bound():
    """Section IV prints q2(0) = 0.1696 rad: 763 times the bound away from the reference."""
    law = controller(recommended())
    law.check_start(JOINTS, np.array(START))

    with pytest.raises(OutsideBarrierError) as refusal:
        law.check_start(JOINTS, np.array([2.293, 0.1696]))

    assert refusal.value.joint == JOINTS[1]
    assert refusal.value.error == pytest.approx(-1.5265)
    assert abs(refusal.value.error) / refusal.value.bound == pytest.approx(763.0, abs=0.5)


@pytest.mark.parametrize('mu', [0.02, 20.0, 1e4])
@pytest.mark.parametrize('time_constant', [2e-4, 2e-3, 0.1])
def test_erratum_12_switched_virtual_control_cannot_meet_its_own_condition(mu, time_constant):
    """(14) asks for mu >= sup |beta2 - alpha2|, but each sign change makes that 2 mu."""
    gain = surface.filter_gain(time_constant, 1e-3)
    alpha2 = 0.0
    gap = []
    for k in range(4000):
        beta2 = -mu if k < 2000 else mu  # -mu sgn(xi1), xi1 > 0 and then xi1 < 0
        gap.append(abs(beta2 - alpha2))
        alpha2 += gain * (beta2 - alpha2)
    assert max(gap) == pytest.approx(2.0 * mu)


def test_erratum_12_linear_virtual_control_crosses_zero_without_a_jump():
    """(18) has slope K/2 + mu there: the filter's gap is at most (lambda + T) times its rate."""
    K, mu, bound, time_constant, T = 150.0, 20.0, 0.002, 0.002, 1e-3
    t = np.arange(0.0, 2.0, T)
    beta2 = np.array(
        [surface.virtual_control(xi1, bound, K, mu, 0.0) for xi1 in 1e-3 * np.sin(10.0 * t)]
    )
    gain = surface.filter_gain(time_constant, T)
    alpha2, gap = beta2[0], []
    for target in beta2:
        gap.append(abs(target - alpha2))
        alpha2 += gain * (target - alpha2)

    fastest = (K / 2.0 + mu) * 1e-3 * 10.0
    assert np.abs(np.diff(beta2)).max() <= fastest * T
    assert max(gap) <= (time_constant + T) * fastest
    assert max(gap) < mu * bound


def damping_torque(d2, xi1, xi2):
    """Contribution of d2 to (28), for a law with these errors at its first sample."""
    demands = []
    for gain in (np.zeros(2), d2):
        law = controller(recommended(d2=gain))
        q = np.array([1.9935, 1.3961]) + 0.3 + xi1
        beta2 = [surface.virtual_control(x, 0.002, 150.0, 20.0, 0.0) for x in xi1]
        law.update(0.0, 1e-3, np.concatenate([q, beta2 + xi2, np.zeros(2)]))
        np.testing.assert_allclose(law.signals.xi2, xi2, atol=1e-12)
        demands.append(law.signals.demand.copy())
    return demands[1] - demands[0]


@pytest.mark.parametrize('seed', range(10))
def test_erratum_15_robust_term_dominates_disturbances_bounded_joint_by_joint(seed):
    """With (5) as |tau_dist_i| <= d2_i |xi1_i|; the printed (5) bounds norms, which is weaker."""
    random = np.random.default_rng(seed)
    d2 = np.array([300.0, 200.0])
    xi1 = random.uniform(-0.0015, 0.0015, 2)
    xi2 = random.choice([-1.0, 1.0], 2) * random.uniform(0.01, 1.0, 2)  # outside the layer b

    power = damping_torque(d2, xi1, xi2) @ xi2

    assert power + np.sum(d2 * np.abs(xi1) * np.abs(xi2)) == pytest.approx(0.0, abs=1e-10)
    d = 300.0
    of_norms = d * np.linalg.norm(xi1) * np.linalg.norm(xi2)
    assert of_norms - d * np.abs(xi1) @ np.abs(xi2) > 0.0  # xi3 as printed leaves this power
    assert (
        of_norms - d * np.linalg.norm(xi1) * np.sum(np.abs(xi2)) <= 0.0
    )  # |xi1| as a norm does not


def test_erratum_15_printed_term_vanishes_if_the_errors_are_on_different_joints():
    d2 = np.full(2, 300.0)
    torque = damping_torque(d2, np.array([0.001, 0.0]), np.array([0.0, 1.0]))
    np.testing.assert_allclose(torque, 0.0, atol=1e-12)

# SPDX-License-Identifier: Apache-2.0
"""The linear loop of elastic joints, the gains that follow, and what they hold."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from blf_dsc_controller import ControllerConfig
from blf_dsc_controller.arms.joint_gains import (
    JointGains,
    linear,
    unknown_arm,
)
from blf_dsc_controller.arms.linear_loop import (
    Feedback,
    Joints,
    Loop,
    Timing,
    TorqueLoop,
    arm_response,
    law_response,
)
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.nodes import load, locate
from blf_dsc_controller.configuration.robot import parameters_of

ONE = np.ones((1, 1, 1))  # one joint with a link of 1 kg m^2, in one posture
TIMING = Timing(0.001, delay=1, drive_lag=0.001, velocity_lag=0.0025)


def links_of(preset, payload=0.0):
    """Links in four postures, and the guess of the motors and the viscous friction."""
    config = load(locate(preset), 'blf_dsc_controller', ControllerConfig, {})
    chain = config.robot.chain(config.joints)
    base = parameters_of(config.robot, chain)
    n = len(config.joints)
    P = base.of(chain.inertias, np.zeros(n)) + payload * base.load
    limits = config.limits.position_lower, config.limits.position_upper
    q = np.random.default_rng(1).uniform(*limits, (4, n))
    friction = np.array(config.robot.friction(chain)['viscous'])
    return inertia_matrices(base.model, P, q), config.robot.rotors(chain), friction


def joints(stiffness=1e4, motors=0.2, **given):
    """One joint; its spring keeps 3 % of damping."""
    K = None if stiffness is None else np.array([stiffness])
    return Joints(np.array([motors]), np.array([0.5]), K, **given)


def by_velocity(damping):
    """A law that feeds back the velocity of one joint, and little else."""
    zero, little = 0.0 * ONE, 0.1 * ONE
    return Feedback(
        ONE, damping * ONE, zero, little, np.ones(1), 0.004, known_rate=True
    )


LAW = linear(JointGains(np.array([60.0]), np.array([10.0])), np.array([1.2]), 1)


@pytest.mark.parametrize(
    'arm',
    [
        joints(None),
        joints(),
        joints(motor_side=True),
        joints(torque_loop=TorqueLoop()),
        joints(torque_loop=TorqueLoop(), motor_side=True),
    ],
)
@pytest.mark.parametrize('law', [LAW, LAW._replace(damping_lag=0.003)])
def test_the_sampled_loop_and_its_frequency_response_agree(arm, law):
    """Eigenvalues of the loop are zeros of 1 + G C.

    Below 40 Hz, where images of the sampling add less than 1e-3.
    """
    A, _ = Loop(ONE, arm, TIMING, law).transition()
    z = np.linalg.eigvals(A[0])
    z = z[np.abs(z) > 0.5]
    s = np.log(z) / TIMING.period
    s = s[np.abs(s) < 2.0 * np.pi * 40.0]
    assert s.size >= 4
    G = arm_response(ONE, arm, TIMING, s)
    C = law_response(law, TIMING, s)
    np.testing.assert_allclose((G @ C)[0, :, 0, 0], -1.0, rtol=1e-3)


def test_margin_is_the_distance_to_instability():
    """A damping d on a rigid joint of 1.2 kg m^2 is unstable from where its margin is zero."""
    arm = joints(None)

    def loop(damping):
        return Loop(ONE, arm, TIMING, by_velocity(damping))

    margins = [loop(d).margin().value for d in (20.0, 100.0, 200.0, 2000.0)]
    assert margins == sorted(margins, reverse=True)
    assert margins[0] > 0.8
    assert margins[-1] == 0.0
    assert loop(200.0).is_stable()
    assert not loop(2000.0).is_stable()


# What is plausible where nothing but a URDF is known.
SPRINGS = (5e3, 3e4, 1e6)  # N m/rad
SIDES = (False, True)
LOOPS = (None, TorqueLoop())
MOTORS = (0.5, 7.0)  # times the guess


@pytest.mark.parametrize(('preset', 'payload'), [('panda', 2.0), ('ur5e', 3.0)])
def test_gains_of_an_unknown_arm_hold_whatever_its_gears_are(preset, payload):
    """Springs, sides, torque loops and motors of half to seven times the guess."""
    free, guess, viscous = links_of(preset)
    links = np.concatenate((free, links_of(preset, payload)[0][:2]))
    inertia = np.diagonal(links, axis1=1, axis2=2).max(axis=0) + guess
    law = linear(unknown_arm(guess), inertia, len(links))
    for stiffness, side, loop, factor in product(SPRINGS, SIDES, LOOPS, MOTORS):
        arm = Joints(
            factor * guess,
            viscous,
            np.full(len(guess), stiffness),
            torque_loop=loop,
            motor_side=side,
        )
        loop_ = Loop(links, arm, Timing(0.002, 1, 0.002, 0.0025), law)
        assert loop_.is_stable(), (stiffness, side, loop, factor)

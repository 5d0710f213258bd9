# SPDX-License-Identifier: Apache-2.0
"""The generated URDF describes the simulated arm to an independent reader."""

from __future__ import annotations

import numpy as np
import pytest
from plain_law import dynamics

from blf_dsc_controller.arms.two_link_geometry import urdf
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import build
from sim_plant.plant import parameters_of

CONFIG = build(PlantConfig, {'arm.l1': 1.1, 'arm.l2': 0.7, 'arm.m1': 0.6, 'arm.m2': 0.45})
ARM = (1.1, 0.7), (0.6, 0.45)


def test_mujoco_reads_the_same_arm_from_the_urdf():
    """Mass matrix and gravity torque of the URDF, compiled by MuJoCo, against the model's."""
    mujoco = pytest.importorskip('mujoco', reason='needs MuJoCo: pip install mujoco')
    text = urdf('arm', CONFIG.joints, *ARM, (0.0, 0.0))
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.gravity[:] = (0.0, 0.0, -CONFIG.arm.gravity)
    data = mujoco.MjData(model)
    P, r, found = parameters_of(CONFIG), CONFIG.arm.gravity / CONFIG.arm.l1, np.zeros((2, 2))
    for q in np.random.default_rng(0).uniform(-3.0, 3.0, (20, 2)):
        for joint, angle in zip(CONFIG.joints, q, strict=True):
            data.joint(joint).qpos[0] = angle
        mujoco.mj_forward(model, data)
        for i in range(2):
            mujoco.mj_mulM(model, data, found[i], np.eye(2)[i])
        mass, _, weight = dynamics(P, r, q, np.zeros(2))
        np.testing.assert_allclose(found, mass, atol=1e-7)  # points have 1e-9 kg m^2 in it
        np.testing.assert_allclose(data.qfrc_bias, weight, atol=1e-7)


def test_urdf_has_an_effort_limit_only_for_limited_motors():
    assert 'effort="12"' in urdf('arm', ('a', 'b'), *ARM, (12.0, 0.0))
    assert urdf('arm', ('a', 'b'), *ARM, (12.0, 0.0)).count('<limit') == 1
    assert '<joint name="b"' in urdf('arm', ('a', 'b'), *ARM, (0.0, 0.0))

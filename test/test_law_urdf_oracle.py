# SPDX-License-Identifier: Apache-2.0
"""The law of an arm from a URDF equals the one that the pages describe, over 20 s."""

from __future__ import annotations

import numpy as np
import pytest
from plain_urdf_law import PlainArm, PlainUrdfLaw
from random_arm import UR5E, UR5E_TEXT, pinocchio_model

from blf_dsc_controller import load_loop, simulate
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.reference.terms import sampled

PERIOD = 0.004  # s
BOTH = {'sample_time': PERIOD}
FRICTION_FALLS = {
    'duration': 20.0,
    'disturbance.coulomb': [6.0, 6.0, 6.0, 1.1, 2.0, 1.1],
    'events.begin': [13.0],
    'events.duration': [0.0],
    'events.payload': [],
    'events.coulomb': [0.0, 0.0, 0.0, 0.0, -1.8, 0.0],
}
LAW = {
    'learning.change_detection': False,
    'robot.rotor_inertia': [0.4, 0.4, 0.4, 0.07, 0.07, 0.07],
}
WHOLE = {'feedback.inertia': 'whole'}
CASES = {
    'friction': WHOLE,
    'drives': WHOLE | {'robot.drive_compensates': 'gravity'},
    'ripple': WHOLE | {'learning.ripple_cycles': [20.0, 30.0]},
    'rejection': WHOLE | {'learning.excitation_threshold': 1e-3},
    'joints, each on its own': {
        'feedback.inertia': 'none',
        'feedback.joint_stiffness': [600.0] * 3 + [150.0] * 3,
        'feedback.joint_damping': [40.0] * 3 + [8.0] * 3,
    },
}


@pytest.mark.parametrize('name', CASES)
def test_law_of_a_ur5e_is_the_one_of_the_page(name):
    changes = CASES[name]
    robot = {key: x for key, x in changes.items() if key.startswith('robot')}
    loop = load_loop(
        'ur5e_rigid',
        {
            'sim_plant': BOTH | FRICTION_FALLS | robot,
            'blf_dsc_controller': BOTH | LAW | changes,
        },
    )
    record = simulate(loop.controller, loop.plant, supervised=False)
    settings = record.controller.settings
    ours = sample_columns(record.samples, settings)
    arm = PlainArm(pinocchio_model(UR5E_TEXT, UR5E), settings.model.parameter_names)
    plain = PlainUrdfLaw(settings, arm)
    references = sampled(record.controller.reference_vector, record.stamps * 1e-9)
    for k, stamp in enumerate(record.stamps):
        torque = plain.update(
            stamp * 1e-9, PERIOD, *references[k], record.measurements[k]
        )
        learned = ours.estimate[k]
        is_active = ~np.isnan(learned)
        theirs = (
            torque,
            plain.theta[is_active],
            plain.disturbance,
            plain.xi1,
            plain.xi2,
        )
        expected = (
            ours.torque[k],
            learned[is_active],
            ours.disturbance[k],
            ours.xi1[k],
            ours.xi2[k],
        )
        np.testing.assert_allclose(
            np.concatenate(theirs),
            np.concatenate(expected),
            rtol=0.0,
            atol=1e-10,
            err_msg=f'sample {k}',
        )

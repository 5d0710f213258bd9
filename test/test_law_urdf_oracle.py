# SPDX-License-Identifier: Apache-2.0
"""The law of an arm from a URDF equals the one that the pages describe, sample by sample."""

from __future__ import annotations

import numpy as np
import pytest
from plain_urdf_law import PlainArm, PlainUrdfLaw
from random_arm import UR5E, UR5E_TEXT, pinocchio_model
from symbols import replaced

from blf_dsc_controller import controller_of, load_loop
from blf_dsc_controller.law.samples import sample_columns
from blf_dsc_controller.messages.journal import Journal
from blf_dsc_controller.reference.terms import sampled
from blf_dsc_controller.simulation.loop import new_record, run_alone
from sim_plant.plant import plant_of

PERIOD = 0.004  # s
BOTH = {'sample_time': PERIOD}
# It learns from 5 s on.  One run goes on for more than a window of 5 s after its friction fell.
DURATION, LONGEST = 9.0, 13.0  # s
# Something pushes as joints reverse.
FRICTION_FALLS = {
    'disturbance.coulomb': [6.0, 6.0, 6.0, 1.1, 2.0, 1.1],
    'events.begin': [7.0, 8.0],
    'events.duration': [0.0, 0.5],
    'events.payload': [],
    'events.coulomb': [0.0, 0.0, 0.0, 0.0, -1.8, 0.0] + [0.0] * 6,
    'events.torque': [0.0] * 6 + [10.0] * 3 + [3.0] * 3,
}
LAW = {
    'robot.rotor_inertia': [0.4, 0.4, 0.4, 0.07, 0.07, 0.07],
}
WHOLE = {'feedback.inertia': 'whole'}
CASES = {
    'friction': WHOLE,
    'drives': WHOLE | {'robot.drive_compensates': 'gravity'},
    'ripple': WHOLE | {'learning.ripple_cycles': [20.0, 30.0]},
    'rejection': WHOLE,
    'joints, each on its own': {
        'feedback.inertia': 'none',
        'feedback.joint_stiffness': [600.0] * 3 + [150.0] * 3,
        'feedback.joint_damping': [40.0] * 3 + [8.0] * 3,
    },
}


def unchecked(loop):
    """Run the law alone, which detects no change and begins to learn with a full window."""
    law = controller_of(loop.controller)
    changes = {'change_detection': 0, 'starts_full': 1}
    law.retune(law.law, replaced(law.settings, **changes))
    record = new_record(law, loop.controller, loop.plant, Journal())
    run_alone(record, plant_of(loop.plant))
    return record


@pytest.mark.parametrize('name', CASES)
def test_law_of_a_ur5e_is_the_one_of_the_page(name):
    changes = CASES[name]
    robot = {key: x for key, x in changes.items() if key.startswith('robot')}
    duration = {'duration': LONGEST if name == 'friction' else DURATION}
    loop = load_loop(
        'ur5e_rigid',
        {
            'sim_plant': BOTH | FRICTION_FALLS | duration | robot,
            'blf_dsc_controller': BOTH | LAW | changes,
        },
    )
    record = unchecked(loop)
    settings = record.controller.settings
    ours = sample_columns(record.samples, settings)
    arm = PlainArm(pinocchio_model(UR5E_TEXT, UR5E), settings.model.parameter_names)
    plain = PlainUrdfLaw(settings, arm)
    references = sampled(record.controller.reference_vector, record.stamps * 1e-9)
    is_active = ~np.isnan(ours.estimate)
    theirs = []
    for k, stamp in enumerate(record.stamps):
        torque = plain.update(
            stamp * 1e-9, PERIOD, *references[k], record.measurements[k]
        )
        learned = np.where(is_active[k], plain.theta, np.nan)
        theirs.append([*torque, *learned, *plain.disturbance, *plain.xi1, *plain.xi2])
    expected = (ours.torque, ours.estimate, ours.disturbance, ours.xi1, ours.xi2)
    np.testing.assert_allclose(theirs, np.hstack(expected), rtol=0.0, atol=1e-10)

# SPDX-License-Identifier: Apache-2.0
"""Arms that change while they are learned: payloads, releases and pushes, as events of the plant.

Each broke the bound of the recommended set before learning checked its windows.
"""

from __future__ import annotations

import numpy as np

BOUND = 2e-3  # rad
WINDOW = 2.0 * np.pi  # s
OFF = {'learning.weight': 0.0}
CHANGED = 20.0  # s

PAYLOADS = [0.25, 0.3, 0.6, 0.65, 0.7, 0.75, 0.8, 1.0]  # kg, mass at the tip, 0.5 before
PUSHES = [(1, 1.0, 3.0), (1, 2.0, 2.0), (0, 3.0, 3.0)]  # joint, N m, s


def payload(m2, begin=CHANGED):
    """Parameters of a plant whose mass at the tip becomes `m2` [kg]; less is a release."""
    if m2 >= 0.5:
        return {'events.begin': [begin], 'events.payload': [m2 - 0.5]}
    released = {'events.begin': [0.0], 'events.duration': [begin], 'events.payload': [0.5 - m2]}
    return {'arm.m2': m2, **released}


def push(joint, torque, seconds, begin=CHANGED):
    """Parameters of a plant that is pushed by a torque [N m] on a joint for some seconds."""
    torques = [0.0, 0.0]
    torques[joint] = torque
    return {
        'events.begin': [begin],
        'events.duration': [seconds],
        'events.torque': torques,
    }

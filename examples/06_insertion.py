# SPDX-License-Identifier: Apache-2.0
"""Insertion without a force sensor: advance until something touches the arm, back off, go on.

python examples/06_insertion.py

The simulated arm is pushed back twice by 25 N, as by the edge of a hole.  With the
reaction `hold`, the law stops the reference by itself at a contact, within milliseconds.
"""

import numpy as np

import blf_dsc_controller as blf

OVERRIDES = {
    'blf_dsc_controller': {
        'contact.enabled': True,
        'contact.reaction': 'hold',
        'contact.loads': False,
    },
    'sim_plant': {
        'events.begin': [14.5, 16.5],
        'events.duration': [0.5, 0.5],
        'events.payload': [0.0, 0.0],
        'events.force': [0.0, 0.0, 25.0, 0.0, 0.0, 25.0],
    },
}
ADVANCE = np.array([0.0, 0.25, 0.0, 0.05, 0.0, -0.2, 0.0])  # rad: the hand goes down

with blf.Drive('panda', OVERRIDES, robot='simulated') as arm:
    start = arm.state.q
    # Contact is what the learned model does not explain: let it be learned first.
    times = np.arange(0.1, 12.05, 0.1)
    waves = np.sin(np.outer(times, 1.5 + 0.3 * np.arange(7)))
    swell = 0.1 * np.sin(np.pi * times / 12.0) ** 2  # rad
    arm.follow(list(zip(times, start + swell[:, None] * waves, strict=True)))
    arm.move_to(start)
    contacts = 0
    while True:
        try:
            arm.move_to(start + ADVANCE, speed=0.1)
        except blf.MotionFailedError as error:
            contacts += 1
            print(f'{arm.state.time:5.2f} s: {error}')
            arm.move_to(arm.state.reference - 0.1 * ADVANCE)  # away from it
        else:
            break
    print(f'inserted after {contacts} contacts')

# SPDX-License-Identifier: Apache-2.0
"""An OpenArm whose Damiao motors close the feedback, as frames at 250 Hz tell them.

python examples/10_openarm.py [ROBOT]    (simulated; can0: an arm)

`yam` for `openarm` needs no changes: that preset is for its motors.
"""

import sys
import time

import numpy as np

import blf_dsc_controller as blf

TIMES = {'sample_time': 0.004}  # s: 14 frames of 1 Mbit/s take about 1.8 ms
MOTORS = {
    'drive': {'driver': 'damiao', 'feedback': 'motor'},
    'blf_dsc_controller': {**TIMES, 'robot.lag': 0.006},
    'sim_plant': TIMES,
}

robot = sys.argv[1] if len(sys.argv) > 1 else 'simulated'
with blf.Drive('openarm', MOTORS, robot=robot) as arm:
    start = arm.state.q
    for way in (0.3, 0.0):
        arm.move_to(start + way, speed=0.5, wait=False)
        worst = 0.0
        while arm.is_moving:
            worst = max(worst, np.abs(arm.state.error).max())
            time.sleep(0.01)
        there = np.round(arm.state.q, 2)
        print('at', there, f'rad: {1e3 * worst:.1f} mrad off on the way')

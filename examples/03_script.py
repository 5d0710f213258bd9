# SPDX-License-Identifier: Apache-2.0
"""Command an arm from a script: `blf.Drive` runs the loop in a process of its own.

python examples/03_script.py [ROBOT] [CONFIG]    (simulated, panda)
"""

import sys
import time

import numpy as np

import blf_dsc_controller as blf

robot = sys.argv[1] if len(sys.argv) > 1 else 'simulated'
config = sys.argv[2] if len(sys.argv) > 2 else 'panda'
with blf.Drive(config, robot=robot) as arm:
    start = arm.state.q
    print('started at', np.round(start, 3), 'rad')

    # straight to a posture, and back with all that the limits allow
    step = np.zeros(len(arm.joints))
    step[3] = 0.3
    arm.move_to(start + step, speed=0.3)
    arm.move_to(start, speed=1.0)

    # through points, at times from now [s]; velocities may follow the positions
    arm.follow([(1.0, start + step), (2.0, start + 0.5 * step), (3.0, start)])

    # a stream: the latest target wins, and the arm rests there when none follows
    for k in range(60):
        arm.stream(start + 0.2 * step * np.sin(k / 10.0))
        time.sleep(1.0 / 30.0)
    arm.stop()

    state = arm.state
    print(
        'largest error', f'{1e3 * np.abs(state.error).max():.2f} mrad, in', state.phase
    )

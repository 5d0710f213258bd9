# SPDX-License-Identifier: Apache-2.0
"""Two arms in step, each in a loop of its own: a bag and a stop of each.

python examples/12_two_arms.py [LEFT RIGHT]    (simulated; can0 can1: two arms)

Arms of one URDF have `robot.base` and `robot.tip` each, as overrides or in a file of their own.
"""

import sys
import time

import numpy as np

import blf_dsc_controller as blf

left_robot, right_robot = sys.argv[1:] or ('simulated', 'simulated')
with (
    blf.Drive('openarm', robot=left_robot) as left,
    blf.Drive('openarm', robot=right_robot) as right,
):
    arms = left, right
    starts = [arm.state.q for arm in arms]
    for way in (0.3, 0.0):
        begin = time.time() + 0.5  # time for both to plan
        for arm, start in zip(arms, starts, strict=True):
            arm.follow([(2.0, start + way)], begin=begin, wait=False)
        apart = 0.0
        while left.is_moving and right.is_moving:
            ways = [
                arm.state.reference - start
                for arm, start in zip(arms, starts, strict=True)
            ]
            apart = max(apart, np.abs(ways[0] - ways[1]).max())
            time.sleep(0.01)
        for arm in arms:
            arm.wait()
        print(f'at {way} rad; seen at most {1e3 * apart:.1f} mrad apart')

# SPDX-License-Identifier: Apache-2.0
"""A long run of both nodes in a loop, with a fault every few seconds.

`python test/soak.py --minutes 30` (or `make soak`) runs half an hour of plant time.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections import Counter
from pathlib import Path

# Before anything of ROS is imported.
os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(
    Path(__file__).with_name('one_process.xml')
)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SYSTEM_DEFAULT'

import numpy as np
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from ros_rig import RosRig, activate, deactivate

import blf_dsc_controller as blf
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode


class Loop:
    """The loop and its faults."""

    def __init__(self, seed):
        self.ros = RosRig()
        self.rng = np.random.default_rng(seed)
        self.arm, self.law = self.ros.loop()

    def push(self):
        """Strike the arm: its velocities jump."""
        self.arm.plant.state[3:5] += self.rng.normal(0.0, 1.0, 2)

    def new_gains(self):
        """Request twenty changes of gains."""
        name = f'{self.law.get_fully_qualified_name()}/set_parameters_atomically'
        for _ in range(20):
            gain = ([60.0, 20.0] * self.rng.uniform(0.5, 1.5, 2)).tolist()
            parameter = Parameter(
                'two_link.feedback_gain', value=gain
            ).to_parameter_msg()
            request = SetParametersAtomically.Request(parameters=[parameter])
            self.ros.call(SetParametersAtomically, name, request)

    def kill_controller(self):
        self.ros.kill(self.law)
        self.law = self.ros.add(ControllerNode)
        self.ros.reset(self.arm)

    def kill_plant(self):
        self.ros.kill(self.arm)
        self.arm = self.ros.add(PlantNode, mode='lockstep')
        self.ros.spin(0.3)
        self.ros.reset(self.arm)

    def pause_both(self):
        for change, nodes in (
            (deactivate, (self.law, self.arm)),
            (activate, (self.arm, self.law)),
        ):
            assert all(change(self.ros, node) for node in nodes)

    def reset_one(self):
        self.ros.reset(self.arm if self.rng.random() < 0.5 else self.law)


FAULTS = (
    'push',
    'new_gains',
    'kill_controller',
    'kill_plant',
    'pause_both',
    'reset_one',
)


def soak(loop, samples):
    """Run for `samples`, not counting those during faults; fail if anything grows."""
    done = 0
    worst = 0.0
    faults = Counter()
    used = []
    while done < samples:
        count = int(loop.rng.integers(1000, 4000))
        loop.ros.run(loop.arm, count)
        assert loop.law.guard.supervisor.running, loop.law.guard.supervisor.text
        done = done + count
        worst = max(worst, float(loop.law.guard.samples.ratio.max()))
        fault = loop.rng.choice(FAULTS)
        faults[str(fault)] += 1
        getattr(loop, fault)()
        loop.ros.spin(0.02)
        if (
            loop.law.guard.supervisor.phase is blf.Phase.SAFE_STOP
            or loop.arm.plant.sample == 0
        ):
            assert loop.ros.reset(loop.arm).success
        loop.ros.until(lambda: loop.law.guard.supervisor.phase is blf.Phase.TRACKING)
        gc.collect()
        pages = int(Path('/proc/self/statm').read_text().split()[1])
        used.append(
            (
                pages * os.sysconf('SC_PAGE_SIZE') / 1e6,
                len(list(Path('/proc/self/fd').iterdir())),
            )
        )
    growth, extra = np.subtract(used[-1], used[max(1, len(used) // 4)])
    print(
        f'{done} samples, {dict(faults)}\n'
        f'largest error against the bound outside of them: {worst:.2f}\n'
        f'since the first quarter: {growth:+.1f} MB, {extra:+.0f} handles',
        file=sys.stderr,
    )
    assert worst < 1.0
    # Every restarted node costs the middleware about 50 kB, and the heap takes time to
    # settle.
    assert growth < 0.02 * len(used) + 10.0
    assert extra <= 0


if __name__ == '__main__':
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument(
        '--minutes', type=float, default=30.0, help='of the plant (30)'
    )
    options.add_argument('--seed', type=int, default=0)
    given = options.parse_args()
    loop = Loop(given.seed)
    try:
        soak(loop, round(given.minutes * 60_000))
    finally:
        loop.ros.close()

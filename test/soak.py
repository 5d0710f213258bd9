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
os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(Path(__file__).with_name('one_process.xml'))
os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 101))
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')

import numpy as np
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from ros_rig import RosRig, activate, deactivate

from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.supervision.supervisor import Phase

PAGE = os.sysconf('SC_PAGE_SIZE')


class Soak:
    """The loop and its faults, with what was seen of them."""

    def __init__(self, seed):
        self.ros = RosRig()
        self.rng = np.random.default_rng(seed)
        self.arm, self.law = self.ros.loop()
        self.samples = 0  # outside of faults
        self.worst = 0.0  # largest |xi1| / k_c outside of faults
        self.faults = Counter()
        self.memory, self.handles = [], []  # MB, and open files and sockets, after each fault

    def run(self, samples):
        """Run for a total of `samples`, not counting those during faults."""
        while self.samples < samples:
            count = int(self.rng.integers(1000, 4000))
            self.ros.run(self.arm, count)
            guard = self.law.guard
            assert guard.supervisor.running, guard.supervisor.text
            self.samples += count
            self.worst = max(self.worst, float(guard.samples.ratio.max()))
            fault = self.rng.choice(FAULTS)
            self.faults[fault.__name__] += 1
            fault(self)
            self.ros.spin(0.02)
            self.recover()
            gc.collect()
            pages = int(Path('/proc/self/statm').read_text().split()[1])
            self.memory.append(pages * PAGE / 1e6)
            self.handles.append(len(list(Path('/proc/self/fd').iterdir())))

    def recover(self):
        """Reset the loop if it has stopped, and wait until it tracks."""
        if self.law.guard.supervisor.phase is Phase.SAFE_STOP or self.arm.plant.sample == 0:
            assert self.ros.reset(self.arm).success
        self.ros.until(lambda: self.law.guard.supervisor.phase is Phase.TRACKING)

    def judge(self):
        """Print what was seen; fail if the bound was left or anything grew."""
        quarter = max(1, len(self.memory) // 4)
        growth, extra = (x[-1] - x[quarter] for x in (self.memory, self.handles))
        print(
            f'{self.samples} samples, {dict(self.faults)}\n'
            f'largest error against the bound outside of them: {self.worst:.2f}\n'
            f'since the first quarter: {growth:+.1f} MB, {extra:+d} handles',
            file=sys.stderr,
        )
        assert self.worst < 1.0
        # Every restarted node costs the middleware about 50 kB, and the heap takes time to settle.
        assert growth < 0.02 * len(self.memory) + 10.0
        assert extra <= 0


def push(soak):
    """Strike the arm: its velocities jump."""
    soak.arm.plant.state[3:5] += soak.rng.normal(0.0, 1.0, 2)


def new_gains(soak):
    """Request twenty changes of gains."""
    name = f'{soak.law.get_fully_qualified_name()}/set_parameters_atomically'
    for _ in range(20):
        gain = (np.array([60.0, 20.0]) * soak.rng.uniform(0.5, 1.5, 2)).tolist()
        request = SetParametersAtomically.Request(
            parameters=[Parameter('feedback.gain', value=gain).to_parameter_msg()]
        )
        soak.ros.call(SetParametersAtomically, name, request)


def kill_controller(soak):
    soak.ros.kill(soak.law)
    soak.law = soak.ros.add(ControllerNode)
    soak.ros.reset(soak.arm)


def kill_plant(soak):
    soak.ros.kill(soak.arm)
    soak.arm = soak.ros.add(PlantNode, mode='lockstep')
    soak.ros.spin(0.3)
    soak.ros.reset(soak.arm)


def pause_both(soak):
    for node in (soak.law, soak.arm):
        assert deactivate(soak.ros, node)
    for node in (soak.arm, soak.law):
        assert activate(soak.ros, node)


def reset_one(soak):
    soak.ros.reset(soak.arm if soak.rng.random() < 0.5 else soak.law)


FAULTS = (push, new_gains, kill_controller, kill_plant, pause_both, reset_one)


if __name__ == '__main__':
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument('--minutes', type=float, default=30.0, help='of the plant (30)')
    options.add_argument('--seed', type=int, default=0)
    given = options.parse_args()
    soak = Soak(given.seed)
    try:
        soak.run(round(given.minutes * 60_000))
    finally:
        soak.ros.close()
    soak.judge()

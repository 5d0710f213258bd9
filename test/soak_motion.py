# SPDX-License-Identifier: Apache-2.0
"""Episodes of resets, activations and kills in motion, after which no joint may be faster.

`python test/soak_motion.py --episodes 200 --busy 10` runs an FR3 and a UR5e, each with 2 kg that
nobody has told of, beside ten busy processes.  The arm and its watchdog are in this process, the
controller in one of its own.  The arm's clock is slower than the computer's, and nearly stands
while the computer lets a controller wait that should answer: what is looked for are the
consequences of an event, not those of a computer that is too slow for the loop.

A controller that hangs and goes on finds one of the states of the meantime in its queue, and then
the newest, while the watchdog has braked the arm.  It also hangs right after it was started again,
before it has learned what the watchdog held.

While nobody commands, the drives hold the last torque, and the arm keeps its acceleration, as its
reference would: 2.3 rad/s^2 of an FR3 or a UR5e add 0.12 rad/s in the 52 ms of a watchdog.  What is
asked for includes that, by the silence that was, which is printed.

The watchdog then brakes the arm by its model without the load.  A light wrist is dragged along by
what the load lacks there, the torque dM a of its inertia dM at the acceleration a of the other
joints, until it is observed: by dM a (1/L1 + 1/L2) over the inertia of the wrist.  While the
watchdog brakes, and no longer, a joint may be faster by that.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
from collections import Counter, defaultdict, deque
from functools import partial
from pathlib import Path

# Before anything of ROS is imported.
os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(
    Path(__file__).with_name('one_process.xml')
)

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from ros_rig import PATIENCE, PatientClock, RosRig
from std_srvs.srv import Trigger

import blf_dsc_controller as blf
from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.messages import topics
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.watchdog_node import WatchdogNode
from blf_dsc_controller.supervision.observed_load import OBSERVER
from blf_dsc_controller.tool.tip_wrench import TipWrench

CONTROLLER = '/blf_dsc_controller'
LOAD = {'events.begin': [0.0], 'events.duration': [1e6], 'events.payload': [2.0]}
PATIENT = {'safety.state_timeout': 10.0}
# ends with the process that started it
BUSY = (
    'import os; os.nice(10); parent = os.getppid()\nwhile os.getppid() == parent: pass'
)
SLACK = 0.2  # rad/s beyond what the reference asks, as in `test_hang`
USUAL, WAITING = 5, 100  # times slower than the computer's clock
LATE = 3  # samples without a torque, from which on the arm waits for it
MOVING = 0.1  # rad/s, beyond which an episode begins
OBSERVED = sum(1.0 / rate for rate in OBSERVER)  # s, until the watchdog sees a load
AVERAGED = 0.01  # s, over which the acceleration is a difference


class Load:
    """The load in the hand, and the inertia of the arm without it."""

    def __init__(self, config):
        self._settings = settings_of_config(config)
        self._tip = TipWrench(config.robot.chain(config.joints))
        self._samples = round(AVERAGED / config.sample_time)

    def drag(self, q, velocities):
        """Return by how much (n,) [rad/s] it drags joints that brake at q (n,), unobserved.

        `velocities` are (k, n) [rad/s].
        """
        settings, k = self._settings, self._samples
        P = settings.initial_estimate[: settings.p]
        M = inertia_matrices(settings.model, P, q[np.newaxis])[0]
        J = self._tip.jacobian(q)[:3]
        dM = LOAD['events.payload'][0] * J.T @ J
        of_others = dM - np.diag(np.diagonal(dM))
        a = (velocities[k:] - velocities[:-k]) / AVERAGED
        return OBSERVED * np.abs(a @ of_others).max(axis=0) / np.diagonal(M + dM)


class Episodes:
    """An arm, its watchdog, its controller, and what happens to them."""

    def __init__(self, preset, seed):
        self.rng = np.random.default_rng(seed)
        self.ros = RosRig()
        self.clock = PatientClock(USUAL)
        self.is_interrupted = False
        self.file = blf.share_folder() / 'config' / f'{preset}.yaml'
        plant = flatten(blf.load_loop(self.file).plant) | LOAD
        self.arm = self.ros.add(PlantNode, plant, clock=self.clock)
        self.joints = len(self.arm.config.joints)
        self.load = Load(blf.load_loop(self.file).controller)
        self.velocities = deque(maxlen=100_000)  # (n,) of each sample
        self.braked = []  # samples from a silence on, and the posture (n,) [rad] there
        self._watch_speeds()
        self.asked = self.ros.listen(topics.REFERENCE)
        self.silence = (
            0.0  # s without a torque of anybody, the longest of an interruption
        )
        self.goes_on = []  # speeds (n,) [rad/s] that the reference has at the end of a silence
        self.state = self.ros.listen(topics.STATE)
        self.controller = None
        self.add_watchdog()
        self.start_controller()

    def _watch_speeds(self):
        step, n = self.arm.plant.step, self.joints

        def step_and_look(torque):
            step(torque)
            age = self.arm.plant.sample - self.arm.input._taken_at
            self.silence = max(self.silence, age * self.arm.config.sample_time)
            waits = age > LATE and not self.is_interrupted
            self.clock.slower = WAITING if waits else USUAL
            self.velocities.append(self.arm.plant.truth()[-n:].copy())

        self.arm.plant.step = step_and_look

    def add_watchdog(self):
        self.watchdog = self.ros.add(partial(WatchdogNode, steady=self.clock))

    def start_controller(self):
        words = [
            word
            for name, value in PATIENT.items()
            for word in ('-p', f'{name}:={value}')
        ]
        module = 'blf_dsc_controller.nodes.controller_node'
        self.controller = subprocess.Popen(
            [
                sys.executable,
                *('-m', module, '--ros-args', '--params-file', self.file),
                *words,
            ],
            env=os.environ | {'ROS_DOMAIN_ID': str(self.ros.context.get_domain_id())},
            stderr=subprocess.DEVNULL,
        )

    def close(self):
        self.controller.kill()
        self.controller.wait()
        self.ros.close()

    # What happens.

    def reset(self):
        request = Trigger.Request()
        self.ros.call(Trigger, f'{CONTROLLER}/reset', request)

    def pause(self):
        """Deactivate, and activate again while the arm still moves."""
        self._change(Transition.TRANSITION_DEACTIVATE)
        self._run(self.rng.uniform(0.005, 0.3))
        self._change(Transition.TRANSITION_ACTIVATE)

    def kill_controller(self):
        """Start it again while the watchdog brings the arm to rest."""
        self._kill_controller()
        self._run(self.rng.uniform(0.0, 0.5))
        self.start_controller()

    def hang_at_start(self):
        """Start it again, and let it hang as soon as it is in command."""
        self._kill_controller()
        self.state.clear()
        self.start_controller()
        self.ros.until(
            lambda: self.state and self.state[-1].message.startswith('approaching')
        )
        self.hang_controller()

    def _kill_controller(self):
        self._begin_silence(round(0.5 / self.arm.config.sample_time))
        self.controller.kill()
        self.controller.wait()
        self.ros.until(lambda: self.watchdog.watchdog.active)
        self._end_silence()

    def hang_controller(self):
        self._begin_silence()
        self.controller.send_signal(signal.SIGSTOP)
        self._run(self.rng.uniform(0.02, 0.5))
        self._end_silence()
        during, q = self.braked.pop()
        self.braked.append((slice(during.start, len(self.velocities)), q))
        self.controller.send_signal(signal.SIGCONT)

    def _begin_silence(self, most=0):
        """The watchdog brakes for so many samples at `most`, if given."""
        self.is_interrupted = True
        self.silence = 0.0
        begin = len(self.velocities)
        q = self.arm.plant.truth()[-2 * self.joints : -self.joints].copy()
        self.braked.append((slice(begin, begin + most), q))

    def _end_silence(self):
        """Count as asked for what the reference would have asked in the silence.

        Its acceleration is the one that the last torque has given the arm.
        """
        self.is_interrupted = False
        before, last = list(self.asked)[-2:]
        seconds = 1e-9 * (_nanoseconds(last) - _nanoseconds(before))
        acceleration = (np.array(last.velocity) - before.velocity) / seconds
        self.goes_on.append(np.abs(last.velocity + acceleration * self.silence))

    def kill_watchdog(self):
        self.ros.kill(self.watchdog)
        self._run(self.rng.uniform(0.0, 0.5))
        self.add_watchdog()

    def _change(self, transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        self.ros.call(ChangeState, f'{CONTROLLER}/change_state', request)

    def _run(self, seconds):
        self.ros.run(self.arm, round(seconds / self.arm.config.sample_time))

    # What is seen.

    def begin(self):
        """Return the speeds (n,) [rad/s] that the arm had before, once it tracks in motion."""
        samples = round(0.2 / self.arm.config.sample_time)
        self.recover()
        self._run(self.rng.uniform(1.0, 3.0))
        self.ros.until(lambda: np.abs(self.velocities[-1]).max() > MOVING)
        return np.abs(list(self.velocities)[-samples:]).max(axis=0)

    def recover(self):
        """Bring the loop back after a stop or a refusal."""
        if self.controller.poll() is not None:
            self.start_controller()
        self.ros.until(lambda: self.state and self.watchdog.watchdog is not None)
        try:
            self.ros.until(self._tracks, PATIENCE)
        except AssertionError as error:
            raise AssertionError(f'never tracks again: {self.state[-1]}') from error

    def _tracks(self):
        if self.controller.poll() is not None:
            self.start_controller()
            self.ros.spin(1.0)
        name = self.state[-1].message
        if name.startswith(('stop', 'safe')):
            self.reset()
            self.ros.spin(0.2)
        return self.state[-1].message == 'tracking'

    def episode(self, name):
        """Return by how much [rad/s] a joint was faster than before and than it was asked to be."""
        before = self.begin()
        self.velocities.clear()
        self.braked.clear()
        del self.asked[:-2]  # the last acceleration that was asked for
        self.goes_on.clear()
        self.silence = 0.0
        getattr(self, name)()
        self._run(1.0)
        asked = [np.abs(each.velocity) for each in self.asked] + self.goes_on
        most = np.max([before, *asked], axis=0)
        velocities = np.array(self.velocities)
        speeds = np.abs(velocities)
        for during, q in self.braked:
            speeds[during] -= self.load.drag(q, velocities[during])
        return float((speeds - most).max())


def _nanoseconds(message):
    stamp = message.header.stamp
    return stamp.sec * 1_000_000_000 + stamp.nanosec


NAMES = (
    'reset',
    'pause',
    'kill_controller',
    'hang_controller',
    'hang_at_start',
    'kill_watchdog',
)


def soak(preset, episodes, seed):
    """Return the excess of each episode by its name."""
    found = defaultdict(list)
    run = Episodes(preset, seed)
    try:
        for number in range(episodes):
            name = NAMES[number % len(NAMES)]
            found[name].append(run.episode(name))
            print(
                f'{preset} {number} {name} {found[name][-1]:+.3f} rad/s, at most '
                f'{run.silence:.3f} s without a torque',
                flush=True,
            )
    finally:
        run.close()
    return found


if __name__ == '__main__':
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument('--episodes', type=int, default=200)
    options.add_argument('--busy', type=int, default=0, help='busy processes beside')
    options.add_argument('--seed', type=int, default=0)
    given = options.parse_args()
    busy = [subprocess.Popen([sys.executable, '-c', BUSY]) for _ in range(given.busy)]
    try:
        faster = Counter()
        for preset in ('fr3', 'ur5e_driver'):
            for name, excess in soak(preset, given.episodes // 2, given.seed).items():
                print(f'{preset:12} {name:16} worst {max(excess):+.3f} rad/s')
                faster[preset] += sum(each > SLACK for each in excess)
        assert not faster.total(), faster
    finally:
        for process in busy:
            process.kill()

# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc drive` on franky-sim's FR3: Franka's bindings on one side, nothing of ours on the other.

The simulator is a process of its own, in lock-step (`franka_simulator.py`), and so is
the command.
"""

from __future__ import annotations

import importlib.util
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from command import COMPILED, PATIENCE, own_address

import blf_dsc_controller as blf
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.drive.driver import (
    ConnectionLostError,
    DriverError,
    ReflexError,
    disagreements,
)
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.tip_load import TipLoad

if not all(map(importlib.util.find_spec, ('pylibfranka', 'franky_sim'))):
    pytest.skip('needs pylibfranka and franky-sim', allow_module_level=True)

import pylibfranka

from blf_dsc_controller.drive.franka import FrankaDriver

SIMULATOR = Path(__file__).with_name('franka_simulator.py')
BOUND = 0.04  # rad, of the preset


class Wire:
    """Simulator and commands of a test, at an address of its own.

    Every process is killed when the patience with it ends.
    """

    patience = COMPILED  # s; of the first test, whose kernels may be compiled

    def __init__(self, folder):
        self.folder = folder
        self.address = own_address()
        self.processes = []
        self.timers = []

    def start(self, *words):
        process = subprocess.Popen(
            [sys.executable, *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.processes.append(process)
        self.timers.append(threading.Timer(self.patience, process.kill))
        self.timers[-1].start()
        return process

    def simulate(self, *events):
        """Start a simulator, and wait until it accepts connections."""
        process = self.start(SIMULATOR, self.address, *events)
        assert process.stdout.readline().strip() == 'ready'
        return process

    def drive(self, duration, *options):
        words = ['--robot', self.address, '--duration', duration, *options]
        out = ['--out', self.folder / 'bag']
        return self.start('-m', 'blf_dsc_controller', 'drive', *words, *out)

    def until(self, process, words):
        """Read what a process prints up to a line with these words."""
        for line in process.stdout:
            if words in line:
                return
        pytest.fail(f'{words!r} was not printed')

    def close(self):
        for timer, process in zip(self.timers, self.processes, strict=True):
            timer.cancel()
            process.kill()
            process.wait()
            process.stdout.close()
        Wire.patience = PATIENCE


@pytest.fixture
def wire(tmp_path):
    found = Wire(tmp_path)
    yield found
    found.close()


def ended(process):
    """Return exit code and output of a command."""
    output, _ = process.communicate()
    return process.returncode, output


def assert_replays(folder):
    verified = blf.verify(folder)
    assert verified.difference is None
    assert not any(found.missing for found in verified.comparisons)


def test_it_tracks_and_holds_two_kilograms_that_appear_in_the_hand(wire):
    """With topics beside it, where there is ROS."""
    wire.simulate('load=2@500', 'load=0@1000')
    beside = ['--ros'] if importlib.util.find_spec('rclpy') else []
    code, output = ended(wire.drive(1.5, *beside))
    assert code == 0, output
    assert not any(line.startswith('topics') for line in output.splitlines()), output
    assert 'end effector of 0.73 kg' in output
    recorded = blf.read_run(wire.folder / 'bag')
    assert set(np.diff(recorded.stamp)) == {1_000_000}  # ns: no state was missed
    assert recorded.stamp.size > 1500  # 1.5 s, and the end
    assert topics.MOTOR_STATES.resolved not in message_counts(wire)  # it reports zeros
    assert np.nanmax(np.abs(recorded.error)) < BOUND
    assert_replays(wire.folder / 'bag')


def message_counts(wire):
    return read_content(wire.folder / 'bag').message_counts


def told_config():
    """Return the preset with `load.tell_drive`."""
    preset = (blf.share_folder() / 'config/fr3_direct.yaml').read_text()
    section = '/**/blf_dsc_controller:\n  ros__parameters:\n'
    return preset.replace(section, f'{section}    load: {{tell_drive: true}}\n')


def test_weighed_load_is_told_in_motion_and_no_torque_steps(wire, tmp_path):
    """The robot adds 2 kg in the end, and the whole torque of each joint (tau_J) goes on.

    Steps are those of the motion before the pick-up, and 0.5 % of the torque limit.
    """
    (tmp_path / 'my.yaml').write_text(told_config())
    wire.simulate('load=2@2500')
    code, output = ended(wire.drive(5.5, '--config', tmp_path / 'my.yaml'))
    assert code == 0, output
    assert 'no longer declared' not in output
    events = blf.verify(wire.folder / 'bag').events
    loads = [event for event in events if event.type == 'drive load']
    assert loads[-1].content['mass'] == pytest.approx(2.0, abs=0.15)
    recorded = blf.read_run(wire.folder / 'bag')
    # The pick-up alone: partial windows used to be contradicted nine times in 5 s.
    assert blf.measure(recorded).model_changes == pytest.approx([2.5], abs=0.2)
    effort = recorded.effort
    begin, end = (
        int(np.searchsorted(recorded.stamp, each.stamp))
        for each in (loads[0], loads[-1])
    )
    usual = np.abs(np.diff(effort[1000:2400], axis=0)).max(axis=0)
    steps = np.abs(np.diff(effort[begin - 5 : end + 5], axis=0)).max(axis=0)
    limit = np.array((87.0,) * 4 + (12.0,) * 3)
    assert (steps < 1.5 * usual + 0.005 * limit).all()
    assert_replays(wire.folder / 'bag')


@pytest.mark.parametrize(
    ('event', 'texts'),
    [
        ('reflex@500', ['the robot stopped by itself', 'recovered']),
        (
            'lose=100@500',
            ['the controller stopped', 'after the last one'],
        ),
        ('die@500', ['the connection was lost', 'check its computer']),
    ],
)
def test_faults_on_the_wire_end_the_run_with_a_reason(wire, event, texts):
    wire.simulate(event)
    code, output = ended(wire.drive(60))
    assert code == 5, output
    assert all(text in output for text in texts), output
    assert_replays(wire.folder / 'bag')


def test_commissioning_starts_torques_again_for_the_motion_and_ends_with_a_reflex(
    wire, tmp_path
):
    """The move, of 2500 states, is over by then: the reflex is in the motion."""
    wire.simulate('reflex@3000')
    rest = [0.0, 0.0, 0.0, -1.57, 0.0, 1.57, 0.785]  # rad, where the simulator begins
    words = ['commission', '--config', 'fr3_direct', '--robot', wire.address, '--yes']
    out = ['--out', tmp_path / 'out.yaml', '--posture', *rest]
    code, output = ended(wire.start('-m', 'blf_dsc_controller', *words, *out))
    assert code == 5, output
    assert 'posture 1: the robot stopped by itself' in output
    assert 'recovered' in output
    assert not (tmp_path / 'out.yaml').exists()
    for name in ('move_1', 'posture_1'):
        assert_replays(tmp_path / 'out_bags' / name)


def test_sigterm_ends_at_rest_and_a_killed_command_leaves_a_robot_that_can_be_used(
    wire,
):
    wire.simulate()
    killed = wire.start('-m', 'blf_dsc_controller', 'drive', '--robot', wire.address)
    wire.until(killed, 'controlling')
    killed.kill()
    killed.wait()
    process = wire.drive(60)
    wire.until(process, 'controlling')
    process.send_signal(signal.SIGTERM)
    code, output = ended(process)
    assert code == 130, output
    assert 'ended on request' in output


def test_a_script_moves_it_and_takes_command_again_after_a_reflex(wire):
    """The reflex comes in the second motion."""
    wire.simulate('reflex@2500')
    bag = wire.folder / 'bag'
    with blf.Drive('fr3_direct', robot=wire.address, record=bag) as arm:
        start = arm.state.q
        arm.move_to(start + 0.1)
        np.testing.assert_allclose(arm.state.q, start + 0.1, atol=0.5 * BOUND)
        long = [(60.0, start - 0.2)]
        with pytest.raises(blf.LoopEndedError, match=r'stopped by itself: .*recovered'):
            arm.follow(long)
        arm.recover()
        arm.move_to(start)
        np.testing.assert_allclose(arm.state.q, start, atol=0.5 * BOUND)
    assert_replays(bag)


class MadeUpRobot:
    """A robot at rest in libfranka's terms, which keeps what it is told.

    Modes come one after the other; `state` are fields of its state.
    """

    def __init__(self, *modes, **state):
        self.modes = list(modes or [pylibfranka.RobotMode.Idle])
        self.told = []
        still = dict.fromkeys(
            ('q', 'dq', 'tau_J', 'tau_J_d', 'theta', 'dtheta'), [0.5] * 7
        )
        masses = {'m_ee': 0.0, 'm_total': 0.0, 'm_load': 1.5}
        time = SimpleNamespace(to_sec=lambda: 1.0)
        self.state = SimpleNamespace(**still | masses | state, time=time)

    def read_once(self):
        self.state.robot_mode = self.modes[0]
        del self.modes[: len(self.modes) > 1]
        return self.state

    def automatic_error_recovery(self):
        self.told.append('recovered')

    def set_collision_behavior(self, *thresholds):
        self.told.append(thresholds)

    def set_load(self, *load):
        self.told.append(load)

    # Of a motion.

    def start_torque_control(self):
        self.told.append('started')
        return self

    def readOnce(self):
        return self.read_once(), None

    def writeOnce(self, torques):
        self.told.append((torques.tau_J[0], torques.motion_finished))


@pytest.fixture
def connected(monkeypatch):
    """Connect to a made-up robot; return the driver, and what it said and asked for."""

    def connect(robot, given=None, **controller):
        asked = []
        reach = lambda *how: asked.append(how) or robot  # noqa: E731
        monkeypatch.setattr(pylibfranka, 'Robot', reach)
        given_law = {'blf_dsc_controller': controller}
        config = blf.load_loop('fr3_direct', given_law).controller
        driver = FrankaDriver('here', config, build(DriveConfig, given or {}))
        said = driver.connect()
        robot.told.pop()  # the load at the start
        return driver, said, asked

    return connect


def test_load_is_told_in_the_frame_of_the_flange_and_none_without_mass(connected):
    """With the frame of joint 7 as the tip: the flange is 0.107 m further along its axis."""
    robot = MadeUpRobot()
    given = {'load_inertia': [0.1, 0.2, 0.3]}
    driver, _, _ = connected(robot, given, **{'robot.tip': 'fr3_link7'})
    driver.tell_load(TipLoad(2.0, (0.02, 0.0, 0.01)))
    driver.tell_load(TipLoad(0.0, (0.0, 0.0, 0.0)))
    (mass, centre, inertia), without_mass = robot.told
    assert (mass, inertia) == (2.0, np.diag([0.1, 0.2, 0.3]).ravel().tolist())
    np.testing.assert_allclose(centre, [0.02, 0.0, 0.01 - 0.107], atol=1e-9)
    assert without_mass == (0.0, [0.0] * 3, [0.0] * 9)


def test_robot_without_torques_is_remarked_with_settings_that_its_driver_takes(
    connected,
):
    """As of franka-sim, whose tau_J is the command."""
    driver, (_, remark), _ = connected(MadeUpRobot(tau_J=[0.0] * 7))
    advised = re.findall(r'([a-z_]+\.[a-z_]+): ([a-z0-9.]+[a-z0-9])', remark)
    values = {name: yaml.safe_load(value) for name, value in advised}
    assert values == {
        'safety.first_torque': 'send',
        'disturbance.observer_bandwidth': 0.0,
    }
    given = blf.change(driver.controller, values)
    assert not disagreements(FrankaDriver.facts, given)


@pytest.mark.parametrize(
    ('raised', 'expected', 'call', 'remedy'),
    [
        ('NetworkException', ConnectionLostError, 'readOnce', 'check its computer and'),
        ('ControlException', ReflexError, 'writeOnce', ''),
        ('CommandException', ReflexError, 'readOnce', 'see Desk, which names the'),
        ('InvalidOperationException', DriverError, 'writeOnce', 'end what else reads'),
        ('FrankaException', DriverError, 'readOnce', 'see Desk, and start again'),
    ],
)
def test_what_libfranka_raises_in_motion_is_an_error_of_a_driver(
    connected, call, raised, expected, remedy
):
    """All of its exceptions, none of which is another's base class in Python."""

    def fail(*_):
        raise getattr(pylibfranka, raised)('libfranka: it said no')

    robot = MadeUpRobot()
    driver, _, _ = connected(robot)
    driver.start()
    setattr(robot, call, fail)
    use = driver.read if call == 'readOnce' else driver.finish
    with pytest.raises(DriverError, match=f'it said no.*{remedy}') as caught:
        use()
    assert type(caught.value) is expected
    assert 'libfranka' not in str(caught.value)


def test_torques_go_on_until_the_next_start_which_begins_at_zero(connected):
    """A reflex leaves a torque behind that the next motion must not begin with."""
    robot = MadeUpRobot()
    driver, _, _ = connected(robot)
    driver.start()
    for torque in (None, np.full(7, 3.0), None):
        driver.write(torque)
    driver.finish()
    driver.start()
    driver.write(None)
    first = [(0.0, False), (3.0, False), (3.0, False), (3.0, True)]
    assert robot.told == ['started', *first, 'started', (0.0, False)]


def test_thresholds_are_those_of_torque_and_force(connected):
    """The lower ones, of contacts, and the upper ones, of collisions, are the same."""
    torque, force = [10.0 + k for k in range(7)], [20.0 + k for k in range(6)]
    robot = MadeUpRobot()
    connected(robot, {'collision_torque': torque, 'collision_force': force})
    assert robot.told == [(torque, torque, force, force)]
    given = {'collision_torque': torque[:6], 'collision_force': force}
    with pytest.raises(DriverError, match='got 6 entries, but the robot has 7 joints'):
        connected(robot, given)


def test_only_a_reflex_is_recovered_and_no_other_mode_is_started_from(connected):
    modes = pylibfranka.RobotMode
    robot = MadeUpRobot(modes.Reflex, modes.Idle)
    connected(robot)
    assert robot.told == ['recovered']
    for mode in (modes.Reflex, modes.UserStopped, modes.Guiding, modes.Move):
        robot = MadeUpRobot(mode)
        with pytest.raises(DriverError, match=f'is not idle, but in mode {mode.name}'):
            connected(robot)
        assert robot.told == ['recovered'] * (mode is modes.Reflex)


def test_an_address_without_a_robot_is_an_error_with_a_remedy(wire):
    code, output = ended(wire.drive(1))
    assert code == 1
    assert 'activate the FCI in Desk' in output

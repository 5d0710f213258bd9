# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc commission --ros` by the controller's node, on an elastic arm in lock-step."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

from command import wait_for
from elastic_two_link import ARM, NEAR, shorten_motions, shorten_moves
from rclpy.parameter import Parameter
from ros_rig import PATIENCE

import blf_dsc_controller as blf
from blf_dsc_controller.cli import commission
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.commissioning import postures, proof
from blf_dsc_controller.commissioning.postures import EndedError, PostureByPosture
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.drive import ros as drive_ros
from blf_dsc_controller.drive.loop import End
from blf_dsc_controller.nodes.driven_node import DrivenNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.watchdog_node import WatchdogNode

pytestmark = pytest.mark.usefixtures('blank_pictures')


class Rig:
    """An arm in lock-step, and the node that measures it."""

    def __init__(self, ros, folder, text=ARM, **options):
        self.ros = ros
        self.file = folder / 'arm.yaml'
        self.file.write_text(text)
        self.bags = folder / 'bags'
        loop = blf.load_loop(self.file)
        self.commissioning = blf.Commissioning(loop.controller)
        values = {k: v for k, v in flatten(loop.plant).items() if v != ()}
        self.arm = ros.add(PlantNode, {**values, 'mode': 'lockstep'}, **options)
        self.node = ros.keep(
            DrivenNode(loop.controller, context=ros.context, cli_args=[])
        )
        self.due = lambda: False
        self.then = self.always = lambda: None
        driver = drive_ros.RosDriver('ros', loop.controller, DriveConfig())
        driver.attach(self.node, self.spin, ThreadPoolExecutor(1))
        self.robot = PostureByPosture(driver, self.commissioning, self.bags)

    def spin(self):
        self.ros.executor.spin_once(timeout_sec=0.01)
        self.always()
        if self.due():
            self.due = lambda: False
            self.then()

    def during(self, part, then, when=lambda: True):
        """Do something once the law has made 0.3 s of a `part`, a move or a motion, and `when`.

        In the arm's time. How many samples the arm makes before is up to the computer.
        """
        self.then = then
        self.due = lambda: self.part() == part and self.passed() > 0.3 and when()

    def part(self):
        """Return what the law does, if it commands."""
        guard = self.node.guard
        if guard is None or not guard.supervisor.running:
            return ''
        is_shaken = guard.config.reference.type == 'sinusoids'
        return 'motion' if is_shaken else 'move'

    def passed(self):
        """Return since when the law has followed the reference of this part [s]."""
        guard = self.node.guard
        return (guard.journal.stamp - guard.reference.start_stamp) * 1e-9

    def measured(self, *postures):
        return list(self.robot.runs(np.array(postures)))

    def speed(self):
        return np.abs(self.arm.plant.measure().reshape(3, -1)[1]).max()


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """Wait for a slow arm as long as for anything in these tests."""
    monkeypatch.setattr(drive_ros, '_PATIENCE', PATIENCE)


@pytest.fixture
def rig(ros, tmp_path):
    return Rig(ros, tmp_path)


def test_arm_is_measured_and_its_bags_give_gains_with_the_margin(rig, monkeypatch):
    shorten_motions(monkeypatch)
    shorten_moves(monkeypatch)
    found = rig.measured(NEAR)
    assert [name for name, _ in found] == ['posture 1']
    (bag,) = (bag for _, bag in found)
    assert bag == rig.bags / 'posture_1'
    run = blf.read_run(bag)
    assert np.abs(run.error[0]).max() < 1e-3
    assert np.abs(run.torque[0]).max() < 0.05
    assert blf.verify(bag).difference is None
    assert blf.verify(rig.bags / 'move_1').difference is None
    out = rig.file.with_name('out.yaml')
    words = ['commission', str(bag), '--config', str(rig.file), '--out', str(out)]
    assert main(words) == 0
    assert 'with a modulus margin' in out.read_text()


# N m/rad and N m s/rad: about what commissioning chooses for this arm
CHOSEN = """
    feedback: {joint_stiffness: [25.0, 8.5], joint_damping: [6.0, 1.5]}
    reference.type: hold
"""


def test_arm_is_held_after_the_proof_until_ctrl_c(ros, tmp_path, monkeypatch, capfd):
    """For 0.1 s of its time: without torques an arm whose drives do not hold would fall."""
    shorten_moves(monkeypatch)
    monkeypatch.setattr(proof, 'SHARES', (1.0,))
    monkeypatch.setattr(proof, '_LAST', 0.5)
    rig = Rig(ros, tmp_path, ARM + CHOSEN)
    monkeypatch.setattr(commission, 'robot', lambda *_: nullcontext(rig.robot))
    told, held = '', []

    def hold():
        nonlocal told
        told += capfd.readouterr().err
        if 'the arm is held until Ctrl-C' in told:
            held.append(rig.arm.plant.elapsed_ns)
            if held[-1] - held[0] > 0.1e9:
                rig.robot.request_end()

    rig.robot.position()
    rig.always = hold
    words = ['commission', '--ros', '--prove', '--yes', '--config', str(rig.file)]
    assert main([*words, '--record', str(rig.bags)]) == 0
    assert held
    assert rig.speed() < 0.01


def test_a_run_goes_on_from_the_torque_that_holds_the_arm(ros, tmp_path):
    """A load that the law knows nothing of does not sag between two runs."""
    loaded = ARM.replace('constant: [0.0, 0.0]', 'constant: [1.0, 0.5]')  # N m
    rig = Rig(ros, tmp_path, loaded)
    rig.during('motion', rig.robot.request_end)
    with pytest.raises(EndedError):
        rig.measured(NEAR)
    before, after = (blf.read_run(rig.bags / each) for each in ('move_1', 'posture_1'))
    # from the first torque on, the whole of what holds the arm against the load
    np.testing.assert_allclose(before.torque[-1], (1.0, 0.5), atol=0.05)
    np.testing.assert_allclose(after.torque[0], (1.0, 0.5), atol=0.05)
    np.testing.assert_allclose(after.position[100], before.position[-1], atol=2e-3)


def calm(rig):
    """Whether the arm rests, and the node holds it."""
    return rig.speed() < 0.01 and rig.node.guard.is_settled  # rad/s


@pytest.mark.parametrize(
    ('part', 'name'), [('move', 'move 1'), ('motion', 'posture 1')]
)
def test_ctrl_c_brings_the_arm_to_rest_in_a_move_and_in_a_motion(rig, part, name):
    rig.during(part, rig.robot.request_end)
    with pytest.raises(EndedError, match='ended on request') as caught:
        rig.measured(NEAR)
    assert caught.value.end is End.REQUESTED
    assert str(caught.value).startswith(name)
    assert calm(rig)
    assert main(['commission', str(rig.bags / 'move_1'), '--config', str(rig.file)])


@pytest.mark.parametrize(
    ('takes', 'told'),
    [
        (True, r'no joint states on /joint_states for \d'),
        (False, r'nobody takes torques on /blf_dsc_controller/commands'),
    ],
)
def test_a_driver_that_is_gone_is_told(rig, takes, told, monkeypatch):
    """With somebody else who takes torques, or without."""
    if takes:
        rig.ros.driver()

    def lose():
        rig.ros.kill(rig.arm)
        # of states, which are gone as well; and of the look at who takes the torques
        monkeypatch.setattr(drive_ros, '_PATIENCE', 1.0 if takes else 10.0)  # s
        monkeypatch.setattr(drive_ros, '_LOOK', 0.0)  # s

    rig.during('move', lose)
    with pytest.raises(EndedError, match=told) as caught:
        rig.measured(NEAR)
    assert caught.value.end is End.LOST
    assert not (rig.bags / 'posture_1').exists()


@pytest.mark.parametrize(
    ('name', 'told'),
    [
        ('stop', 'somebody called ~/stop'),
        ('reset', 'somebody called ~/reset'),
        ('deactivate', 'somebody deactivated the node'),
    ],
)
def test_what_would_spoil_a_motion_ends_it(rig, name, told):
    def do():
        if name == 'deactivate':
            rig.node.trigger_deactivate()
        elif name == 'stop':
            rig.node.status.trajectories.take_stop()
        else:
            rig.node.reset()

    rig.during('move', do)
    with pytest.raises(EndedError, match=told):
        rig.measured(NEAR)
    rig.ros.until(lambda: calm(rig))


def test_watchdog_relies_on_each_run(rig):
    watchdog = rig.ros.add(WatchdogNode)

    def watches():
        return watchdog.watchdog is not None and watchdog.watchdog.watches

    def go_on():
        rig.during('motion', rig.robot.request_end, watches)

    rig.during('move', go_on, watches)
    with pytest.raises(EndedError, match='posture 1: ended on request'):
        rig.measured(NEAR)


def test_parameters_cannot_be_changed_meanwhile(rig):
    rig.robot.position()
    (answer,) = rig.node.set_parameters([Parameter('feedback.stiffness', value=2.0)])
    assert not answer.successful
    assert 'an arm is being measured' in answer.reason


def test_the_arm_is_held_while_the_next_run_is_prepared(rig, monkeypatch):
    """Its states are answered meanwhile, however long that takes."""
    made = postures.ArmController

    def make(*given, **named):
        before = rig.arm.plant.sample
        if before:  # the arm waits for the first torque
            wait_for(lambda: rig.arm.plant.sample > before + 10)
        return made(*given, **named)

    monkeypatch.setattr(postures, 'ArmController', make)
    rig.during('motion', rig.robot.request_end)
    with pytest.raises(EndedError, match='posture 1: ended on request'):
        rig.measured(NEAR)

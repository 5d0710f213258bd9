# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc drive` on the simulated arm in lock-step: how it starts, answers, ends and replays."""

from __future__ import annotations

import re
import signal
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest
from plant_driver import PlantDriver
from plants import rigid_gears
from recorded_run import limited_files

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.drive.driver import (
    DriverError,
    Facts,
    disagreements,
)
from blf_dsc_controller.drive.loop import DriveLoop, End
from blf_dsc_controller.messages import topics
from sim_plant.plant import plant_of
from sim_plant.settings import plant_settings

HERE = Path(__file__).parent
HOLD = {'safety.torque': 'hold_gravity'}
CONFIG = blf.change(blf.load_loop('recommended').controller, HOLD)
LONG = 0.6  # s: the arm is on its reference, and moves


def drive(address, tmp_path, duration=LONG):
    """Run the loop on the simulated arm; return driver, controller, outcome."""
    driver = PlantDriver(address, CONFIG, DriveConfig())
    driver.connect()
    with blf.ArmController(CONFIG, record=tmp_path / 'bag') as controller:
        loop = DriveLoop(driver, controller, duration=duration)
        handlers = {
            number: signal.signal(number, lambda *_: loop.request_end())
            for number in (signal.SIGINT, signal.SIGTERM)
        }
        try:
            outcome = loop.run()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return driver, controller, outcome


def assert_replays(folder):
    """The bag holds what the controller needs to compute every torque again.

    Return the kinds of its events.
    """
    verified = blf.verify(folder)
    assert verified.difference is None
    assert not any(found.missing for found in verified.comparisons)
    assert verified.samples > 0
    return [event.type for event in verified.events]


@pytest.mark.parametrize(
    ('address', 'end'),
    [
        ('plant', End.DURATION),
        ('terminate@300', End.REQUESTED),
        ('late@300', End.STOPPED),
    ],
)
def test_it_ends_at_rest_and_the_bag_replays_bit_equal(address, end, tmp_path):
    driver, controller, outcome = drive(address, tmp_path)
    assert outcome.end is end
    assert driver.calls == ['connect', 'start', 'finish']
    assert driver.velocity < 0.01  # rad/s, at rest
    assert len(driver.torques) == outcome.states
    assert (
        outcome.states < 3000
    )  # it does not wait for settle_time, 3 s, if it rests before
    assert controller.phase is (
        blf.Phase.SAFE_STOP if end is End.STOPPED else blf.Phase.INACTIVE
    )
    assert ('is 0.061 s after the last one' in outcome.text) is (end is End.STOPPED)
    events = assert_replays(tmp_path / 'bag')
    assert events.count('deactivate') == (end is not End.STOPPED)  # once
    recorded = blf.read_run(tmp_path / 'bag')
    np.testing.assert_array_equal(
        recorded.torque, driver.torques[: len(recorded.torque)]
    )


def test_a_second_request_ends_at_once(tmp_path):
    driver, _, outcome = drive('impatient@300', tmp_path)
    assert outcome.end is End.REQUESTED
    assert outcome.states == 309  # those before the state with the second
    assert driver.calls[-1] == 'finish'


@pytest.mark.parametrize(
    ('address', 'end', 'last', 'text'),
    [
        ('silent@300', End.LOST, 'start', 'no state for 1 s: check the cable'),
        ('reflex@300', End.REFLEX, 'recover', 'joint_reflex; it has recovered'),
        ('broken@300', End.REFLEX, 'recover', 'joint_reflex; it cannot recover'),
    ],
)
def test_nothing_is_commanded_to_a_robot_that_took_over_or_is_gone(
    address, end, last, text, tmp_path
):
    driver, controller, outcome = drive(address, tmp_path)
    assert outcome.end is end
    assert text in outcome.text
    assert driver.calls[-1] == last
    assert len(driver.torques) == outcome.states == 299
    assert text.partition(';')[0] in controller.reason
    assert_replays(tmp_path / 'bag')


def test_a_reflex_while_the_arm_is_brought_to_rest_is_what_ended_the_run():
    driver = PlantDriver('reflex@303', CONFIG, DriveConfig())
    driver.connect()
    with blf.ArmController(CONFIG) as controller:
        loop = DriveLoop(driver, controller, duration=0.3)
        outcome = loop.run()
    assert outcome.end is End.REFLEX
    assert controller.phase is blf.Phase.INACTIVE  # it was on its way to rest
    assert driver.calls[-1] == 'recover'


def test_a_mistake_of_the_driver_ends_the_motion_and_is_shown(tmp_path):
    with pytest.raises(RuntimeError, match='a mistake of the driver'):
        drive('mistaken@300', tmp_path)
    assert PlantDriver.last.calls == ['connect', 'start', 'finish']


def test_an_error_of_the_controller_brings_the_arm_to_rest_before_it_is_shown(
    monkeypatch,
):
    driver = PlantDriver('plant', CONFIG, DriveConfig())
    driver.connect()
    controller = blf.ArmController(CONFIG)
    update = controller.update
    states = []

    def failing(*state, send):
        states.append(state)
        if len(states) == 300:
            raise OSError('the disk is full')
        return update(*state, send=send)

    monkeypatch.setattr(controller, 'update', failing)
    with pytest.raises(OSError, match='the disk is full'):
        DriveLoop(driver, controller).run()
    assert 'OSError: the disk is full' in controller.reason
    assert driver.velocity < 0.01
    assert driver.calls[-1] == 'finish'
    assert len(driver.torques) == len(
        states
    )  # the state of the error has its torque, too


# s; the load is known about a second later
PICKED_UP, PUSHED = 3.0, 6.2
TOLD = {'load.tell_drive': True, 'learning.window': 2.0}
RIGID = rigid_gears(7, 0.01)
ALL = (
    TOLD
    | {
        'barrier.bound': None,
        'barrier.tool_bound': 0.02,
        'barrier.tool_angle_bound': 0.1,
        'contact.enabled': True,
        'contact.reaction': 'hold',
    }
    | RIGID['blf_dsc_controller']
    | {'barrier.bound': None}
)


class LoadedDriver(PlantDriver):
    """The simulated FR3, which picks up 2 kg, can be told so, and is pushed from the side."""

    facts = Facts(7, 0.001, 'gravity_and_friction', 'whole', (87.0,) * 7, (1e3,) * 7)
    facts = facts._replace(load_in_motion=True)

    def connect(self):
        changes = {
            'events.begin': [PICKED_UP, PUSHED],
            'events.duration': [0.0, 0.3],
            'events.payload': [2.0, 0.0],
            'events.force': [0.0, 0.0, 0.0, 0.0, 20.0, 0.0],
        }
        loop = blf.load_loop('fr3_direct', RIGID)
        self.what, self.at = '', -1
        self.plant_config = blf.change(loop.plant, changes)
        self.plant = plant_of(self.plant_config)
        self.told = []
        self.efforts = []
        self.count = self.late = self.mass = 0
        self.torques, self.calls = [], []

    def read(self):
        state = super().read()
        self.efforts.append(np.array(state.effort))
        return state

    def write(self, torque):
        if self.told and self.told[-1].mass != self.mass:  # it is in force from now on
            load = self.told[-1]
            robot = replace(
                self.plant_config.robot,
                drive_payload=load.mass,
                drive_payload_centre=load.centre,
            )
            self.plant.change(plant_settings(replace(self.plant_config, robot=robot)))
            self.mass = load.mass
        self.torques.append(torque)
        self.plant.step(np.zeros(7) if torque is None else torque)

    def tell_load(self, load):
        self.told.append(load)

    def load_in_force(self):
        return self.mass


def run_with_load(driver, duration, given=TOLD, record=None):
    config = blf.load_loop('fr3_direct', {'blf_dsc_controller': given}).controller
    made = driver('plant', config, DriveConfig())
    made.connect()
    with blf.ArmController(config, record=record) as controller:
        loop = DriveLoop(made, controller, duration=duration)
        outcome = loop.run()
    assert outcome.end is End.DURATION, outcome.text
    return made, loop, controller


@pytest.fixture(scope='module')
def all_of_it(tmp_path_factory):
    """Run with learning, a bound at the tool, a load that is told, and a contact."""
    bag = tmp_path_factory.mktemp('all_of_it') / 'bag'
    made = run_with_load(LoadedDriver, 7.0, ALL, bag)
    return *made, blf.read_run(bag), blf.verify(bag)


def test_weighed_load_is_told_to_the_drives_without_a_step_of_any_torque(all_of_it):
    """The robot adds what the law gives up; steps are those of the motion, and 0.5 % of 87 N m."""
    driver, loop, controller, _, verified = all_of_it
    assert not loop.remark
    assert driver.mass == pytest.approx(2.0, abs=0.1)
    masses = [load.mass for load in driver.told]
    assert len(masses) > 10
    assert (np.diff(masses) > 0.0).all()
    event = [each for each in verified.events if each.type == 'drive load']
    assert len(event) == len(masses)
    efforts = np.array(driver.efforts)
    limit = np.array(controller.config.torque.limit)
    stamps = 1.0 + 1e-3 * np.arange(1, len(efforts) + 1)
    told = [(each.stamp * 1e-9) for each in event]
    assert np.diff(told).min() > 0.0195  # s: drives follow a step of the load in 20 ms
    begin, end = np.searchsorted(stamps, (told[0], told[-1]))
    usual = np.abs(np.diff(efforts[begin - 1000 : begin], axis=0)).max(axis=0)
    steps = np.abs(np.diff(efforts[begin - 5 : end + 5], axis=0)).max(axis=0)
    assert (steps < 1.5 * usual + 0.005 * limit).all()
    # the weight that the commands bore is the drives' afterwards
    before, after = (
        np.abs(np.array(driver.torques[k - 500 : k]))[:, 1].mean()
        for k in (begin, end + 500)
    )
    assert after < 0.6 * before  # friction and the motion are left


def test_run_with_all_of_it_replays_bit_for_bit(all_of_it):
    """What each part says is in the bag, and computed again from the joint states and events."""
    *_, run, verified = all_of_it
    assert verified.difference is None
    assert not verified.is_partial
    assert not any(found.missing for found in verified.comparisons)
    kinds = [event.type for event in verified.events]
    assert kinds.index('drive load') < kinds.index('contact')
    assert kinds.count('contact') == 1
    compared = {found.topic: found.values for found in verified.comparisons}
    assert compared[topics.EXTERNAL_TORQUE.resolved] > 14 * 600
    shown = (*topics.TOOL, topics.LOAD[0], topics.CONTACT[0], topics.LATCHED)
    error, certified, angle, certified_angle, mass, contact, latched = (
        run.monitor.select(shown).T
    )
    assert (error < certified).all()
    assert (angle < certified_angle).all()
    assert 0.001 < certified.max() <= 0.02
    assert mass[-1] == pytest.approx(2.0, abs=0.1)
    t = run.time_of(run.monitor.stamp)
    assert PUSHED < t[contact > 0.0].min() < PUSHED + 0.1
    assert latched[-1] == 1.0


def test_drives_that_refuse_a_load_are_asked_once():
    class Refusing(LoadedDriver):
        asked = 0

        def tell_load(self, load):
            self.asked += load.mass > 0.0
            raise DriverError('the load was refused: see Desk')

    driver, loop, _ = run_with_load(Refusing, 5.0)
    assert driver.asked == 1
    assert loop.remark == 'the load was refused: see Desk'
    assert driver.mass == 0


def test_drives_that_forbid_it_are_not_told_while_they_move():
    class Forbidding(LoadedDriver):
        facts = LoadedDriver.facts._replace(load_in_motion=False)

    driver, loop, _ = run_with_load(Forbidding, 5.0)
    assert not driver.told
    assert not loop.remark


FACTS = Facts(2, 0.001, 'none', 'unknown', (20.0, 20.0), (inf, inf))


@pytest.mark.parametrize(
    ('facts', 'problem'),
    [
        ({'joints': 7}, 'joints: got 2, but the robot has 7'),
        ({'period': 0.002}, 'sample_time: got 0.001 s, but .* every 0.002 s'),
        ({'drive_compensates': 'gravity'}, 'robot.drive_compensates: got none, but'),
        ({'effort': 'whole'}, 'robot.effort: got unknown, but .* write whole'),
        ({'torque_limit': (20.0, 19.0)}, r'torque.limit: got \[20.0, 20.0\], but'),
        ({'torque_rate': (1e3, inf)}, r'torque.rate_limit: got \[inf, inf\], but'),
    ],
)
def test_a_configuration_that_contradicts_its_robot_is_refused(facts, problem):
    assert disagreements(FACTS, CONFIG) == []
    (found,) = disagreements(FACTS._replace(**facts), CONFIG)
    assert re.match(problem, found)


def command(tmp_path, address, **options):
    """Run the command with this driver's file; return its exit code."""
    text = (blf.share_folder() / 'config/recommended.yaml').read_text(encoding='utf-8')
    driver = (HERE / 'plant_driver.py').as_posix()
    parameters = f'/**/drive:\n  ros__parameters:\n    driver: {driver}\n'
    (tmp_path / 'my.yaml').write_text(text + parameters, encoding='utf-8')
    words = [f'--{name}={value}' for name, value in options.items()]
    files = ['--config', str(tmp_path / 'my.yaml'), '--out', str(tmp_path / 'bag')]
    return main(['drive', '--robot', address, *files, *words])


@pytest.mark.parametrize(
    ('address', 'code', 'printed'),
    [
        ('plant', 0, 'the duration is over'),
        ('interrupt@200', 130, 'ended on request'),
        ('late@200', 5, 'the controller stopped: the stamp of a joint state'),
        (
            'reflex@200',
            5,
            'the robot stopped by itself: joint_reflex; it has recovered',
        ),
        ('silent@200', 5, 'the connection was lost: no state for 1 s'),
        ('absent', 1, 'there is no robot: switch it on'),
    ],
)
def test_the_command_says_how_it_ended(address, code, printed, tmp_path, capsys):
    assert command(tmp_path, address, duration=0.3) == code
    output = capsys.readouterr()
    assert printed in output.out + output.err
    if code != 1:
        assert 'connected to the simulated arm' in output.err
        assert 'largest error' in output.out
        assert_replays(tmp_path / 'bag')


def test_the_command_says_that_the_recording_is_not_whole(tmp_path, capsys):
    """The robot was controlled to the end, but what was wanted is not there."""
    with limited_files(tmp_path / 'disk', 10_000) as disk:  # 20 states or so
        assert command(disk, 'plant', duration=0.3) == 1
    printed = capsys.readouterr().out
    assert 'the duration is over' in printed
    assert f'only a part: {disk / "bag"} cannot be written any further' in printed

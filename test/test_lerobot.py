# SPDX-License-Identifier: Apache-2.0
"""The plugin of LeRobot, as its own programs find, make and use it.

It runs at night, where LeRobot is installed.
"""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from command import wait_for

import blf_dsc_controller as blf
from blf_dsc_controller import LoopEndedError

pytest.importorskip('lerobot', reason='needs LeRobot')
pytest.importorskip('ruckig', reason='needs ruckig')

from lerobot.robots import Robot, RobotConfig
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

pytestmark = pytest.mark.nightly

FOLDER = Path(__file__).resolve().parents[1] / 'lerobot_robot_blf_dsc'
WAVE = 0.1  # rad


@pytest.fixture
def config_of(monkeypatch, tmp_path):
    """Makes configurations of simulated arms, by the name of their type."""
    monkeypatch.syspath_prepend(FOLDER)
    import lerobot_robot_blf_dsc  # noqa: F401 - LeRobot imports it by its name

    made = RobotConfig.get_choice_class('blf_dsc')
    return lambda preset, **given: made(
        config=preset, calibration_dir=tmp_path / 'calibration', id='left', **given
    )


@pytest.fixture
def robot(config_of):
    """The simulated Panda."""
    robot = make_robot_from_config(config_of('panda'))
    yield robot
    if robot.is_connected:
        robot.disconnect()


def test_features_are_known_before_the_robot_is_connected(robot):
    assert isinstance(robot, Robot)
    assert robot.robot_type == robot.config.type == 'blf_dsc'
    assert not robot.is_connected
    assert robot.is_calibrated
    joints = [f'panda_joint{i}' for i in range(1, 8)]
    assert list(robot.action_features) == [f'{joint}.pos' for joint in joints]
    assert set(robot.action_features) < set(robot.observation_features)
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()
    with pytest.raises(DeviceNotConnectedError):
        robot.send_action({})


def test_actions_at_30_hz_move_the_arm_and_observations_are_as_declared(robot):
    robot.connect()
    with pytest.raises(DeviceAlreadyConnectedError):
        robot.connect()
    first = robot.get_observation()
    assert first.keys() == robot.observation_features.keys()
    assert all(type(value) is float for value in first.values())
    for k in range(45):
        ahead = 0.01 * min(k, 15)  # rad
        action = {name: first[name] + ahead for name in robot.action_features}
        assert robot.send_action(action) == action
        time.sleep(1.0 / 30.0)

    def has_arrived():
        now = robot.get_observation()
        moved = [now[name] - first[name] for name in robot.action_features]
        return np.allclose(moved, 0.15, rtol=0.0, atol=0.045)  # rad, the bound

    wait_for(has_arrived)  # the arm is slow on a slow computer
    robot.disconnect()
    assert not robot.is_connected
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()


def test_action_of_another_robot_is_refused_by_what_it_lacks(robot):
    robot.connect()
    with pytest.raises(
        ValueError, match=r'got joint_1\.pos, but panda_joint1\.pos, .*'
    ):
        robot.send_action({'joint_1.pos': 0.0})


def test_robot_is_connected_again_after_a_stop_and_after_a_disconnect(
    config_of, tmp_path
):
    robot = make_robot_from_config(config_of('panda', record=f'{tmp_path / "bag"}'))
    robot.connect()
    os.kill(robot._arm._loop.pid, signal.SIGKILL)
    wait_for(lambda: not robot.is_connected)
    with pytest.raises(LoopEndedError):
        robot.get_observation()
    robot.connect()
    assert robot.is_connected
    robot.disconnect()
    robot.connect()
    assert robot.get_observation()
    robot.disconnect()
    assert {each.name for each in tmp_path.glob('bag*')} == {'bag', 'bag_2', 'bag_3'}


@TeleoperatorConfig.register_subclass('wave')
@dataclass
class WaveConfig(TeleoperatorConfig):
    """A wave about the position in which the arm of a preset begins."""

    preset: str = 'openarm'


class Wave(Teleoperator):
    """Asks for one, as LeRobot's programs ask a leader arm."""

    config_class = WaveConfig
    name = 'wave'
    is_connected = is_calibrated = True
    action_features: dict[str, type] = {}  # noqa: RUF012 - a property of LeRobot's
    feedback_features: dict[str, type] = {}  # noqa: RUF012 - likewise

    def __init__(self, config):
        super().__init__(config)
        loop = blf.load_loop(config.preset)
        begin = loop.plant.initial.position
        self.begin = dict(zip(loop.controller.joints, begin, strict=True))
        self.action_features = {f'{joint}.pos': float for joint in self.begin}
        self.count = 0

    def get_action(self):
        self.count += 1
        ahead = WAVE * np.sin(0.1 * self.count)
        return {f'{joint}.pos': at + ahead for joint, at in self.begin.items()}

    def connect(self, calibrate=True):  # noqa: FBT002 - LeRobot's
        pass

    def calibrate(self):
        pass

    def configure(self):
        pass

    def send_feedback(self, feedback):
        pass

    def disconnect(self):
        pass


def test_its_programs_calibrate_teleoperate_record_and_replay_an_openarm(
    config_of, tmp_path, monkeypatch
):
    """As LeRobot's own test of its programs does with a robot of its own."""
    monkeypatch.setenv('HF_HUB_OFFLINE', '1')
    pytest.importorskip('datasets', reason='needs LeRobot with datasets')
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.scripts import (
        lerobot_calibrate,
        lerobot_record,
        lerobot_replay,
        lerobot_teleoperate,
    )

    config = config_of('openarm')
    wave = WaveConfig(calibration_dir=tmp_path / 'calibration')
    lerobot_calibrate.calibrate(lerobot_calibrate.CalibrateConfig(robot=config))
    lerobot_teleoperate.teleoperate(
        lerobot_teleoperate.TeleoperateConfig(
            robot=config, teleop=wave, fps=30, teleop_time_s=0.3
        )
    )
    here = {'repo_id': 'me/try', 'root': tmp_path / 'try'}
    lerobot_record.record(
        lerobot_record.RecordConfig(
            robot=config,
            teleop=wave,
            play_sounds=False,
            dataset=lerobot_record.DatasetRecordConfig(
                **here,
                single_task='wave',
                num_episodes=1,
                episode_time_s=1.0,
                reset_time_s=0,
                video=False,
                push_to_hub=False,
            ),
        )
    )
    recorded = LeRobotDataset(**here)
    joints = blf.load_loop('openarm').controller.joints
    assert recorded.num_episodes == 1
    assert recorded.features['action']['names'] == [f'{each}.pos' for each in joints]
    frames = recorded.hf_dataset
    assert np.isfinite(frames['observation.state']).all()
    assert np.abs(np.diff(frames['action'], axis=0)).max() > 0.0
    lerobot_replay.replay(
        lerobot_replay.ReplayConfig(
            robot=config,
            play_sounds=False,
            dataset=lerobot_replay.DatasetReplayConfig(**here, episode=0),
        )
    )

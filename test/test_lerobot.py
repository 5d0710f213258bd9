# SPDX-License-Identifier: Apache-2.0
"""The plugin of LeRobot, as its own programs find, make and use it; where LeRobot is installed."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('lerobot', reason='needs LeRobot')
pytest.importorskip('ruckig', reason='needs ruckig')

from lerobot.robots import Robot, RobotConfig
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

FOLDER = Path(__file__).resolve().parents[1] / 'lerobot_robot_blf_dsc'


@pytest.fixture
def robot(monkeypatch, tmp_path):
    """The simulated Panda, by the name of its type."""
    monkeypatch.syspath_prepend(FOLDER)
    import lerobot_robot_blf_dsc  # noqa: F401 - LeRobot imports it by its name

    made = RobotConfig.get_choice_class('blf_dsc')
    config = made(config='panda', calibration_dir=tmp_path, id='left')
    robot = make_robot_from_config(config)
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
    time.sleep(1.0)
    last = robot.get_observation()
    moved = [last[name] - first[name] for name in robot.action_features]
    np.testing.assert_allclose(moved, 0.15, atol=0.045)  # rad, the bound
    robot.disconnect()
    assert not robot.is_connected

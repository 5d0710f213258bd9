# SPDX-License-Identifier: Apache-2.0
"""The files for named robots fit their drivers, and run on simulated ones."""

from __future__ import annotations

import re
import shlex
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from markdown_it import MarkdownIt

pytest.importorskip('rclpy', reason='needs ROS 2')

from random_arm import CONFIG, UR5E
from rclpy.serialization import serialize_message
from rclpy.wait_for_message import wait_for_message
from ros_rig import PATIENCE
from scenario import Scenario
from std_msgs.msg import String
from test_nodes_process import NODES, arguments_of, launched, start  # noqa: F401 - fixtures

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import load
from blf_dsc_controller.drive.motor_feedback import as_in_motors
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import decode
from blf_dsc_controller.nodes.endpoints import qos_profile
from blf_dsc_controller.warnings.table import config_warnings

# What the sources of a driver say; each is named beside it.
FACTS = {
    # franka_ros2 jazzy 29cb85a (3.4.0)
    'fr3': SimpleNamespace(
        preset='fr3',
        # franka_bringup/launch/franka.launch.py: the broadcaster's remapping
        joint_states='/franka/joint_states',
        commands='/fr3_effort_controller/commands',  # config/fr3_effort_controller.yml
        rate=1000.0,  # Hz; franka_bringup/config/controllers.yaml: update_rate
        # franka_description 566ba44, robots/common/franka_arm.xacro with the prefix
        # fr3_
        joints=tuple(f'fr3_joint{i}' for i in range(1, 8)),
    ),
    # Universal_Robots_ROS2_Driver jazzy a16a268 (3.8.0)
    'ur5e': SimpleNamespace(
        preset='ur5e_driver',
        joint_states='/joint_states',  # ur_robot_driver/launch/ur_control.launch.py
        # ur_robot_driver/config/ur_controllers.yaml: a forward_command_controller
        commands='/forward_effort_controller/commands',
        rate=500.0,  # ur_robot_driver/config/ur5e_update_rate.yaml
        # the same file: forward_effort_controller.joints, in this order, without a
        # tf_prefix
        joints=UR5E,
    ),
}
# ros2_controllers 4, tried with its real parts: joint_state_broadcaster publishes
# reliably and latched, the effort controllers subscribe with best effort: any of our
# qualities is compatible.


def fences():
    """Blocks of code of the pages on real arms."""
    pages = ('franka', 'ur5e', 'motor_arms', 'real_arm')
    text = '\n'.join(
        (CONFIG.parent / 'doc' / f'{page}.md').read_text() for page in pages
    )
    return [block for block in MarkdownIt().parse(text) if block.type == 'fence']


ROBOTS = pytest.mark.parametrize('robot', FACTS)


@ROBOTS
def test_file_has_the_joints_and_the_rate_of_the_driver(robot):
    facts = FACTS[robot]
    loop = blf.load_loop(facts.preset)
    for config in (loop.controller, loop.plant):
        assert config.joints == facts.joints
        assert config.sample_time == 1.0 / facts.rate
        assert config.robot.drive_compensates == 'gravity_and_friction'
    assert loop.plant.actuator.without_command == 'hold'
    if robot == 'fr3':  # whose driver has no effort controller of its own
        (section,) = yaml.safe_load(
            (CONFIG / 'fr3_effort_controller.yml').read_text()
        ).items()
        assert f'/{section[0]}/commands' == facts.commands
        assert tuple(section[1]['ros__parameters']['joints']) == facts.joints


@ROBOTS
def test_launched_nodes_use_the_topics_of_the_driver(launched, start, tmp_path, robot):  # noqa: F811
    facts = FACTS[robot]
    for node in launched(driver=robot):
        remaps = [
            word for names in node.remappings for word in ('-r', ':='.join(names))
        ]
        controller = start(*arguments_of(node, tmp_path), *remaps)  # the last
    types = dict(controller.get_topic_names_and_types())
    assert types[facts.joint_states] == ['sensor_msgs/msg/JointState']
    assert types[facts.commands] == ['std_msgs/msg/Float64MultiArray']
    assert controller.config.sample_time == 1.0 / facts.rate
    connected = {'joint_states': facts.joint_states, 'commands': facts.commands}
    told, configured = wait_for_message(
        String,
        controller,
        topics.JOURNAL.relative,
        qos_profile=qos_profile(topics.JOURNAL.requested),
        time_to_wait=PATIENCE,
    )
    assert told
    assert decode(serialize_message(configured)).content['topics'] == connected


@pytest.mark.parametrize(
    ('joint', 'rate', 'preset'),
    [
        ('fr3_joint1', 1000.0, 'fr3'),
        ('shoulder_pan_joint', 500.0, 'ur5e_driver'),
        ('shoulder_pan_joint', 1000.0, 'ur5e'),
    ],
)
def test_parameter_file_of_the_page_runs_on_the_simulated_driver(
    joint, rate, preset, tmp_path
):
    """The arm holds its posture, and 2 kg from 1 s on, of which nobody was told."""
    texts = [block.content for block in fences() if block.info == 'yaml']
    found = []
    for text in texts:
        file = tmp_path / 'my.yaml'
        file.write_text(text.replace('topic://robot_description', 'ur5e.urdf'))
        config = load(file, '/blf_dsc_controller', blf.ControllerConfig)
        if (config.joints[0], config.sample_time) == (joint, 1.0 / rate):
            found.append(config)
    (law,) = found
    given = {'duration': 4.0, 'events.begin': [1.0], 'events.duration': [0.0]}
    run = blf.simulate(law, blf.change(blf.load_loop(preset).plant, given)).run()
    assert run.stops == ()
    assert np.abs(run.error).max() < 0.05


def test_parameter_files_of_the_pages_on_robots_get_no_warning(tmp_path):
    """`blf_dsc doctor` shows these: what a reader copies is fit for what the page says."""
    for text in (block.content for block in fences() if 'urdf:' in block.content):
        file = tmp_path / 'my.yaml'
        file.write_text(text.replace('topic://robot_description', 'ur5e.urdf'))
        config = load(file, 'blf_dsc_controller', blf.ControllerConfig)
        if load(file, 'drive', DriveConfig).feedback == 'motor':
            config = as_in_motors(config)
        assert config_warnings(config) == []


@ROBOTS
def test_lost_commands_neither_stop_the_drives_nor_cost_the_bound(robot):
    """Three in a row, twenty times a second or more.

    2 kg are picked up at 4 s, and put down at 7 s.
    """
    random = np.random.default_rng(0)
    applied, left = None, 0

    def lossy(torque):
        nonlocal applied, left
        if left == 0:
            applied = torque.copy()
            left = 3 if random.random() < 0.05 else 0
        else:
            left -= 1
        return applied

    events = {'events.begin': [4.0], 'events.duration': [3.0]}
    arm = Scenario(FACTS[robot].preset, plant=events)
    found = arm.run(9.0, reach=lossy)
    assert (found.phase[-1], arm.plant.is_stopped) == ('tracking', False)
    # of bounds of 40 and 30 mrad: 2 kg on an outstretched arm take half of either
    assert found.ratio < 0.6


@pytest.mark.nightly
@pytest.mark.usefixtures('blank_pictures')
def test_every_own_shell_line_of_the_page_is_executed(
    launched,  # noqa: F811
    start,  # noqa: F811
    tmp_path,
    monkeypatch,
):
    """The rest belongs to packages of the robots.

    Nodes that a line starts find each other.
    """
    monkeypatch.chdir(tmp_path)
    own, files = [], []
    for block in fences():
        if block.info == 'yaml':
            files.append(
                block.content.replace('topic://robot_description', 'ur5e.urdf')
            )
        if block.info == 'sh':
            for line in block.content.splitlines():
                words = shlex.split(line)
                for name in (w for w in re.findall(r'\w+\.yaml', line) if files):
                    (tmp_path / name).write_text(files[-1])
                if words[:2] == ['blf_dsc', 'run']:  # others need a robot, or its bag
                    words[words.index('--duration') + 1] = '0.2'
                    assert main([*words[1:], '--out', f'out{len(own)}']) == 0
                elif words[:3] == ['ros2', 'launch', 'blf_dsc_controller']:
                    given = dict(word.split(':=') for word in words[4:])
                    nodes = launched(**given)
                    assert {node.name for node in nodes} == {
                        'torque_watchdog',
                        'blf_dsc_controller',
                    }
                    for node in nodes:
                        assert node.parameters[0] == given['config']
                        start(*arguments_of(node, tmp_path))
                elif words[:3] == ['ros2', 'run', 'blf_dsc_controller']:
                    (topic,) = {w.split(':=')[1] for w in words if 'commands:=' in w}
                    node = start(*words[3:])
                    assert node.count_publishers(topic) > 0
                else:
                    continue
                own.append(line)
    assert len(own) == 8

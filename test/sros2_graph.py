# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy of the nodes, which grants each of them exactly what it uses.

`python test/sros2_graph.py config/sros2_policy.xml` starts the nodes and rewrites it.
"""

from __future__ import annotations

import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

from ros_rig import RosRig
from trajectory_msgs.msg import JointTrajectory

import blf_dsc_controller as blf
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.recorder_node import BagRecorderNode
from blf_dsc_controller.nodes.watchdog_node import WatchdogNode
from blf_dsc_controller.view.node import ViewNode

KINDS = (
    ('topics', 'publish', 'topic', 'get_publisher_names_and_types_by_node'),
    ('topics', 'subscribe', 'topic', 'get_subscriber_names_and_types_by_node'),
    ('services', 'reply', 'service', 'get_service_names_and_types_by_node'),
    ('services', 'request', 'service', 'get_client_names_and_types_by_node'),
)
# of the process of the action, which needs control_msgs: test_nodes_action compares it
ACTION = 'blf_dsc_controller/follow_joint_trajectory'
ACTION_NODE = '_blf_dsc_controller_action'
ACTION_ACCESS = {
    'publish': ['/parameter_events'],
    'subscribe': [],
    'reply': [f'/{ACTION_NODE}/get_type_description'],
    'request': [],
}
# parameters with which the controller has every topic
ALL_TOPICS = {
    'robot.urdf': str(blf.share_folder() / 'config/two_link.urdf'),
    'robot.tip': 'link2',
    'contact.enabled': True,
}
HEAD = """\
<?xml version="1.0" encoding="UTF-8"?>
<!-- SPDX-License-Identifier: Apache-2.0 -->
<!-- What each node may do, for SROS 2: made by `python test/sros2_graph.py config/sros2_policy.xml`
     from the running nodes in the root namespace. See doc/topics.md for how to use it. -->
"""


def granted(ros, names):
    """Return the names of the topics or services of nodes, by kind of access."""
    return {
        access: sorted(
            {f for name in names for f, _ in getattr(ros.tester, method)(name, '/')}
        )
        for _, access, _, method in KINDS
    }


def is_recording_all(ros):
    """Return whether the recorder has found every topic."""
    there = {name for name, _ in ros.tester.get_topic_names_and_types()}
    found = ros.tester.get_subscriber_names_and_types_by_node(
        '_bag_recorder_subscriptions', '/'
    )
    published = {name for name in there if ros.tester.count_publishers(name)}
    return published <= {name for name, _ in found}


def live():
    """Return the topics and services of the running nodes, by enclave and kind of access."""
    ros = RosRig()
    try:
        with tempfile.TemporaryDirectory() as folder:
            bag = str(Path(folder, 'bag'))
            # One thread serves all nodes: the arm must leave time for the others.
            ros.add(PlantNode, publish_clock=True, sample_time=0.02)
            ros.add(ControllerNode, ALL_TOPICS, sample_time=0.02)
            ros.add(ViewNode)
            # of a user: it is recorded
            planner = '/blf_dsc_controller/joint_trajectory'
            ros.tester.create_publisher(JointTrajectory, planner, 1)
            watchdog = ros.add(WatchdogNode)
            recorder = ros.add(BagRecorderNode, output=bag)
            ros.until(lambda: is_recording_all(ros) and watchdog.watchdog)
            nodes = {
                'sim_plant': ['sim_plant'],
                'blf_dsc_controller': ['blf_dsc_controller'],
                'torque_watchdog': [
                    'torque_watchdog',
                    '_torque_watchdog_subscriptions',
                ],
                'view': ['view', '_view_subscriptions'],
                'bag_recorder': ['bag_recorder', '_bag_recorder_subscriptions'],
            }
            found = {name: granted(ros, parts) for name, parts in nodes.items()}
            # With robot.urdf: topic://robot_description, a separate node waits for that
            # topic.
            found['blf_dsc_controller']['subscribe'].append('/robot_description')
            # Before its start it listens whether another node commands.
            commands = '/blf_dsc_controller/commands'
            found['blf_dsc_controller']['subscribe'].append(commands)
            hidden = '/_blf_dsc_controller_subscriptions/get_type_description'
            found['blf_dsc_controller']['reply'].insert(0, hidden)
            ros.executor.remove_node(recorder)
            ros.spin(0.1)
            recorder.close()
            return found
    finally:
        ros.close()


def _grant(profile, access):
    """Add access by kind to a profile."""
    for group, kind, element, _ in KINDS:
        if access[kind]:
            part = ET.SubElement(profile, group, {kind: 'ALLOW'})
            for name in access[kind]:
                ET.SubElement(part, element).text = name


def policy(found):
    """Return the policy as XML."""
    root = ET.Element('policy', version='0.2.0')
    enclaves = ET.SubElement(root, 'enclaves')
    for node, access in found.items():
        enclave = ET.SubElement(enclaves, 'enclave', path=f'/{node}')
        profiles = ET.SubElement(enclave, 'profiles')
        _grant(ET.SubElement(profiles, 'profile', ns='/', node=node), access)
        if node == 'blf_dsc_controller':
            profile = ET.SubElement(profiles, 'profile', ns='/', node=ACTION_NODE)
            part = ET.SubElement(profile, 'actions', execute='ALLOW')
            ET.SubElement(part, 'action').text = f'/{ACTION}'
            _grant(profile, ACTION_ACCESS)
    ET.indent(root)
    return HEAD + ET.tostring(root, encoding='unicode') + '\n'


if __name__ == '__main__':
    Path(sys.argv[1]).write_text(policy(live()), encoding='utf-8')

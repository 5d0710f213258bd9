# SPDX-License-Identifier: Apache-2.0
"""The live view among strangers: odd messages on its topics, other pages in the browser."""

from __future__ import annotations

import json
import socket
import zipfile

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')
pytest.importorskip('viser', reason='needs viser: pip install .[view]')

import trimesh
from diagnostic_msgs.msg import DiagnosticStatus
from page_visitor import get, refusal, visitor
from ros_rig import RosRig
from sensor_msgs.msg import JointState
from std_msgs.msg import String

import blf_dsc_controller as blf
from blf_dsc_controller.arms.two_link import urdf
from blf_dsc_controller.arms.urdf import read_chain
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import Journal
from blf_dsc_controller.view.node import ViewNode
from blf_dsc_controller.view.shown_arm import ShownArm

JOINTS = ['joint1', 'joint2']
NAN, INF = float('nan'), float('inf')


def text(content):
    return String(data=content if isinstance(content, str) else json.dumps(content))


def states(names, position, second=0.0):
    message = JointState(name=names, position=position)
    message.header.stamp.sec = int(second)
    message.header.stamp.nanosec = round(second % 1.0 * 1e9)
    return message


def configure(**parameters):
    """The first event of a journal, with some parameters replaced."""
    journal = Journal()
    given = {**flatten(blf.ControllerConfig()), **parameters}
    journal.note('configure', parameters=given)
    return journal.pending[0]


def event(kind, **content):
    return text(
        {
            'number': 1,
            'type': kind,
            'stamp': 0,
            'messages': 0,
            'commands': 0,
            'content': content,
        }
    )


def change(**fields):
    return text({'stamp': 0, 'parameters': {}, 'configured': False, **fields})


ODD = [
    (topics.JOINT_STATES, states(['gripper'], [0.1])),
    (topics.JOINT_STATES, states(JOINTS, [NAN, INF])),
    (topics.JOINT_STATES, states(JOINTS, [1e308, -1e308])),
    (topics.JOINT_STATES, states([*JOINTS, 'joint1'], [0.1, 0.2, 0.3])),
    (topics.TRACKING_ERROR, states(JOINTS, [INF, -INF])),
    (topics.BOUND, states(JOINTS, [0.0, -1.0])),
    (topics.MONITOR, states(['lambda_min', 'tool_error'], [1e308, INF])),
    (topics.TRUTH, states(['load mass'], [1e308])),
    (topics.CHANGES, text('x')),
    (topics.CHANGES, text('[' * 100_000)),
    (topics.CHANGES, change(stamp='now', parameters={'load.payload': 1.0})),
    (topics.CHANGES, text('{"stamp": 1e999, "parameters": {"load.payload": 1}}')),
    (topics.CHANGES, change(parameters=[1])),
    (topics.CHANGES, change(configured=True, parameters={'arm.l1': 'long'})),
    (topics.CHANGES, change(configured=True, parameters={'arm.l1': 1e308})),
    (topics.CHANGES, change(parameters={'events.begin': 3})),
    (
        topics.CHANGES,
        change(parameters={'events.begin': [1.0], 'events.payload': [None]}),
    ),
    (topics.STATE, DiagnosticStatus(level=bytes([200]), message='odd')),
    (topics.JOURNAL, text('x')),
    (topics.JOURNAL, event('nothing known')),
    (topics.JOURNAL, event('contact')),
    (topics.JOURNAL, event('configure', parameters={'nonsense': 1})),
    (topics.JOURNAL, event('configure', parameters={'law': '/nowhere/law.py'})),
    (topics.JOURNAL, event('configure', parameters={'robot.urdf': '/nowhere'})),
    (topics.TARGETS, text('x')),
    (topics.TARGETS, event('start')),
]


class Sender:
    """Sends what a controller, an arm and strangers send to a view."""

    def __init__(self, ros, view):
        self.ros = ros
        self._view = view
        self._publishers = {}
        self._now = 1.0

    def publisher(self, topic):
        """Return the publisher of a topic, to which the view has subscribed."""
        if topic not in self._publishers:
            self._publishers[topic] = self.ros.publisher(topic)
            self.ros.until(self._publishers[topic].get_subscription_count)
        return self._publishers[topic]

    def send(self, topic, message):
        """Send a message, and wait until the view has taken it."""
        taken = []
        take = self._view._raw_subscriptions.take

        def take_and_note():
            messages = take()
            taken.extend(each for each in messages if each.handle is topic)
            return messages

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(self._view._raw_subscriptions, 'take', take_and_note)
            self.publisher(topic).publish(message)
            self.ros.until(lambda: taken)

    def move(self, view=None, then=()):
        """Move the arm, with messages after its own, until the page of a view shows it."""
        view = view or self._view
        self._now += 0.1
        angle = np.sin(self._now)
        moved = states(JOINTS, [angle, 0.2], self._now)

        def is_shown():
            for message in (moved, *then):
                self.publisher(topics.JOINT_STATES).publish(message)
            return view.past and view.past[-1].position[0] == angle

        self.ros.until(is_shown)


@pytest.fixture(scope='module')
def watched():
    """A view of an arm with an open page, and who sends to it."""
    ros = RosRig()
    view = ros.add(ViewNode, port=18380)
    sender = Sender(ros, view)
    sender.send(topics.JOURNAL, text(configure()._asdict()))
    with visitor(view.page.server.get_port()):
        ros.until(view.page.server.get_clients)
        sender.move()
        yield view, sender
    view.close()
    ros.close()


@pytest.mark.parametrize(('topic', 'message'), ODD)
def test_view_survives_an_odd_message(watched, topic, message):
    """It shows the arm as before, for whoever has its page open."""
    _, sender = watched
    sender.send(topic, message)
    sender.move()


def test_arm_moves_with_a_gripper_on_the_same_topic(watched):
    """Whose states follow each of the arm's."""
    view, sender = watched
    sender.move(then=[states(['gripper'], [0.1])])
    assert np.isfinite(view.past[-1].position).all()


def test_arm_is_drawn_without_a_plant_that_cannot_be(ros):
    """The plant may come before the journal that says what it is of."""
    view = ros.add(ViewNode, port=18400)
    sender = Sender(ros, view)
    sender.send(topics.CHANGES, change(configured=True, parameters={'arm.l1': 1e308}))
    sender.send(topics.JOURNAL, text(configure()._asdict()))
    sender.move()
    view.close()


def test_bound_from_before_the_view_was_started_is_shown(watched):
    """It is latched, and not sent again."""
    _, sender = watched
    # after all odd ones, which the late view reads, too
    sender.send(topics.JOURNAL, text(configure()._asdict()))
    sender.send(topics.BOUND, states(JOINTS, [0.5, 0.25]))
    late = sender.ros.add(ViewNode, port=18390)

    def has_bound():
        sender.move(late)  # the bound may arrive after the first of these states
        return late.past[-1].bound.tolist() == [0.5, 0.25]

    sender.ros.until(has_bound)
    late.close()


@pytest.mark.parametrize(
    'mesh',
    [
        '{share}/arm.stl',
        'package://described/arm.stl',  # of a wheel
        '{share}/arm.zip',
        '{share}/arm.stl/inside',
    ],
)
def test_only_meshes_are_drawn_as_meshes(mesh, tmp_path, monkeypatch):
    """A journal may name any file of this computer."""
    monkeypatch.setattr('sysconfig.get_path', lambda _: tmp_path)
    share = tmp_path / 'cmeel.prefix' / 'share' / 'described'
    share.mkdir(parents=True)
    trimesh.creation.icosphere().export(share / 'arm.stl')
    with zipfile.ZipFile(share / 'arm.zip', 'w') as archive:
        archive.write(share / 'arm.stl', 'arm.stl')
    name = mesh.format(share=share)
    visual = f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
    text = urdf(JOINTS, (1.0, 1.0), (1.0, 1.0)).replace(
        '<inertial>', f'{visual}<inertial>'
    )
    chain = read_chain(text, '', 'tip', tuple(JOINTS))
    shapes = ShownArm(text, chain).model().scene.geometry.values()
    drawn = [each for each in shapes if each.extents == pytest.approx(2.0)]
    assert bool(drawn) == name.endswith('.stl')


# Other pages in the same browser.


@pytest.fixture(scope='module')
def port(watched):
    view, _ = watched
    return view.page.server.get_port()


def test_page_is_read_at_its_own_address_only(port):
    """At a name that leads here without being this computer's, a page reads another's."""
    own = ('127.0.0.1', 'localhost', socket.gethostname(), '192.0.2.1', '[::1]')
    for name in own:
        assert get(port, f'{name}:{port}') == 200
    assert get(port, 'localhost:9000') == 200  # through a tunnel
    for name in ('page.invalid', 'localhost.page.invalid', '127.0.0.1.page.invalid'):
        assert get(port, f'{name}:{port}') == 403
        assert refusal(port, f'{name}:{port}', None) == 403


def test_websocket_is_opened_by_the_page_itself_only(port):
    here = f'localhost:{port}'
    assert refusal(port, here, f'http://{here}') == 101
    assert refusal(port, here, None) == 101  # no browser
    others = ('http://page.invalid', 'null', f'http://localhost:{port + 1}', 'http://[')
    for origin in (*others, f'http://127.0.0.1:{port}'):
        assert refusal(port, here, origin) == 403


def test_visitor_gets_no_public_link(watched, port, monkeypatch):
    """Anybody who opens the page can ask viser for one, through a server of its makers."""
    _, sender = watched
    asked = []
    monkeypatch.setattr('viser._viser.ViserTunnel', lambda *to: asked.append(to))
    with visitor(port, {'type': 'ShareUrlRequest'}):
        sender.ros.spin(1.0)  # a thread of viser's would ask, some time
    assert asked == []

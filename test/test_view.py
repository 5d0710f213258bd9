# SPDX-License-Identifier: Apache-2.0
"""The live view without a browser: what is drawn, how a bag is played, and wrong usage."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import recorded_run
from random_arm import random_urdf
from scipy.spatial.transform import Rotation

pytest.importorskip('yourdfpy', reason='needs viser: pip install blf_dsc_controller[view]')

from blf_dsc_controller.arms.geometry import frames
from blf_dsc_controller.arms.urdf import read_chain
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.errors import BlfDscError, MissingExtraError
from blf_dsc_controller.messages.topics import JOINT_STATES
from blf_dsc_controller.view import page as pages
from blf_dsc_controller.view.arm import ShownArm, with_cylinders, with_known_meshes
from blf_dsc_controller.view.bag import BagPlayer
from blf_dsc_controller.view.page import Page, free_port, plant_events

HOST = '127.0.0.1'
PORT = 18080

CONNECTIONS = []
sys.addaudithook(
    lambda event, args: CONNECTIONS.append(args[1]) if event == 'socket.connect' else None
)


def click(button):
    """Call the callbacks of a click on a button."""
    for callback in button._impl.update_cb:
        callback(None)


def nodes(page):
    """Return the names of all objects drawn in the 3D scene."""
    return set(page.server.scene._handle_from_node_name)


@pytest.fixture(scope='module')
def player(tmp_path_factory):
    page = Page(HOST, PORT)
    path = recorded_run.record(tmp_path_factory.mktemp('view') / 'bag', 2.0)
    yield BagPlayer(page, path)
    page.close()


def test_bag_plays_and_stops_at_its_end(player):
    player.slider.value = 0.5
    player.update(0.2)
    assert player.slider.value == 0.5  # paused
    click(player.button)
    player.update(0.5)
    assert player.slider.value == 1.0
    shown = player._page._caption.content
    now = max(each.time for each in player.snapshots if each.time <= 1.0)
    assert f't = {now:.2f} s' in shown
    player.speed.value = '10'
    player.update(0.05)
    assert player.slider.value == 1.5
    player.update(0.5)
    assert player.slider.value == player.snapshots[-1].time == pytest.approx(2.0, abs=1e-3)
    click(player.button)
    assert player.slider.value == 0.0  # back to the start


def test_snapshots_hold_the_values_of_the_bag(player):
    assert len(player.snapshots) == 60
    last = player.snapshots[-1]
    assert np.abs(last.error).max() < 0.002
    assert last.bound == pytest.approx([0.002, 0.002])
    assert last.truth[:3] == pytest.approx([1.0, 0.32, 0.4])
    assert np.isnan(last.truth[3:]).all()  # the true bias is unknown
    assert last.estimate[:3] == pytest.approx(last.truth[:3], rel=0.3)  # starts at half of it
    assert player.snapshots[0].estimate[:3] == pytest.approx([0.5, 0.16, 0.2], rel=0.1)


def test_arm_ghost_and_path_are_drawn(player):
    player.slider.value = 1.5
    player.update(0.0)
    drawn = nodes(player._page)
    assert {'/path', '/payload'} <= drawn
    for root in ('/arm', '/reference'):
        assert sum(name.startswith(root) for name in drawn) > 5
    plot = player._page._plots[0].data
    assert plot[0][-1] == pytest.approx(1.5, abs=0.04)  # s
    assert 0.0 < np.abs(plot[1:3]).max() < 100.0  # % of the bound
    assert (plot[3] == 100.0).all()
    assert not player._page._ghost.show_visual  # the errors are too small to be seen


def test_events_are_lines_in_the_plots_and_named_at_the_arm(player):
    page = player._page
    player.slider.value = 1.5
    player._events = [(1.0, 'plant', '2 kg picked up')]
    player._drawn = -1
    player.update(0.0)
    for plot in page._plots:
        (at,) = np.flatnonzero(plot.data[-1] == 1.0)
        assert plot.data[0][at - 1 : at + 2] == pytest.approx([1.0, 1.0, 1.0])
        assert np.all(np.diff(plot.data[0]) >= 0.0)
        assert np.isfinite(plot.data).all()
    assert '/event' in nodes(page)
    assert page.server.scene._handle_from_node_name['/event'].text == 'plant: 2 kg picked up'


def test_payloads_and_other_events_of_a_plant_are_listed():
    values = {'events.begin': [20.0, 3.0], 'events.duration': [25.0, 0.0]}
    values['events.payload'] = [2.0, 0.0]
    texts = [(3.0, 'event 2 begins'), (20.0, '2 kg picked up'), (45.0, '2 kg put down')]
    assert plant_events(values) == [(at, 'plant', text) for at, text in texts]
    assert plant_events({}) == []


def test_meshes_of_an_installed_description_are_drawn_only_for_the_same_arm(tmp_path, monkeypatch):
    text = random_urdf(3, 0)[0]
    chain = read_chain(text, '', 'tip', ('j1', 'j2', 'j3'))
    folder = tmp_path / 'cmeel.prefix/share/example-robot-data/robots/any/urdf'
    folder.mkdir(parents=True)
    monkeypatch.setattr('sysconfig.get_path', lambda *_: str(tmp_path))
    for seed, drawn in ((1, 0), (0, 3)):
        other = ET.fromstring(random_urdf(3, seed)[0])  # noqa: S314 - our own
        for link in other.findall('link'):
            if link.get('name') in ('l1', 'l2', 'l3'):
                geometry = ET.SubElement(ET.SubElement(link, 'visual'), 'geometry')
                ET.SubElement(geometry, 'sphere', radius='0.1')
        (folder / f'{seed}.urdf').write_text(ET.tostring(other, encoding='unicode'))
        assert with_known_meshes(text, chain).count('<visual') == drawn


def test_server_opens_no_external_connections(player):
    player.update(0.0)
    assert [peer for peer in CONNECTIONS if isinstance(peer, tuple) and peer[0] != HOST] == []


def test_bag_without_configuration_is_rejected_in_one_line(tmp_path, capsys):
    entries = recorded_run.messages(recorded_run.record(tmp_path / 'whole', 0.05))
    bare = recorded_run.write(tmp_path / 'bare', recorded_run.of(entries, JOINT_STATES))
    assert main(['view', str(bare), '--port', str(PORT)]) == 1
    printed = capsys.readouterr()
    assert 'does not hold the configuration of a controller' in printed.err
    assert 'is on http' not in printed.out


@pytest.mark.parametrize('seed', range(2))
def test_links_without_shapes_become_cylinders_in_place(seed):
    text = random_urdf(4, seed)[0]
    chain = read_chain(text, '', 'tip', ('j1', 'j2', 'j3', 'j4'))
    model = ShownArm(text, chain).model()
    assert len(model.scene.geometry) > 4
    q = np.random.default_rng(seed).uniform(-1.0, 1.0, 4)
    model.update_cfg(dict(zip(('j1', 'j2', 'j3', 'j4'), q, strict=True)))
    for number, frame in enumerate(frames(chain, q)[1:-1], 1):
        placed = model.get_transform(f'l{number}', 'base')
        assert placed == pytest.approx(frame, abs=1e-9)


@pytest.mark.parametrize('seed', range(2))
def test_cylinders_reach_from_joint_to_joint(seed):
    robot = ET.fromstring(with_cylinders(random_urdf(4, seed)[0], 2.0))  # noqa: S314 - our own
    joints = {}
    for joint in robot.findall('joint'):
        end = joint.find('origin').get('xyz').split()
        joints.setdefault(joint.find('parent').get('link'), []).append(np.array(end, dtype=float))
    drawn = 0
    for link in robot.findall('link'):
        for visual in link.findall('visual'):
            cylinder = visual.find('geometry/cylinder')
            if cylinder is not None:
                at, rpy = (
                    np.array(visual.find('origin').get(k).split(), float) for k in ('xyz', 'rpy')
                )
                along = Rotation.from_euler('xyz', rpy).apply((0, 0, 1))
                half = 0.5 * float(cylinder.get('length')) * along
                assert at - half == pytest.approx(np.zeros(3), abs=1e-9)
                ends = joints[link.get('name')]
                assert min(np.abs(at + half - end).max() for end in ends) < 1e-9
                drawn += 1
    assert drawn > 8


def test_port_in_use_is_skipped(player):
    own = player._page.server.get_port()
    assert free_port(HOST, own) > own
    with pytest.raises(BlfDscError, match=r"cannot be served at '192\.0\.2\.1'.*of this computer"):
        free_port('192.0.2.1', PORT)
    with pytest.raises(BlfDscError, match=r'cannot be served at .*nowhere'):
        free_port('nowhere.invalid', PORT)


def test_missing_viser_is_reported_with_the_pip_command(monkeypatch):
    monkeypatch.setattr(pages.importlib.util, 'find_spec', lambda _: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'blf_dsc_controller\[view\]'"):
        Page(HOST, PORT)


def test_view_of_an_offline_run_is_rejected_before_the_run(tmp_path):
    out = tmp_path / 'run'
    assert main(['run', '--offline', '--view', '--out', str(out)]) == 1
    assert not out.exists()

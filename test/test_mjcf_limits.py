# SPDX-License-Identifier: Apache-2.0
"""MJCF that asks for more than a computer has."""

from __future__ import annotations

import json
import re

import pytest
import recorded_run

from blf_dsc_controller import load_loop, simulate
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.simulation.loop import write_bag

REPLICAS = (
    '<replicate count="1000">' * 3
    + '<body><geom size="1" /></body>'
    + '</replicate>' * 3
)


PARTS = [
    (
        '<asset><hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1" /></asset>',
        '3600000000 cells',
    ),
    (
        f'<worldbody>{REPLICAS}</worldbody>',
        'with what it replicates',
    ),
    ('<custom><numeric name="n" size="2000000000" /></custom>', 'cells'),
    ('<size nuser_body="2000000000" />', 'cells'),
]
"""Parts of an MJCF that ask for gigabytes, and what is said of them."""


@pytest.mark.parametrize(('part', 'message'), PARTS)
def test_mjcf_that_asks_for_gigabytes_is_refused_before_it_is_compiled(
    part, message, tmp_path, capsys
):
    text = f'<mujoco>{part}</mujoco>'
    (tmp_path / 'part.xml').write_text(text)
    whole = tmp_path / 'whole.xml'
    whole.write_text('<mujoco><include file="part.xml" /></mujoco>')
    command = ['identify', 'run.csv', '--urdf', str(whole)]
    assert main(command) == 1
    error = capsys.readouterr().err
    assert re.search(message, error)
    assert error.count('\n') == 1


@pytest.fixture(scope='module')
def entries(tmp_path_factory):
    """The messages of a bag of an arm from a URDF."""
    path = tmp_path_factory.mktemp('panda') / 'bag'
    config = load_loop('panda', {'sim_plant': {'duration': 0.05}})
    write_bag(path, simulate(config.controller, config.plant), config.plant)
    return recorded_run.messages(path)


def with_arm(entry, text):
    """The message, in which the text of the arm, if there is one, is another."""
    topic, kind, at, raw = entry
    if topic not in (topics.JOURNAL.resolved, topics.CHANGES.resolved):
        return entry
    content = json.loads(typestore().deserialize_cdr(raw, kind).data)
    parameters = content.get('content', content).get('parameters', {})
    if 'robot.urdf' in parameters:
        parameters['robot.urdf'] = text
    message = typestore().types[kind](data=json.dumps(content))
    return [topic, kind, at, bytes(typestore().serialize_cdr(message, kind))]


@pytest.mark.parametrize('part', [part for part, _ in PARTS])
def test_mjcf_in_a_bag_is_not_compiled_and_this_is_said(
    entries, part, tmp_path, capsys
):
    """The rest of the bag is there still, on the page and in the table."""
    text = f'<mujoco>{part}</mujoco>'
    changed = [with_arm(each, text) for each in entries]
    assert sum(text[:20].encode() in each[3] for each in changed) == 2  # of both nodes
    bag = recorded_run.write(tmp_path / 'bag', changed)
    said = 'cannot be built: .*expected the text of a URDF'
    page = tmp_path / 'a.html'
    assert main(['report', str(bag), '--out', str(page)]) == 0
    assert re.search(said, page.read_text())
    capsys.readouterr()
    assert main(['export', str(bag), '--out', str(tmp_path / 'a.csv')]) == 0
    note, wrote = capsys.readouterr().out.splitlines()
    assert re.search(f'note: .*{said}', note)
    assert '51 rows' in wrote

# SPDX-License-Identifier: Apache-2.0
"""Malicious files: every command gives one clear line, within seconds and little memory."""

from __future__ import annotations

import json
import os
from itertools import pairwise

import pytest
import recorded_run
import synthetic_bag

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.files import share_folder
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError

pytestmark = pytest.mark.usefixtures('blank_pictures')

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')

BOMB = '- &a [x, x]\n' + ''.join(f'- &{b} [*{a}, *{a}]\n' for a, b in pairwise('abcdefghi'))


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('recorded') / 'bag', 0.1)


def test_named_pipe_is_rejected_as_parameter_file_and_urdf(tmp_path, capsys):
    os.mkfifo(tmp_path / 'pipe')
    assert main(['run', '--offline', '--config', str(tmp_path / 'pipe')]) == 1
    with pytest.raises(BlfDscError, match='is not a regular file'):
        _ = Robot(urdf=str(tmp_path / 'pipe')).text
    capsys.readouterr()


# YAML and XML.


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('[' * 100_000, 'nested more than 50 levels'),
        ('a:\n' + '- 1\n' * 100_000, 'more than 50000 entries'),
        (BOMB, 'does not support the alias'),
    ],
)
def test_unreasonable_yaml_is_rejected(tmp_path, text, words):
    path = tmp_path / 'given.yaml'
    path.write_text(text)
    with pytest.raises(BlfDscError, match=words):
        load_loop(path)


ROBOT = '<robot name="x">'
NUMBERS = r'of at most 1e\+06 in magnitude'


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda _: '<!DOCTYPE r [<!ENTITY a "x">]>', 'DOCTYPE'),
        (lambda _: ROBOT + '<link name="a"/>' * 100_000 + '</robot>', 'at most 500'),
        (lambda _: ROBOT + '<a>' * 10**5 + '</a>' * 10**5 + '</robot>', 'the links are none'),
        (lambda text: text.replace(' izz="', ' izz="1e308" was="'), NUMBERS),
        (lambda text: text.replace(' xyz="', ' xyz="1e200 0 0" was="'), NUMBERS),
    ],
    ids=['entities', 'large', 'deep', 'inertia', 'place'],
)
def test_unreasonable_urdf_is_rejected(change, words):
    text = (share_folder() / 'config' / 'ur5e.urdf').read_text()
    with pytest.raises(BlfDscError, match=words):
        Robot(urdf=change(text), tip='tool0').chain(())


# Output files.


def test_nothing_is_overwritten_without_force(bag, tmp_path, capsys):
    for name, *words in (
        ('out', 'report', bag, '--out', tmp_path / 'out'),
        ('out.csv', 'export', bag, '--out', tmp_path / 'out.csv'),
        ('tracking.png', 'plot', bag, '--out', tmp_path),
        ('out', 'identify', bag, '--urdf', 'panda.urdf', '--out', tmp_path / 'out'),
        ('out', 'excite', tmp_path / 'out', '--config', 'panda'),
    ):
        out, kept, command = tmp_path / name, tmp_path / 'kept', [str(word) for word in words]
        kept.write_text('kept')
        out.symlink_to(kept)
        assert main(command) == 1
        assert f'{out} exists already' in capsys.readouterr().err
        if command[0] in ('report', 'export', 'plot'):
            assert main([*command, '--force']) == 0
            assert not out.is_symlink()
            assert main([*command, '--force']) == 0
        assert kept.read_text() == 'kept'
        out.unlink()


def test_joint_names_cannot_break_out_of_the_page_script(tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic_bag, 'JOINTS', ('<!--<script>', '</script><b>x'))
    bag = synthetic_bag.write(tmp_path / 'bag', synthetic_bag.Synthetic(200).messages())
    assert main(['report', str(bag), '--out', str(tmp_path / 'page.html')]) == 0
    _, _, rest = (tmp_path / 'page.html').read_text().partition('id="data">')
    data, _, after = rest.partition('</script>')
    assert '<' not in data
    titles = {panel['title'] for panel in json.loads(data)['panels']}
    assert {'position of <!--<script>', 'position of </script><b>x'} <= titles
    assert '<b>x' not in after

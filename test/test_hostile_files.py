# SPDX-License-Identifier: Apache-2.0
"""Malicious files: every command gives one clear line, within seconds and little memory."""

from __future__ import annotations

import json
import os
import shutil
from itertools import pairwise

import pytest
import recorded_run
import synthetic_bag
import zstandard
from foreign_readers import raw_records
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.files import share_folder
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError

pytestmark = pytest.mark.usefixtures('blank_pictures')

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')

MAGIC = b'\x89MCAP0\r\n'
BOMB = '- &a [x, x]\n' + ''.join(f'- &{b} [*{a}, *{a}]\n' for a, b in pairwise('abcdefghi'))
ZEROS = bytes(20_000_000)
SMALL_LIMIT = ('--max-unpacked', '0.001')  # GB


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('recorded') / 'bag', 0.1)


@pytest.fixture
def copy(bag, tmp_path):
    """A copy of the bag that a test may change."""
    return shutil.copytree(bag, tmp_path / 'copy')


@pytest.fixture
def refused(tmp_path, capsys):
    """Asserts that every command that reads bags fails with one line with these words."""

    def check(bag, words, *options, but=()):
        for command in (
            ('replay', bag),
            ('replay', bag, '--config', 'recommended'),
            ('report', bag, '--out', tmp_path / 'page.html'),
            ('export', bag, '--out', tmp_path / 'table.csv'),
            ('plot', bag, '--out', tmp_path / 'plots'),
            ('identify', bag, '--urdf', 'panda.urdf', '--out', tmp_path / 'new.urdf'),
            ('recover', bag, '--out', tmp_path / 'recovered'),
        ):
            if {command[0], command[-1]} & {*but}:
                continue
            assert main([str(word) for word in (*command, *options)]) == 1, command
            error = capsys.readouterr().err
            assert words in error, (command, error)
            assert error.count('\n') == 1, error
            shutil.rmtree(tmp_path / 'recovered', ignore_errors=True)

    return check


def chunk(data, declared, compression='zstd'):
    """A chunk as an MCAP record."""
    builder = RecordBuilder()
    Chunk(compression, data, 0, 0, 0, declared).write(builder)
    return builder.end()


def with_chunks(file, *added):
    """Insert chunks after the header of a file."""
    data = file.read_bytes()
    (header, _), *_ = ((raw, at) for at, raw in raw_records(data))
    at, footer = len(MAGIC) + len(header), len(data) - len(MAGIC) - 20
    start = int.from_bytes(data[footer : footer + 8], 'little') + sum(map(len, added))
    end = start.to_bytes(8, 'little') + bytes(12) + MAGIC
    file.write_bytes(b''.join([data[:at], *added, data[at:footer], end]))
    return file


# Links, paths and pipes.


@pytest.mark.parametrize('is_link', [False, True])
def test_files_outside_the_bag_folder_are_not_read(bag, copy, refused, tmp_path, is_link):
    other = tmp_path / 'elsewhere'
    other.mkdir()
    shutil.copy(bag / 'bag_0.mcap', other / 'secret.mcap')
    (copy / 'bag_0.mcap').unlink()
    if is_link:
        (copy / 'bag_0.mcap').symlink_to(other / 'secret.mcap')
    else:
        metadata = copy / 'metadata.yaml'
        text = metadata.read_text()
        metadata.write_text(text.replace('- bag_0.mcap', '- ../elsewhere/secret.mcap'))
    refused(
        copy, 'outside of the folder' if is_link else 'missing', but=() if is_link else ('recover',)
    )


@pytest.mark.parametrize('name', ['bag_0.mcap', 'metadata.yaml'])
def test_named_pipe_in_a_bag_does_not_block(copy, refused, name):
    (copy / name).unlink()
    os.mkfifo(copy / name)
    refused(copy, 'is not a regular file')
    if name == 'bag_0.mcap':
        refused(copy / name, 'is not a regular file')


def test_named_pipe_is_rejected_as_parameter_file_and_urdf(tmp_path, capsys):
    os.mkfifo(tmp_path / 'pipe')
    assert main(['run', '--offline', '--config', str(tmp_path / 'pipe')]) == 1
    with pytest.raises(BlfDscError, match='is not a regular file'):
        _ = Robot(urdf=str(tmp_path / 'pipe')).text
    capsys.readouterr()


# Unpacked size.


def test_chunk_is_not_unpacked_beyond_its_declared_size(copy, refused):
    (copy / 'metadata.yaml').unlink()
    file = with_chunks(copy / 'bag_0.mcap', chunk(zstandard.compress(ZEROS), 100))
    refused(file, f'states 100 bytes, unpacked, but holds {len(ZEROS)}', but=('recover',))
    assert main(['recover', str(file), '--out', str(copy.parent / 'out')]) == 0


@pytest.mark.parametrize('declared', [1 << 29 | 1, 1 << 62])
def test_chunk_that_declares_too_large_a_size_is_not_unpacked(copy, refused, declared):
    file = with_chunks(copy / 'bag_0.mcap', chunk(zstandard.compress(b''), declared))
    refused(file, f'a chunk states {declared} bytes, unpacked', but=('recover',))


def test_bag_is_not_unpacked_beyond_the_limit(copy, refused):
    bomb = chunk(zstandard.compress(ZEROS), len(ZEROS))
    file = with_chunks(copy / 'bag_0.mcap', *[bomb] * 3)
    assert file.stat().st_size < 600_000
    for path in (file, copy):
        refused(path, 'if you trust it, raise --max-unpacked', *SMALL_LIMIT)
    # The size is within the default limit, but the chunks hold no valid record.
    refused(file, 'unknown record type 0', but=('recover',))


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('mode', ['file', 'message'])
def test_compressed_files_and_messages_respect_the_limit(tmp_path, refused, storage, mode):
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    from blf_dsc_controller.messages.types import typestore

    writer = Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection(
            '/joint_states', 'sensor_msgs/msg/JointState', typestore=typestore()
        )
        for k in range(3):
            writer.write(topic, k, ZEROS)
    refused(tmp_path / 'bag', 'raise --max-unpacked', *SMALL_LIMIT, but=('recover',))


def test_ros_1_bag_respects_the_limit(tmp_path, refused):
    from rosbags.rosbag1 import Writer

    from blf_dsc_controller.messages.types import typestore

    writer = Writer(tmp_path / 'one.bag')
    writer.set_compression(writer.CompressionFormat.BZ2)
    with writer:
        topic = writer.add_connection(
            '/joint_states', 'sensor_msgs/msg/JointState', typestore=typestore()
        )
        writer.write(topic, 1, ZEROS)
    assert (tmp_path / 'one.bag').stat().st_size < 10_000
    refused(tmp_path / 'one.bag', 'raise --max-unpacked', *SMALL_LIMIT, but=('recover',))


# YAML and XML.


@pytest.mark.parametrize(
    ('text', 'words'),
    [('[' * 100_000, 'nested more than 50 levels'), (BOMB, 'does not support the alias')],
)
def test_unreasonable_yaml_is_rejected(tmp_path, text, words):
    path = tmp_path / 'given.yaml'
    path.write_text(text)
    with pytest.raises(BlfDscError, match=words):
        load_loop(path)


@pytest.mark.parametrize(
    ('inner', 'words'),
    [
        ('<!DOCTYPE r [<!ENTITY a "x">]>', 'DOCTYPE'),
        ('<robot name="x">' + '<link name="a"/>' * 100_000 + '</robot>', 'at most 500'),
        (
            '<robot name="x">' + '<a>' * 100_000 + '</a>' * 100_000 + '</robot>',
            'no link is the root',
        ),
    ],
    ids=['entities', 'large', 'deep'],
)
def test_unreasonable_urdf_is_rejected(inner, words):
    with pytest.raises(BlfDscError, match=words):
        Robot(urdf=inner).chain(('joint1',))


@pytest.mark.parametrize(('name', 'value'), [('izz', '1e308'), ('xyz', '1e200 0 0')])
def test_absurd_numbers_in_a_urdf_are_rejected(name, value):
    text = (share_folder() / 'config' / 'ur5e.urdf').read_text()
    robot = Robot(urdf=text.replace(f' {name}="', f' {name}="{value}" was="'), tip='tool0')
    with pytest.raises(BlfDscError, match=r'of at most 1e\+06 in magnitude'):
        robot.chain(())


# Output files.


def test_nothing_is_overwritten_without_force(bag, tmp_path, capsys):
    kept = tmp_path / 'kept'
    for command in (
        ('report', bag, '--out', tmp_path / 'out'),
        ('export', bag, '--out', tmp_path / 'out.csv'),
        ('plot', bag, '--out', tmp_path),
        ('identify', bag, '--urdf', 'panda.urdf', '--out', tmp_path / 'out'),
        ('excite', tmp_path / 'out'),
    ):
        out = tmp_path / {'plot': 'tracking.png', 'export': 'out.csv'}.get(command[0], 'out')
        for target in (kept, tmp_path / 'nowhere'):
            kept.write_text('kept')
            out.symlink_to(target)
            words = [str(word) for word in command]
            assert main(words) == 1
            assert f'{out} exists already' in capsys.readouterr().err
            assert not (tmp_path / 'nowhere').exists()
            if command[0] in ('report', 'export', 'plot'):
                assert main([*words, '--force']) == 0
                assert not out.is_symlink()
                assert main([*words, '--force']) == 0
            assert kept.read_text() == 'kept'
            out.unlink()
            for name in ('summary.json', 'parameters.png', 'monitors.png', 'out.datapackage.json'):
                (tmp_path / name).unlink(missing_ok=True)


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

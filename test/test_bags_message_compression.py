# SPDX-License-Identifier: Apache-2.0
"""Bags with individually compressed messages (`compression_mode: message`) are read as others."""

from __future__ import annotations

import numpy as np
import pytest
import recorded_run
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.types import typestore

pytestmark = pytest.mark.usefixtures('blank_pictures')

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('plain') / 'bag')


def pack(bag, path, storage):
    writer = Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    connections = {}
    with writer:
        for topic, type_name, at, raw in recorded_run.messages(bag):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=typestore())
            writer.write(connections[topic], at, raw)
    return path


@pytest.fixture(scope='module', params=[StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def packed(bag, request, tmp_path_factory):
    return pack(bag, tmp_path_factory.mktemp('packed') / 'bag', request.param)


def test_compressed_bag_replays_bit_for_bit(packed, capsys):
    assert main(['replay', str(packed)]) == 0
    assert 'bit-equal: all numbers' in capsys.readouterr().out


def test_compressed_bag_works_with_every_command(bag, packed, tmp_path, capsys):
    np.testing.assert_array_equal(read_run(packed).error, read_run(bag).error)
    for arguments in (
        ['report', str(packed), '--out', str(tmp_path / 'page.html')],
        ['plot', str(packed), '--out', str(tmp_path / 'plots')],
        ['export', str(packed), '--out', str(tmp_path / 'packed.csv')],
        ['export', str(bag), '--out', str(tmp_path / 'plain.csv')],
        ['replay', str(packed), '--config', 'recommended'],
    ):
        assert main(arguments) == 0, capsys.readouterr().err
    assert (tmp_path / 'packed.csv').read_bytes() == (tmp_path / 'plain.csv').read_bytes()


def test_single_compressed_file_is_read_without_metadata(bag, packed):
    """Only metadata.yaml declares that the messages are compressed."""
    (file,) = {*packed.glob('*.mcap'), *packed.glob('*.db3')}
    np.testing.assert_array_equal(read_run(file).error, read_run(bag).error)


def test_compressed_bag_is_recovered_as_an_uncompressed_one(bag, tmp_path, capsys):
    packed = pack(bag, tmp_path / 'bag', StoragePlugin.MCAP)
    (packed / 'metadata.yaml').unlink()  # as after a kill of the recorder
    assert main(['recover', str(packed), '--out', str(tmp_path / 'clean')]) == 0
    assert recorded_run.messages(tmp_path / 'clean') == recorded_run.messages(bag)
    assert main(['replay', str(tmp_path / 'clean')]) == 0, capsys.readouterr().err

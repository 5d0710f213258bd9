# SPDX-License-Identifier: Apache-2.0
"""A bag as a table: the numbers of the bag, each in the row of its stamp."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import synthetic_bag
from synthetic_bag import Synthetic

from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.topics import REFERENCE

SAMPLES = 200


@pytest.fixture(scope='module')
def made():
    return Synthetic(SAMPLES)


@pytest.fixture
def bag(tmp_path, made):
    lost = [one for one in made.messages() if not (one[0] is REFERENCE and one[1] == made.stamp[5])]
    return synthetic_bag.write(tmp_path / 'bag', lost)


def read(path):
    if path.suffix == '.parquet':
        parquet = pytest.importorskip('pyarrow.parquet', reason='needs pyarrow')
        return {name: np.array(v) for name, v in parquet.read_table(path).to_pydict().items()}
    with path.open(newline='') as stream:
        names, *rows = csv.reader(stream)
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


@pytest.mark.parametrize('ending', ['csv', 'parquet'])
def test_every_number_reads_back_equal_in_its_row(tmp_path, made, bag, ending):
    if ending == 'parquet':
        pytest.importorskip('pyarrow', reason='needs pyarrow')
    out = tmp_path / f'table.{ending}'
    assert main(['export', str(bag), '--out', str(out)]) == 0
    found = read(out)
    np.testing.assert_array_equal(found['stamp'], made.stamp)
    np.testing.assert_array_equal(found['position elbow'], made.position[:, 1])
    np.testing.assert_array_equal(found['torque shoulder'], made.torque[:, 0])
    np.testing.assert_array_equal(found['learning m2*l2^2'], made.estimate[:, 1])
    assert np.isnan(found['reference elbow'][5])  # lost, and no other row has moved up
    np.testing.assert_array_equal(found['reference elbow'][6:], made.reference[6:, 1])
    # Told each tenth sample, and held in between.
    np.testing.assert_array_equal(
        found['truth disturbance elbow'], np.repeat(made.disturbance[::10, 1], 10)
    )
    assert set(found['bound shoulder']) == {0.002}


def test_another_ending_is_rejected(tmp_path, bag, capsys):
    assert main(['export', str(bag), '--out', str(tmp_path / 'table.xlsx')]) == 1
    assert 'neither .csv nor .parquet' in capsys.readouterr().err

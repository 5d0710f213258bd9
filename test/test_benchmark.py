# SPDX-License-Identifier: Apache-2.0
"""Tiny versions of the benchmarks run, and a contestant that fails is noticed."""

from __future__ import annotations

import importlib
import math
import shutil

import numpy as np
import pytest

from benchmark.__main__ import main

pytestmark = pytest.mark.nightly


def tiny(monkeypatch, name, **sizes):
    """Import a benchmark with one round and the given sizes."""
    module = importlib.import_module(f'benchmark.{name}')
    for constant, value in {'_ROUNDS': 1, **sizes}.items():
        monkeypatch.setattr(module, constant, value)
    return module


def contestants(rows):
    """Names of the measurements, after a check that their ratios are finite."""
    assert all(0.0 < row.low <= row.median <= row.high < math.inf for row in rows)
    return [row.what for row in rows]


def test_growth_is_written_as_a_table(monkeypatch, tmp_path):
    offline = tiny(monkeypatch, 'offline', _UPDATES=2, _GROWTH_ROUNDS=1, FULL=7.5)
    assert main(['bench', 'growth', '--out', str(tmp_path)]) == 0
    text = (tmp_path / 'RESULTS.md').read_text()
    row = 'panda: n = 7 joints, p = 62 unknowns (48 of the arm + 14 of disturbances)'
    assert f'\n| {row} | **' in text
    monkeypatch.setattr(offline, 'FULL', 1.0)
    with pytest.raises(RuntimeError, match=r'p = 5 .* nothing is learned in 1 s'):
        offline.updates('recommended')


def test_cost_of_tool_bound_and_contacts_is_measured_in_turns(monkeypatch):
    guarded = tiny(monkeypatch, 'guarded', _STATES=5)
    assert contestants(list(guarded.measure())) == [
        f'{name}: {part}'
        for name in ('bound at the tool', 'contacts', 'both')
        for part in ('until the torque', 'whole')
    ]
    monkeypatch.setattr(guarded, 'FULL', 1.0)
    with pytest.raises(RuntimeError, match='nothing is learned in 1 s'):
        guarded.Contestant({})


@pytest.mark.skipif(shutil.which('cc') is None, reason='there is no C compiler')
def test_loop_compared_with_c_and_numpy(monkeypatch):
    """Over 10 s, in which learning begins, C gives the same trajectory."""
    offline = tiny(monkeypatch, 'offline', _LONG=0.1, _SHORT=0.02)
    monkeypatch.setattr(offline, '_PEERS', {'numpy': offline._PEERS['numpy']})
    assert contestants(list(offline.measure())) == ['blf_dsc_controller', 'numpy']
    # angles, torques and estimates are of order 1 to 10
    assert offline.disagreement() < 1e-9


def test_simulators_of_the_peers_run_the_same_arm():
    offline = importlib.import_module('benchmark.offline')
    numpy, *others = (loop(0.2) for loop, _ in offline._PEERS.values())
    # MuJoCo holds the disturbance over a sample, the URDF has 1e-6 kg m^2
    for errors in others:
        np.testing.assert_allclose(
            errors, numpy, rtol=0.0, atol=1e-4 * np.abs(numpy).max()
        )


def test_node_compared_with_null_node(monkeypatch):
    nodes = tiny(monkeypatch, 'nodes', _STEPS=20, _WARM_UP=2, _SETTLING=0.05)
    monkeypatch.setattr(nodes, '_ARMS', {'recommended': 'node'})
    assert contestants(list(nodes.measure())) == [
        f'{name}: {what}'
        for what in ('median latency', 'CPU', 'first torque')
        for name in (nodes._QUIET, nodes._RECORDED)
    ]

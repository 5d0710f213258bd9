# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc plot` in its own process without ROS, as a user runs it."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import synthetic_bag
from synthetic_bag import Synthetic

WITHOUT_ROS = """
import sys
sys.modules['rclpy'] = None  # any import of it fails
from blf_dsc_controller.cli.main import main
sys.exit(main(['plot', *sys.argv[1:]]))
"""


def bag_plot(*arguments):
    command = [sys.executable, '-c', WITHOUT_ROS, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize('part', ['.', 'bag_0.mcap'])
def test_figures_and_summary_are_written(tmp_path, part):
    synthetic_bag.write(tmp_path / 'bag', Synthetic(2000).messages())
    run = bag_plot(tmp_path / 'bag' / part, '--out', tmp_path / 'new' / 'folder')
    assert run.returncode == 0, run.stderr
    written = sorted(path.name for path in (tmp_path / 'new' / 'folder').iterdir())
    assert written == ['parameters.png', 'summary.json', 'tracking.png']
    summary = json.loads((tmp_path / 'new' / 'folder' / 'summary.json').read_text())
    assert summary['samples'] == 2000
    assert 'held by every joint' in run.stdout


def test_missing_bag_is_reported_as_one_message(tmp_path):
    run = bag_plot(tmp_path / 'nowhere', '--out', tmp_path / 'out')
    assert run.returncode == 1
    assert run.stderr.startswith('blf_dsc plot: ')
    assert 'nowhere cannot be read as a bag: there is no such folder' in run.stderr
    assert 'Traceback' not in run.stderr
    assert not (tmp_path / 'out').exists()

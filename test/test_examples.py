# SPDX-License-Identifier: Apache-2.0
"""The programs of examples/ run as a reader would start them, and say what they should."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command import COMPILED, NO_PICTURES

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / 'examples').glob('*.py'))
# Of each: arguments, packages of extras, and a line that it prints.
EXPECTED = {
    '01_mujoco_loop': ([], ['mujoco'], r' 8.0 s: tracking, error 0\.\d+ mrad'),
    '02_fr3_protocol': ([], ['franky_sim', 'pylibfranka'], r'back, within \d'),
    '03_script': ([], ['ruckig'], r'largest error \d\.\d+ mrad, in tracking'),
    '04_policy_chunks': ([], ['ruckig'], r'reference: \d+\.\d+ mrad'),
    '05_keyboard': (['4+++++7- -'], ['ruckig'], r'(?s)panda_joint7.*ended at'),
    '06_insertion': ([], [], r'a contact\n(.*\n)*inserted after [12] contacts'),
    '07_identify_csv': ([], ['plotly'], r'wrote .*corrected\.urdf'),
    '08_own_law': ([], [], r'(?s)blf_dsc: largest error 0\.0.*08_own_law.py: .* \d+\.'),
    '09_ros2_nodes': (['lockstep'], ['rclpy'], r'the arm is there: \[0\.0\d, '),
    '10_openarm': ([], [], r'at \[-0\.6 .*\n?.* mrad off on the way\nat \[-0\.9 .*'),
    '11_own_model': ([], [], r'both identities hold'),
}


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_example_runs_without_hardware(path, tmp_path):
    arguments, packages, line = EXPECTED[path.stem]
    for package in packages:
        if importlib.util.find_spec(package) is None:
            pytest.skip(f'{package} is not installed')
    ended = subprocess.run(
        [sys.executable, path, *arguments],
        cwd=tmp_path,
        env=os.environ | NO_PICTURES,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=2.0 * COMPILED,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert re.search(line, ended.stdout), ended.stdout + ended.stderr


def test_page_names_every_example():
    page = (ROOT / 'doc' / 'scripts.md').read_text()
    assert [path.stem for path in EXAMPLES] == sorted(EXPECTED)
    assert set(re.findall(r'examples/(\w+)\.py', page)) == set(EXPECTED)
    assert 'doc/scripts.md#examples' in (ROOT / 'README.md').read_text()

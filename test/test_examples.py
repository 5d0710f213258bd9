# SPDX-License-Identifier: Apache-2.0
"""The programs of examples/ run as a reader would start them, and say what they should.

They run at night; `test_pages.py` looks at their code.
"""

from __future__ import annotations

import importlib.util
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command import COMPILED, NO_PICTURES, finished

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
    '12_two_arms': ([], [], r'at 0\.3 rad.*\nat 0\.0 rad.*'),
}


@pytest.mark.nightly
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
    assert not re.search('Traceback|Fatal', ended.stderr), ended.stderr
    assert re.search(line, ended.stdout), ended.stdout + ended.stderr


@pytest.mark.nightly
def test_keys_that_are_pressed_at_once_all_count():
    """Joint 1 is chosen and turned by one press: 0.1 s at 0.3 rad/s."""
    pytest.importorskip('ruckig', reason='needs ruckig')
    terminal, end = pty.openpty()
    command = [sys.executable, ROOT / 'examples' / '05_keyboard.py']
    with subprocess.Popen(command, stdin=end, stdout=subprocess.PIPE) as keyboard:
        turned = [shown_position(keyboard.stdout)]
        os.write(terminal, b'1+')
        while abs(turned[-1] - turned[0]) < 0.02:
            turned.append(shown_position(keyboard.stdout))
        os.write(terminal, b'q')
        assert b'ended at' in keyboard.stdout.read()
    os.close(terminal)
    os.close(end)
    assert keyboard.returncode == 0


def shown_position(output):
    """Return the next position of a joint that is printed [rad]."""
    text = b''
    while not (found := re.search(rb'([+-][.0-9]+) rad', text)):
        text += output.read(1)
        assert text, 'it has ended'
    return float(found[1])


@pytest.mark.nightly
def test_keyboard_without_a_terminal_says_what_to_give():
    path = ROOT / 'examples' / '05_keyboard.py'
    ended = finished(sys.executable, path, stdin=subprocess.DEVNULL)
    assert ended.stderr == 'keys come from a terminal, and this is none: give KEYS\n'


def test_page_names_every_example():
    page = (ROOT / 'doc' / 'scripts.md').read_text()
    assert [path.stem for path in EXAMPLES] == sorted(EXPECTED)
    assert set(re.findall(r'examples/(\w+)\.py', page)) == set(EXPECTED)
    assert 'doc/scripts.md#examples' in (ROOT / 'README.md').read_text()

# SPDX-License-Identifier: Apache-2.0
"""Every preset runs by its name, on every path that a page names for it, or is refused."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

import blf_dsc_controller as blf
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import load, locate

NAMES = sorted(path.stem for path in (blf.share_folder() / 'config').glob('*.yaml'))
IN_MOTORS = [
    name
    for name in NAMES
    if load(locate(name), 'drive', DriveConfig).feedback == 'motor'
]
PRESETS = sorted({*NAMES} - {*IN_MOTORS})
LAW = {
    'comparison': 'backstepping',
    'comparison_detuned': 'backstepping',
    'model_based': 'model_based',
    'paper': 'paper',
    'paper_tuned': 'paper',
    'slotine_li': 'slotine_li',
}

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / 'README.md', *sorted((ROOT / 'doc').glob('*.md'))


def walks():
    """Yield each command of a page that runs a preset, but for its time and place, as a parameter.

    Not by the wall clock, which is slower here than some arms; what else runs by day, too, and what
    is over ROS are for the night.
    """
    found = {('widowx', 'run --config widowx --physics mujoco --offline')}  # in words
    for page in PAGES:
        for line in re.findall(r'blf_dsc ((?:run|drive) [^`#\n]*)', page.read_text()):
            words = re.sub(r' --(view|(out|duration) \S+)', '', line)
            name = re.search(r'--config (\w+)(?= |$)', words)
            is_real = words.startswith('drive') and '--robot simulated' not in words
            if name and name[1] in NAMES and not is_real:
                found.add((name[1], words.strip()))
    for preset, words in sorted(found):
        is_run = words.startswith('run')
        by_clock = is_run and not re.search('--offline|lockstep', words)
        if by_clock or (is_run and preset in IN_MOTORS):
            continue
        is_long = is_run and '--physics' not in words
        yield pytest.param(words, id=words, marks=[pytest.mark.nightly] * is_long)


# Figures are drawn with and without a barrier, and of an arm from a URDF; others have
# no more.
DRAWN = {'recommended', 'slotine_li', 'panda'}


def offline(preset, out, duration):
    words = f'run --config {preset} --offline --duration {duration} --out {out}'
    return main(words.split())


@pytest.mark.parametrize('preset', PRESETS)
def test_preset_runs_by_name_and_saves_its_configuration(
    preset, tmp_path, capsys, request
):
    if preset not in DRAWN:
        request.getfixturevalue('blank_pictures')
    assert offline(preset, tmp_path / 'out', 0.5) == 0
    printed = capsys.readouterr().out
    summary = json.loads(
        (tmp_path / 'out' / 'summary.json').read_text(encoding='utf-8')
    )
    assert (
        summary['samples'] == round(0.5 / blf.load_loop(preset).plant.sample_time) + 1
    )
    saved = blf.load_loop(tmp_path / 'out' / 'config.yaml').controller
    assert saved.law == LAW.get(preset, 'blf_dsc')
    held = preset != 'comparison_detuned'
    assert summary['held'] is held
    assert ('held by every joint' in printed) is held
    from_urdf = saved.model == 'urdf'
    assert ('torque error of the learned model' in printed) is from_urdf
    assert summary['parameter_error']['of_torques'] is from_urdf


@pytest.mark.usefixtures('blank_pictures')
@pytest.mark.parametrize('words', [*walks()])
def test_preset_runs_as_a_page_says(words, tmp_path, capfd):
    """Without a stop: for 60 s at night, in which arms pick up a load and put it down."""
    if 'lockstep' in words:
        pytest.importorskip('rclpy')
    seconds = '60' if os.environ.get('NIGHTLY') else '0.5'
    out = tmp_path / 'out'
    assert main([*words.split(), '--duration', seconds, '--out', str(out)]) == 0
    if words.startswith('drive'):
        assert 'and 0 missed' in capfd.readouterr().out
        assert blf.verify(out).difference is None


@pytest.mark.parametrize('preset', IN_MOTORS)
def test_preset_with_feedback_in_its_motors_is_refused_elsewhere(preset, capsys):
    """Over the bus its gains would shake it; the refusal has the command that drives it."""
    drive = f'blf_dsc drive --robot simulated --config {preset}'
    for words in (['--offline'], ['--offline', '--physics', 'mujoco'], []):
        assert main(['run', '--config', preset, '--duration', '0.5', *words]) == 1
        assert drive in capsys.readouterr().err
    loop = blf.load_loop(preset)
    with pytest.raises(
        blf.StartError, match=r'`blf_dsc drive` with drive.feedback: motor'
    ):
        blf.simulate(loop.controller, loop.plant)
    with pytest.raises(blf.StartError, match=r'joint6 oscillates at \d+ Hz'):
        blf.ArmController(preset)
    with pytest.raises(blf.StartError, match='grow from sample to sample'):
        blf.Commissioning(preset)

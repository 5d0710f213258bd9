# SPDX-License-Identifier: Apache-2.0
"""Every preset runs by its name, offline and over ROS."""

from __future__ import annotations

import json

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
@pytest.mark.parametrize('preset', IN_MOTORS)
def test_preset_with_feedback_in_its_motors_is_driven_by_name(preset, tmp_path, capsys):
    """Over the bus its gains would shake it: every other path refuses it, with the command."""
    bag = tmp_path / 'bag'
    arguments = ['--robot', 'simulated', '--config', preset, '--out', str(bag)]
    assert main(['drive', *arguments, '--duration', '0.5']) == 0
    assert 'and 0 missed' in capsys.readouterr().out
    assert blf.verify(bag).difference is None
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

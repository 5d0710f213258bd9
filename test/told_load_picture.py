# SPDX-License-Identifier: Apache-2.0
"""doc/told_load.png: torques while the drives of franky-sim's FR3 take a load over.

PYTHONPATH=.:test .venv/bin/python test/told_load_picture.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from test_drive_franka import SIMULATOR, told_config

import blf_dsc_controller as blf
from blf_dsc_controller.analysis.figures import Picture, head
from blf_dsc_controller.analysis.panels import BLUE, MUTED, ORANGE

OUT = Path('doc/told_load.png')
ADDRESS = '127.0.0.18'
PICKED_UP = 6.0  # s
BEFORE, AFTER = 1.5, 1.0  # s, shown besides the telling
JOINTS = (1, 3)  # those that bear the load


def recorded(folder, text):
    """The bag of a run with this configuration in which 2 kg are picked up."""
    config = folder / 'my.yaml'
    config.write_text(text)
    event = f'load=2@{round(1e3 * PICKED_UP)}'
    simulator = subprocess.Popen(
        [sys.executable, str(SIMULATOR), ADDRESS, event],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert simulator.stdout.readline().strip() == 'ready'
        words = ['--robot', ADDRESS, '--duration', '11', '--config', str(config)]
        words += ['--out', str(folder / 'bag')]
        command = [sys.executable, '-m', 'blf_dsc_controller', 'drive', *words]
        subprocess.run(command, check=True)
    finally:
        simulator.kill()
    return folder / 'bag'


def draw(bag, path):
    """Draw what the joints bear, what is commanded, and what the drives know."""
    run = blf.read_run(bag)
    events = [e for e in blf.verify(bag).events if e.type == 'drive load']
    t = (run.stamp - run.stamp[0]) * 1e-9
    told = np.array([(e.stamp - run.stamp[0]) * 1e-9 for e in events])
    mass = [e.content['mass'] for e in events]
    shown = (t > told[0] - BEFORE) & (t < told[-1] + AFTER)
    picture = Picture(3, 1, 'A load is told to the drives in motion', (9.5, 2.2))
    for axes, j in zip(picture.axes[:2, 0], JOINTS, strict=True):
        axes.plot(
            t[shown], run.effort[shown, j], color=BLUE, label='torque of the joint'
        )
        axes.plot(t[shown], run.torque[shown, j], color=ORANGE, label='command')
        axes.legend(fontsize=8, loc='lower left')
        axes.set_ylabel('[N m]')
        head(axes, run.joints[j])
    axes = picture.axes[2, 0]
    axes.step(
        [t[shown][0], *told, t[shown][-1]],
        [0.0, *mass, mass[-1]],
        where='post',
        color=MUTED,
    )
    axes.set_ylabel('[kg]')
    axes.set_xlabel('time [s]')
    head(axes, 'load that the drives compensate')
    picture.save(path)


if __name__ == '__main__':
    with tempfile.TemporaryDirectory() as folder:
        draw(recorded(Path(folder), told_config()), OUT)

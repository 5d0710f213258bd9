# SPDX-License-Identifier: Apache-2.0
"""A Franka Research 3 whose declared load is wrong.

    python -m benchmark wrong-load [--seconds 15]

Over libfranka's protocol against franky-sim (MuJoCo), in lock-step.  The hand is
empty; 0 to 3 kg are declared by another client, as in Desk: the robot adds a weight
that nobody tells the law.

    preset      with its `torque.first_step` of 1 N m, beyond which a robot has a reflex
    any step    starts whatever the first torque; a robot would have its reflex
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import yaml

import blf_dsc_controller as blf
from benchmark.harness import print_table
from blf_dsc_controller.configuration.files import share_folder

_SIMULATOR = Path(__file__).parents[1] / 'test' / 'franka_simulator.py'
_LOADS = (0.0, 0.25, 0.5, 1.0, 2.0, 3.0)  # kg
_DECLARED = """
import ast, sys, pylibfranka
robot = pylibfranka.Robot(sys.argv[1], pylibfranka.RealtimeConfig.kIgnore)
robot.set_load(*ast.literal_eval(sys.argv[2]))
"""
_ANY = 87.0  # N m
_CENTRE = (0.0, 0.0, 0.1)  # m, from the flange
_INERTIA = (0.001, 0.0, 0.0, 0.0, 0.001, 0.0, 0.0, 0.0, 0.001)  # kg m^2


def run(address: str, load: float, seconds: float, *, any_step: bool) -> list[str]:
    """Return errors [mrad] from the start and 5 s later, and what was weighed; or the refusal."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        config = yaml.safe_load(
            (share_folder() / 'config/fr3_direct.yaml').read_text(encoding='utf-8')
        )
        config['/**/drive']['ros__parameters']['set_load'] = False
        if any_step:
            law = config['/**/blf_dsc_controller']['ros__parameters']
            law['torque']['first_step'] = [_ANY] * 7
        (path / 'my.yaml').write_text(yaml.safe_dump(config), encoding='utf-8')
        simulator = subprocess.Popen(
            [sys.executable, str(_SIMULATOR), address],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert simulator.stdout is not None  # noqa: S101 - for mypy
            simulator.stdout.readline()
            _declare(address, load)
            ended = _drive(address, path, seconds)
        finally:
            simulator.kill()
            simulator.wait()
        if ended.returncode not in (0, 5) or not (path / 'bag').is_dir():
            return [f'refused: {" ".join(ended.stderr.split())[-160:]}', '', '']
        recorded = blf.read_run(path / 'bag')
        if recorded.stops and recorded.stamp.size < seconds * 1e3:
            return [f'stopped: {recorded.stops[0].text[:160]}', '', '']
        error = 1e3 * np.abs(np.asarray(recorded.error)).max(axis=1)
        first = f'{np.nanmax(error[:5000]):.2f}'
        weighed = [
            line for line in ended.stdout.splitlines() if line.startswith('load')
        ]
        text = weighed[0].removeprefix('load').strip() if weighed else 'not yet'
        return [first, f'{np.nanmax(error[5000 : round(1e3 * seconds)]):.2f}', text]


def _declare(address: str, load: float) -> None:
    """Declare a load as somebody in Desk would.

    In a process of its own: libfranka raises the priority of the thread that connects.
    """
    inertia = _INERTIA if load else (0.0,) * 9
    centre = _CENTRE if load else (0.0,) * 3
    given = repr((load, list(centre), list(inertia)))
    words = [sys.executable, '-c', _DECLARED, address, given]
    subprocess.run(words, check=True)


def _drive(
    address: str, path: Path, seconds: float
) -> subprocess.CompletedProcess[str]:
    words = ['--robot', address, '--config', str(path / 'my.yaml')]
    words += ['--duration', f'{seconds:g}', '--out', str(path / 'bag')]
    return subprocess.run(
        [sys.executable, '-m', 'blf_dsc_controller', 'drive', *words],
        capture_output=True,
        text=True,
        check=False,
    )


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument('--seconds', type=float, default=15.0)


def main(options: argparse.Namespace) -> None:
    """Print the table."""
    rows = []
    for number, load in enumerate(_LOADS):
        for any_step in (False, True):
            address = f'127.0.1.{1 + 2 * number + any_step}'
            who = 'any step' if any_step else 'preset'
            found = run(address, load, options.seconds, any_step=any_step)
            rows.append([f'{load:g} kg', who, *found])
            print(rows[-1], flush=True)
    print_table(('declared', '', 'first 5 s [mrad]', 'later [mrad]', 'weighed'), rows)

# SPDX-License-Identifier: Apache-2.0
"""The gallery's clips: an arm that picks up a load, its errors, and what is learned.

    PYTHONPATH=.:test .venv/bin/python test/clips.py [NAME ...]

`two_links` and `openarm` are simulated offline, `fr3` is controlled over libfranka's
protocol in franky-sim.  Each is drawn from its bag.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from animation import RATE, save
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import blf_dsc_controller as blf
from blf_dsc_controller.analysis.panels import BLUE, COLOURS, MUTED, ORANGE
from blf_dsc_controller.arms.urdf import frames
from blf_dsc_controller.cli.main import main as blf_dsc
from blf_dsc_controller.view.shown_arm import ShownArm, arm_of

DOC = Path('doc')
SPEED = 2.0  # of the clip, relative to the arm
TRAIL = 2.0  # s, of the path of the tip
ERROR = 'error of each joint [% of its bound]'


class Clip(NamedTuple):
    """A preset, when its load comes [s], and the part of the run that is shown [s]."""

    title: str
    preset: str
    load: float
    begin: float
    end: float
    view: tuple[float, float]  # elevation and azimuth, in degrees
    options: tuple[str, ...] = ()


CLIPS = {
    'two_links': Clip(
        'Two links pick up 0.5 kg', 'payload', 20.0, 16.0, 26.0, (0.0, -90.0)
    ),
    'openarm': Clip(
        'An OpenArm in MuJoCo picks up 0.5 kg',
        'openarm',
        20.0,
        16.0,
        26.0,
        (15.0, -60.0),
        ('--physics', 'mujoco'),
    ),
    'fr3': Clip(
        "FR3 over libfranka's protocol picks up 2 kg",
        'fr3_direct',
        6.0,
        3.0,
        11.0,
        (15.0, -60.0),
    ),
}


def recorded(clip: Clip, folder: Path) -> Path:
    """Return the bag of a run."""
    if clip.preset == 'fr3_direct':
        from told_load_picture import recorded as driven

        preset = blf.share_folder() / 'config' / 'fr3_direct.yaml'
        return driven(folder, preset.read_text())
    words = ['run', '--config', clip.preset, '--offline', '--out', str(folder / 'run')]
    code = blf_dsc([*words, '--duration', str(clip.end), *clip.options])
    if code:
        raise SystemExit(code)
    return folder / 'run' / 'bag'


def draw_arm(axes: Any, arm: ShownArm, path: np.ndarray, *, loaded: bool) -> None:
    """Draw the arm at the last of some postures (k, n), and the path of its tip."""
    places = np.array([each[..., :3, 3] for each in frames(arm.chain, path)])
    now = places[:, -1]
    axes.clear()
    axes.set_axis_off()
    axes.plot(*places[-1].T, color=BLUE, linewidth=1.5)
    axes.plot(*now.T, color='#4B5563', linewidth=7.0, solid_capstyle='round')
    axes.plot(*now[1:-1].T, 'o', color='#1F2937', markersize=8.0)
    if loaded:
        axes.plot(*now[-1:].T, 'o', color=ORANGE, markersize=15.0)


def pictures(clip: Clip, run: Any, arm: ShownArm) -> Any:
    """Yield the frames of a clip."""
    t = (run.stamp - run.stamp[0]) * 1e-9
    shown = (t >= clip.begin) & (t <= clip.end)
    figure = Figure(figsize=(9.6, 5.0), dpi=80, facecolor='white')
    canvas = FigureCanvasAgg(figure)
    figure.text(0.02, 0.94, clip.title, fontsize=14, fontweight='bold')
    scene = figure.add_axes((-0.04, -0.08, 0.58, 1.08), projection='3d')
    places = np.array(
        [each[..., :3, 3] for each in frames(arm.chain, run.position[shown][::50])]
    )
    low = places.min(axis=(0, 1))
    high = places.max(axis=(0, 1))
    centre = (low + high) / 2.0
    half = 0.52 * float((high - low).max())
    curves = [
        (
            ERROR,
            t[shown],
            100.0 * (np.abs(run.error) / run.bound)[shown],
            COLOURS,
        ),
        ('torque [N m]', t[shown], run.torque[shown], COLOURS),
    ]
    if 'load mass' in run.monitor.names:
        when = (run.monitor.stamp - run.stamp[0]) * 1e-9
        part = (when >= clip.begin) & (when <= clip.end)
        mass = run.monitor.column('load mass')[part, np.newaxis]
        curves.append(('weighed load [kg]', when[part], mass, (BLUE,)))
    lines = []
    for row, (title, time, values, colours) in enumerate(curves):
        height = 0.84 / len(curves)
        place = (0.58, 0.94 - (row + 1) * height, 0.4, height - 0.1)
        axes = figure.add_axes(place)
        axes.set_title(title, loc='left', fontsize=10)
        axes.spines[['top', 'right']].set_visible(False)
        axes.tick_params(labelsize=8)
        axes.set_xlim(clip.begin, clip.end)
        for colour in colours[: values.shape[1]]:
            axes.plot([], [], color=colour, linewidth=1.2)
        known = values[np.isfinite(values)]
        axes.set_ylim(
            known.min() - 0.05 * np.ptp(known), known.max() + 0.05 * np.ptp(known)
        )
        if title == ERROR:
            axes.axhline(100.0, color=MUTED, linestyle='--')
            axes.set_ylim(0.0, 110.0)
        lines.append((axes.get_lines()[: values.shape[1]], time, values))
        axes.axvline(clip.load, color=MUTED, linestyle=':')
    figure.axes[-1].set_xlabel('time [s]', fontsize=9)
    for at in np.arange(clip.begin + SPEED / RATE, clip.end, SPEED / RATE):
        before = (t <= at) & (t > at - TRAIL)
        draw_arm(scene, arm, run.position[before][::-10][::-1], loaded=at > clip.load)
        for axis, place in zip('xyz', centre, strict=True):
            scene.set(**{f'{axis}lim': (place - half, place + half)})
        scene.set_box_aspect((1.0, 1.0, 1.0), zoom=1.4)
        scene.view_init(*clip.view)
        for drawn, time, values in lines:
            for line, column in zip(drawn, values.T, strict=True):
                line.set_data(time[time <= at], column[time <= at])
        page = io.BytesIO()
        canvas.print_png(page)
        yield Image.open(page).convert('RGB')


def main() -> None:
    """Write the clips of these names, or all."""
    for name in sys.argv[1:] or CLIPS:
        clip = CLIPS[name]
        with tempfile.TemporaryDirectory() as folder:
            run = blf.read_run(recorded(clip, Path(folder)))
            arm = arm_of(blf.load_loop(clip.preset).controller, {'arm.l2': 0.8})
            out = DOC / f'{name}.webp'
            save(out, pictures(clip, run, arm))
        print(f'{out}: {out.stat().st_size / 1e6:.2f} MB')


if __name__ == '__main__':
    main()

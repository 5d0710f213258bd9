# SPDX-License-Identifier: Apache-2.0
"""The picture of a commissioning: margins of the gains, and responses of the joints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from blf_dsc_controller.analysis.figures import Picture
from blf_dsc_controller.analysis.panels import ALARM, BLUE, MUTED, ORANGE, SHADE
from blf_dsc_controller.arms.joint_gains import JointGains
from blf_dsc_controller.arms.linear_loop import SLOWEST
from blf_dsc_controller.commissioning.commissioned import Commissioned

_COLOURS = (BLUE, ORANGE, MUTED, ALARM)
_SIZE = (5.6, 3.4)  # inches, of a panel


def draw(found: Commissioned, names: Sequence[str], path: Path) -> None:
    """Draw the margins of measured and chosen gains, and the response of each joint.

    `names` are those of the runs.
    """
    n = len(found.joints)
    rows = 1 + -(-n // 2)  # two joints in each, below the margins
    title = 'Commissioning: margins and responses'
    picture = Picture(rows, 2, title, _SIZE, share_time=False)
    before, after = picture.axes[0]
    _draw_margin(before, found, found.start, 'as measured', names)
    _draw_margin(after, found, found.choice.gains, 'as chosen', names)
    _draw_observer(after, found)
    before.legend(frameon=False, fontsize=8, loc='lower right')
    panels = list(picture.axes[1:].flat)
    for j, axes in enumerate(panels[:n]):
        _draw_response(axes, found, j)
    for axes in panels[n:]:
        axes.set_visible(False)
    picture.save(path)


def _draw_margin(
    axes: Axes, found: Commissioned, gains: JointGains, label: str, names: Sequence[str]
) -> None:
    """Draw the least singular value over the frequency, with what noise takes from it."""
    values = found.loops.singular_values(gains)
    for k, (each, response) in enumerate(zip(values, found.responses, strict=True)):
        seen = response.seen
        f, least, doubt = response.frequency[seen], each.least[seen], each.doubt[seen]
        axes.semilogx(f, least, color=_colour(k), label=names[k])
        axes.fill_between(f, least - doubt, least, color=_colour(k), alpha=0.2, lw=0.0)
    axes.axhline(found.aim, color=ALARM, lw=1.0, ls='--')
    axes.axvspan(axes.get_xlim()[0], SLOWEST, color=SHADE, alpha=0.5, lw=0.0)
    axes.set_ylim(0.0, 1.5)
    axes.set_title(f'least singular value of I + L, gains {label}', loc='left')
    axes.set_xlabel('frequency [Hz]')


def _draw_observer(axes: Axes, found: Commissioned) -> None:
    """Draw the least singular value with the load observer, dotted, if there is one."""
    if found.sensed is None or found.observer is None or found.observer.pole == 0.0:
        return
    pole = found.observer.pole
    values = found.sensed.singular_values(found.choice.gains, pole)
    lines = []
    for k, (each, response) in enumerate(zip(values, found.responses, strict=True)):
        f, least = response.frequency[response.seen], each.least[response.seen]
        lines += axes.semilogx(f, least, color=_colour(k), ls=':', lw=1.0)
    label = f'with the load observer, {pole:g} rad/s'
    axes.legend(lines[:1], [label], frameon=False, fontsize=8, loc='upper left')


def _draw_response(axes: Axes, found: Commissioned, j: int) -> None:
    """Draw the acceleration of joint j by its own torque, over the frequency."""
    for k, response in enumerate(found.responses):
        f = response.frequency
        own = np.abs(response.position[:, j, j])
        axes.loglog(f, own * (2.0 * np.pi * f) ** 2, color=_colour(k))
    axes.set_title(f'{found.joints[j]}: acceleration by torque', loc='left')
    axes.set_ylabel(found.before.units[j].of('rad/(s^2 N m)'))
    axes.set_xlabel('frequency [Hz]')


def _colour(k: int) -> str:
    """Return the colour of the k-th run."""
    return _COLOURS[k % len(_COLOURS)]

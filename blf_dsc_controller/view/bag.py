# SPDX-License-Identifier: Apache-2.0
"""Playback of a bag on the page: play, pause and seek."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NoReturn

import numpy as np

from blf_dsc_controller.analysis.report import read_bag
from blf_dsc_controller.bags.content import NO_NAMES, NameMap
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.messages.topics import LAMBDA_MIN, LOAD, PLANT
from blf_dsc_controller.run import Floats, Run, Series, Stamps
from blf_dsc_controller.view.page import PAST, Page, Snapshot, plant_events

_RATE = 30.0  # snapshots per second
_MOST = 20_000  # snapshots per bag
_PERIOD = 1.0 / 30.0  # s
_PLOTTED = 6  # frames between updates of the plots
_SPEEDS = ('0.1', '0.5', '1', '2', '5', '10')


class BagPlayer:
    """Player of a bag; BlfDscError if it cannot be read or has no controller configuration.

    Attributes:
        slider: time [s].
        button: toggles between play and pause.
    """

    def __init__(
        self, page: Page, path: Path, namespace: str = '', names: NameMap = NO_NAMES
    ) -> None:
        bag = read_bag(path, namespace, names)
        config = bag.content.controller_config()
        plant = bag.content.configurations.get(PLANT, {})
        self.snapshots = snapshots(bag.run, estimate_names(config))
        self._page, self._times = page, np.array([each.time for each in self.snapshots])
        self._events = sorted([*bag.events, *plant_events(plant)])
        self._playing, self._drawn = False, -1
        page.draw_arm(config, plant)
        gui = page.server.gui
        end = float(self._times[-1])
        self.slider = gui.add_slider('time [s]', 0.0, end, 1e-3, 0.0, order=-2.0)
        self.speed = gui.add_dropdown('speed', _SPEEDS, initial_value='1', order=-1.0)
        self.button = gui.add_button('Play / Pause', order=-1.5)
        self.button.on_click(lambda _: self.toggle())
        page.state('BAG', f'{bag.name}, {bag.run.duration:.1f} s')

    def toggle(self) -> None:
        """Toggle between play and pause; at the end, start over."""
        self._playing = not self._playing
        if self._playing and self.slider.value >= self._times[-1]:
            self.slider.value = 0.0

    def update(self, elapsed: float) -> None:
        """Advance by the elapsed time [s] while playing, and draw the snapshot at the slider."""
        if self._playing:
            goal = self.slider.value + elapsed * float(self.speed.value)
            self._playing = goal < self._times[-1]
            self.slider.value = min(goal, float(self._times[-1]))
        k = max(0, int(np.searchsorted(self._times, self.slider.value, side='right')) - 1)
        if k == self._drawn:
            return
        plots = not self._playing or k // _PLOTTED != self._drawn // _PLOTTED
        self._drawn = k
        first = int(np.searchsorted(self._times, self._times[k] - PAST))
        past = self.snapshots[first : k + 1]
        self._page.events([event for event in self._events if event[0] <= self._times[k]])
        self._page.move(past)
        if plots:
            self._page.plot(past)

    def play(self) -> NoReturn:
        """Follow the buttons and the slider until Ctrl-C."""
        before = time.monotonic()
        while True:
            now = time.monotonic()
            self.update(now - before)
            before = now
            time.sleep(_PERIOD)


def snapshots(run: Run, estimates: tuple[str, ...]) -> list[Snapshot]:
    """Return about thirty snapshots per second of a run, each with the last known values."""
    count = int(min(_MOST, max(2.0, _RATE * run.duration)))
    rows = np.unique(np.searchsorted(run.time, np.linspace(0.0, run.duration, count)))
    rows = rows[rows < run.time.size]
    unknown = np.full((rows.size, len(run.joints)), np.nan)

    def at(values: Floats | None) -> Floats:
        return unknown if values is None else values[rows]

    stamps = run.stamp[rows]
    figures = _held(run.monitor, stamps, (*estimates, LAMBDA_MIN))
    truth = _held(run.truth, stamps, estimates)
    loaded = (np.abs(truth - truth[0]) > 0.0).any(axis=1)
    arrays = (run.position, run.error, run.bound, run.torque)
    columns = (run.time[rows].tolist(), *map(at, arrays), figures[:, :-1], truth)
    load = _held(run.monitor, stamps, LOAD)
    each = zip(*columns, figures[:, -1].tolist(), load, loaded.tolist(), strict=True)
    return [Snapshot(*values) for values in each]


def _held(series: Series | None, stamps: Stamps, names: tuple[str, ...]) -> Floats:
    """Return the values (k, m) of these names, NaN where unknown."""
    found = np.full((len(stamps), len(names)), np.nan)
    if series is not None:
        held = series.held(stamps)
        for j, name in enumerate(names):
            if name in series.names:
                found[:, j] = held[:, series.names.index(name)]
    return found

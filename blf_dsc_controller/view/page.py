# SPDX-License-Identifier: Apache-2.0
"""The page: 3D view of the arm, plots and events, drawn from snapshots.

viser serves the page with everything that the browser needs: nothing is loaded from
elsewhere.
"""

from __future__ import annotations

import importlib.util
import io
import os
import socket
import time
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from html import escape
from math import inf
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.panels import ALARM, COLOURS, GREEN, INK, MUTED, ORANGE
from blf_dsc_controller.arms.urdf import frames
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.extras import missing_extra
from blf_dsc_controller.run import Floats, unit_of_all
from blf_dsc_controller.view.model_error import shares
from blf_dsc_controller.view.shown_arm import arm_of
from blf_dsc_controller.view.snapshot import Snapshot
from blf_dsc_controller.view.texts import caption, contact_of, event_list

PAST = 20.0
"""Time span of the plots [s]."""

_TRAIL = 4.0  # s of the tip's path
_SHOWN = 3.0  # s that an event is named beside the arm
_GHOST = (0, 200, 120, 0.35)
_APART = 0.01  # rad, error from which on the reference is drawn beside the arm
_PEAK = 30  # snapshots, a second, of which the largest error is plotted
_AXIS_OF_SHARE = (0.1, 300.0)  # % of the bound
_HEIGHT = 130  # px of a plot: three fit below the state at 900 px
_VIEW = np.array((0.42, -0.88, 0.22))  # direction from the arm to the camera
_FEWEST = 2  # snapshots that can be replayed, or have a path
_REPLAYED = 1000  # steps of the slider
_LINE = {'width': 1.5, 'points': {'show': False}}
_AUTO: Mapping[str, Any] = {}
_FROM_ZERO = {
    'range': {'min': {'hard': 0.0, 'soft': 0.0, 'mode': 1}, 'max': {'pad': 0.1}}
}
_FROM_ZERO_KG = {  # at least 1 kg: an unknown load has no scale of its own
    'range': {
        'min': {'hard': 0.0, 'soft': 0.0, 'mode': 1},
        'max': {'pad': 0.1, 'soft': 1.15, 'mode': 1},  # room for half of its number
    }
}
_NO_TICKS: Mapping[str, Any] = {'ticks': {'show': False, 'size': 0}}
_X_AXIS: Mapping[str, Any] = {**_NO_TICKS, 'size': 26}  # px, for one line of numbers
_AXES = (_X_AXIS, _NO_TICKS)
# By itself uPlot draws a line at each of 2, 3, ... 9 times a decade, which at this height
# are grey bands, and names every second decade.
_DECADES = (
    _X_AXIS,
    {
        **_NO_TICKS,
        'splits': [0.1, 1.0, 10.0, 100.0],
        'values': ['0.1', '1', '10', '100'],
    },
)
_SETTLED = 2.0  # s
_NARROW = 576  # px, width up to which viser shows the panel below
# viser's sheet for narrow windows is as wide as a panel and covers the arm on one side.
_SHEET = (
    '<style>@media (max-width:36em){[style*="width: 20em"]'
    '{width:100%!important;max-height:50vh!important}}</style>'
)
_LEVELS = {'OK': GREEN, 'WARN': ORANGE, 'ERROR': ALARM, 'STALE': MUTED}


def require_viser() -> None:
    """Raise MissingExtraError unless viser and its URDF support are installed."""
    for module in ('viser', 'yourdfpy'):
        if importlib.util.find_spec(module) is None:
            raise missing_extra(module, 'view', 'the page')


class Page:
    """Page at a host, on the first free port from the given one on.

    Raises:
        MissingExtraError: viser is not installed.
        BlfDscError: the page cannot be served there.

    Attributes:
        server: the viser server.
        url: address to open in a browser.
        shown_state: level and text of the controller's state.
        listed: time [s], kind and text of the events, as in `event_list`.
        caption: numbers of the last moment.
        plots: errors and torques, and what has been learned.
        ghost: the arm at its reference.
        slider: replays a finished run; None before.
    """

    def __init__(self, host: str, port: int) -> None:
        require_viser()
        from blf_dsc_controller.view.server import PageServer  # slow, and optional

        try:  # viser would try one port after the other, for ever
            socket.create_server((host, 0)).close()
        except OSError as error:
            problem = f'the page cannot be served at {host!r} ({error.strerror})'
            raise BlfDscError(f'{problem}: give an address of this computer') from error
        with redirect_stdout(io.StringIO()):  # hides its banner
            self.server = PageServer(host, port)
        self.url = f'http://{host}:{self.server.get_port()}'
        self.listed: list[tuple[float, str, str]] = []
        self.shown_state = 'STALE', ''
        self._corners: Floats | None = None  # joints and tip when first drawn
        self.server.on_client_connect(self._welcome)
        self._clear()

    def _clear(self) -> None:
        """Show only the state until `draw_arm` is called."""
        server, gui = self.server, self.server.gui
        self.event_list: Any = None
        self.slider: Any = None
        server.scene.reset()
        gui.reset()
        gui.configure_theme(
            show_logo=False, show_share_button=False, control_width='large'
        )
        gui.main_panel.dock_right()
        server.scene.configure_default_lights(cast_shadow=False)  # costly without a GPU
        self._header = gui.add_html('')
        self.state(*self.shown_state)

    def draw_arm(self, config: ControllerConfig, plant: Mapping[str, Any]) -> None:
        """Draw the arm of a controller, with the parameters of its plant."""
        from viser.extras import ViserUrdf

        arm = arm_of(config, plant)
        model, shadow = arm.model(), arm.model()  # whoever sent them: both can be drawn
        self._clear()
        self._arm = arm
        self._joints = [joint.name for joint in arm.chain.joints]
        self._units = config.units
        self._shows_contact = config.contact.enabled
        prefix, names = _shortened(self._joints)
        server = self.server
        gui = self.server.gui
        reach = arm.reach
        self._held = dict.fromkeys(model.actuated_joint_names, 0.0)
        self._drawn = ViserUrdf(server, model, root_node_name='/arm')
        self.ghost = ViserUrdf(
            server, shadow, root_node_name='/reference', mesh_color_override=_GHOST
        )
        self._base = np.array(model.get_transform(arm.chain.base))
        server.scene.add_grid('/floor', 4 * reach, 4 * reach, cell_size=0.25)
        self._corners = None
        tabs = self._tabs = gui.add_tab_group()
        with tabs.add_tab('Plots'):
            self.plots = list(self._plots(prefix, names))
            self.caption = gui.add_html('')
        with tabs.add_tab('Events'):
            self.event_list = gui.add_html(event_list(self.listed))

    def _plots(self, prefix: str, names: Sequence[str]) -> Iterator[Any]:
        """Yield the plots of joints with these names, which have a prefix in common."""
        yield self._plot(
            f'{prefix}: largest error in 1 s [% of bound]',
            names,
            {'distr': 3, 'range': _AXIS_OF_SHARE},
            'bound',
            _DECADES,
        )
        unit = unit_of_all(self._units, 'N m')
        yield self._plot(f'{prefix}: torque [{unit}]', names)
        if self._shows_contact:
            yield self._plot(f'{prefix}: external torque [{unit}]', names)
        yield self._plot(
            'torque error of the model [%]', ('learned', 'initial'), _FROM_ZERO
        )
        yield self._plot(
            'load at the tip, 95 % interval [kg]',
            ('weight', 'from', 'to'),
            _FROM_ZERO_KG,
        )

    def _plot(
        self,
        title: str,
        names: Sequence[str],
        y: Mapping[str, Any] = _AUTO,
        limit: str = '',
        axes: tuple[Mapping[str, Any], ...] = _AXES,
    ) -> Any:
        lines: list[dict[str, Any]] = [
            {'label': name, 'stroke': COLOURS[k % len(COLOURS)]}
            for k, name in enumerate(names)
        ]
        if limit:
            lines.append({'label': limit, 'stroke': ALARM, 'dash': [6, 4]})
        lines.append({'label': 'event', 'stroke': INK, 'width': 1.0, 'scale': 'marks'})
        lines = [{'label': 's'}, *({**_LINE, **line} for line in lines)]
        scales: Any = {'x': {'time': False}, 'y': y, 'marks': {'range': (0.0, 1.0)}}
        return self.server.gui.add_uplot(
            (np.zeros(1),) * len(lines),
            tuple(lines),
            title=title,
            scales=scales,
            axes=axes,
            legend={'show': True, 'live': False},
            height=_HEIGHT,
        )

    def offer_replay(self, run: Sequence[Snapshot]) -> None:
        """Offer a slider over these snapshots of an ended run; none without any."""
        if self.slider is not None:
            self.slider.remove()
            self.slider = None
        if len(run) < _FEWEST:
            return
        times = [each.time for each in run]
        first, last = times[0], times[-1]
        self.slider = self.server.gui.add_slider(
            'replay [s]',
            first,
            last,
            (last - first) / _REPLAYED,
            last,
            order=self._tabs.order - 0.5,
        )

        def show(_: Any) -> None:
            at = bisect_right(times, self.slider.value)
            past = run[bisect_left(times, times[at - 1] - PAST) : at]
            self.move(past)
            self.plot(past)

        self.slider.on_update(show)

    def state(self, level: str, text: str) -> None:
        """Show the state: level (OK, WARN, ERROR or STALE) and description."""
        self.shown_state = level, text
        word = '' if level == 'STALE' else level  # nothing has come yet
        self._header.content = (
            f'{_SHEET}<div style="margin:4px 12px;padding:6px 10px;border-radius:6px;color:white;'
            f'background:{_LEVELS[level]}"><b>{word}</b> {escape(text)}</div>'
        )

    def events(self, events: Sequence[tuple[float, str, str]]) -> None:
        """List these events: time [s], kind and text."""
        if self.listed != list(events):
            self.listed = list(events)
            if self.event_list is not None:
                self.event_list.content = event_list(self.listed)

    def move(self, past: Sequence[Snapshot]) -> None:
        """Move the arm to the last of these snapshots, and draw the way of its tip."""
        now = past[-1]
        with self.server.atomic():
            self._drawn.update_cfg(self._posture(now.position))
            placements = self._at(np.array(frames(self._arm.chain, now.position)))
            if self._corners is None:
                self._corners = placements
                self._aim_all()
            self._mark_contact(now, placements[1:-1])
            self._move_ghost(now)
            self._mark_load(placements[-1], is_loaded=now.loaded)
            self._mark_event(placements[-1], now.time)
            self._draw_path(past)

    def _move_ghost(self, now: Snapshot) -> None:
        """Show the reference as a ghost, if the arm is apart from it."""
        reference = now.position - now.error
        self.ghost.show_visual = bool(np.abs(now.error).max() > _APART)  # NaN: not
        if np.isfinite(reference).all():
            self.ghost.update_cfg(self._posture(reference))

    def _mark_load(self, tip: Floats, *, is_loaded: bool) -> None:
        """Mark a load at the tip (3,) [m]."""
        self.server.scene.add_icosphere(
            '/payload',
            0.045 * self._arm.reach,
            color=(213, 94, 0),
            position=tip,
            visible=is_loaded,
        )

    def _mark_event(self, tip: Floats, time: float) -> None:
        """Name the last event above the tip (3,) [m], for a while after its time [s]."""
        recent = [each for each in self.listed if time - _SHOWN < each[0] <= time]
        _, kind, text = recent[-1] if recent else (0.0, '', '')
        self.server.scene.add_label(
            '/event',
            f'{kind}: {text}' if text else kind,
            position=tip + np.array((0.0, 0.0, 0.1 * self._arm.reach)),
            visible=bool(kind),
        )

    def _draw_path(self, past: Sequence[Snapshot]) -> None:
        """Draw the way of the tip in the last seconds."""
        begin = past[-1].time - _TRAIL
        recent = np.array([each.position for each in past if each.time > begin])
        if len(recent) < _FEWEST:
            return
        path = self._at(frames(self._arm.chain, recent)[-1])
        self.server.scene.add_line_segments(
            '/path',
            np.stack((path[:-1], path[1:]), axis=1),
            (0, 114, 178),
            thickness=3.0,
            thickness_units='screen',
        )

    def _mark_contact(self, now: Snapshot, joints: Floats) -> None:
        """Mark the joint in contact, of those at these places (n, 3) [m]."""
        felt = now.felt_at
        reach = self._arm.reach
        k = felt or 0
        scene = self.server.scene
        scene.add_icosphere(
            '/contact',
            0.07 * reach,
            color=(179, 0, 27),
            opacity=0.6,
            position=joints[k],
            visible=felt is not None,
        )
        scene.add_label(
            '/contact/text',
            contact_of(self._arm.chain.joints, now),
            position=(0.0, 0.0, 0.1 * reach),
            visible=felt is not None,
        )

    def plot(self, past: Sequence[Snapshot]) -> None:
        """Draw these snapshots in the plots, with a caption of the last one."""
        now = past[-1]
        shown = (each for each in past if each.time > now.time - PAST)
        of = Snapshot._make(map(np.array, zip(*shown, strict=True)))  # arrays over time
        t: Floats = np.array(of.time)
        with np.errstate(divide='ignore', invalid='ignore'):
            share = 100.0 * np.abs(of.error / of.bound).T
            curves = (
                np.vstack((_peaks(share), np.full(t.size, 100.0))),
                of.torque.T,
                *([np.array(of.external).T] if self._shows_contact else []),
                shares(of.squares, _PEAK),
                weights(np.array(of.load)),
            )
        marks = [e[0] for e in self.listed if t[0] <= e[0] <= t[-1]]
        with self.server.atomic():
            for plot, values in zip(self.plots, curves, strict=True):
                plot.data = with_marks(t, values, marks)
            self.caption.content = caption(now, contact_of(self._arm.chain.joints, now))

    def _aim(self, camera: Any, width: float = inf) -> None:
        """Point a camera at the arm, which then fills a picture of this width [px]."""
        if self._corners is None:
            return
        low = self._corners.min(axis=0)
        high = self._corners.max(axis=0)
        centre = 0.5 * (low + high)
        size = float(np.linalg.norm(high - low))
        if width <= _NARROW:  # the lower half is covered
            centre = centre - (0.0, 0.0, 0.4 * size)
            size = 1.7 * size
        camera.position = centre + 1.15 * size * _VIEW
        camera.look_at = centre

    def _welcome(self, client: Any) -> None:
        # the browser begins with the common camera, at some time
        for pause in (0.0, _SETTLED):
            time.sleep(pause)
            self._aim(client.camera, client.camera.image_width)

    def _aim_all(self) -> None:
        self._aim(self.server.initial_camera)
        for client in self.server.get_clients().values():
            self._aim(client.camera, client.camera.image_width)

    def _posture(self, q: Floats) -> dict[str, float]:
        return self._held | dict(zip(self._joints, q.tolist(), strict=True))

    def _at(self, placement: Floats) -> Floats:
        """Return the origins (..., 3) of placements in the frame of the URDF's root."""
        at: Floats = placement[..., :3, 3] @ self._base[:3, :3].T + self._base[:3, 3]
        return at

    def close(self) -> None:
        """Stop the server."""
        with redirect_stdout(io.StringIO()):  # hides its message
            self.server.stop()


def _shortened(joints: Sequence[str]) -> tuple[str, Sequence[str]]:
    """Return what all names begin with, and what is left of each: a legend has little room."""
    prefix = os.path.commonprefix(joints).rstrip('0123456789')  # noqa: RUF071 - of characters
    rest = [name.removeprefix(prefix) for name in joints]
    return (prefix, rest) if all(rest) and prefix else ('joints', joints)


def _peaks(values: Floats) -> Floats:
    """Return the largest of the last values (n, k) up to each."""
    padded = np.pad(values, ((0, 0), (_PEAK - 1, 0)), mode='edge')
    peaks: Floats = np.fmax.reduce(
        [padded[:, j : j + values.shape[1]] for j in range(_PEAK)]
    )
    return peaks


def with_marks(t: Floats, curves: Floats, marks: Sequence[float]) -> tuple[Floats, ...]:
    """Return times (k,), curves (c, k) and a line at each mark, as rows of a plot.

    uPlot draws no line through NaN, and no axis: unknown values are put below the axis.
    """
    known = np.where(np.isfinite(curves), curves, -1.0)
    at = np.repeat(np.searchsorted(t, marks), 3)
    line = np.insert(np.full(t.size, -1.0), at, (-1.0, 1.0, -1.0) * len(marks))
    held = known[:, np.maximum(at - 1, 0)]
    return (
        np.insert(t, at, np.repeat(marks, 3)),
        *np.insert(known, at, held, axis=1),
        line,
    )


def weights(load: Floats) -> Floats:
    """Return the load and its 95 % interval (3, k) [kg] from LOAD (k, 8)."""
    mass = load[:, 0]
    half = load[:, 4]
    return np.vstack((mass, mass - half, mass + half))

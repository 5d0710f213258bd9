# SPDX-License-Identifier: Apache-2.0
"""The page: 3D view of the arm, plots, tables and events, drawn from moments of any source.

viser serves the page with everything that the browser needs: nothing is loaded from elsewhere.
"""

from __future__ import annotations

import contextlib
import io
from collections import deque
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from blf_dsc_controller.analysis.style import ALARM, COLOURS, GREEN, MUTED, ORANGE
from blf_dsc_controller.arms.chain_geometry import frames, tip_radius
from blf_dsc_controller.run import Floats
from blf_dsc_controller.view.address import free_port, require_viser, url_of
from blf_dsc_controller.view.arm import ShownArm
from blf_dsc_controller.view.moment import Moment
from blf_dsc_controller.view.tables import estimate_table, event_table, joint_table

PAST = 20.0
"""Time span of the plots [s]."""

_TRAIL = 4.0  # s of the tip's path
_EVENTS = 12
_PLAIN = (86, 110, 150)  # colour of an arm without any
_GHOST = (0, 200, 120, 0.35)
_HALO = 0.005  # thickness relative to the reach
_LEVELS = {'OK': GREEN, 'WARN': ORANGE, 'ERROR': ALARM, 'STALE': MUTED, 'BAG': MUTED}


class Page:
    """Page at a host, on the first free port from the given one on.

    Raises:
        MissingExtraError: viser is not installed.
        BlfDscError: the page cannot be served there.

    Attributes:
        server: the viser server.
    """

    def __init__(self, host: str, port: int) -> None:
        require_viser()
        import viser

        free = free_port(host, port)
        with contextlib.redirect_stdout(io.StringIO()):  # hides its banner
            self.server = viser.ViserServer(host, free, label='blf_dsc', verbose=False)
        self.url = url_of(host, self.server.get_port())
        self._events: deque[tuple[float, str, str]] = deque(maxlen=_EVENTS)
        self._state = 'STALE', ''
        self.clear()

    def clear(self) -> None:
        """Show only the state until `draw_arm` is called."""
        server, gui = self.server, self.server.gui
        self._list: Any = None
        server.scene.reset()
        gui.reset()
        gui.configure_theme(show_logo=False, show_share_button=False, control_width='large')
        gui.main_panel.dock_right()
        server.scene.configure_default_lights(cast_shadow=False)  # costly without a GPU
        self._header = gui.add_html('')
        self.state(*self._state)

    def draw_arm(self, arm: ShownArm, estimates: Mapping[str, str]) -> Any:
        """Draw an arm, given the units of its estimates by name; return the page's tabs."""
        from trimesh import Trimesh
        from viser.extras import ViserUrdf

        self._arm, self._units = arm, dict(estimates)
        self._joints = [joint.name for joint in arm.chain.joints]
        self._deviation = self._prior = np.full(len(estimates), np.nan)
        server, gui, reach = self.server, self.server.gui, arm.reach
        model = arm.model()
        self._held = dict.fromkeys(model.actuated_joint_names, 0.0)
        colour = None if 'rgba' in arm.text or '<mesh' in arm.text else _PLAIN
        self._drawn = ViserUrdf(server, model, root_node_name='/arm', mesh_color_override=colour)
        ghost = arm.model()
        shapes = ghost.scene.geometry
        for name, shape in list(shapes.items()):  # a shell around the arm where both coincide
            corners = shape.vertices + _HALO * reach * shape.vertex_normals
            shapes[name] = Trimesh(corners, shape.faces, process=False)
        self._ghost = ViserUrdf(
            server, ghost, root_node_name='/reference', mesh_color_override=_GHOST
        )
        base = np.array(model.get_transform(arm.chain.base))
        self._base = base
        floor = min(0.0, -reach if _hangs(arm) else 0.0)
        server.scene.add_grid(
            '/floor', 4 * reach, 4 * reach, cell_size=0.25, position=(0, 0, floor)
        )
        server.initial_camera.position = tuple(np.array((0.45, -1.05, 0.5)) * reach)
        server.initial_camera.look_at = (0.15 * reach, 0.0, 0.28 * reach)
        tabs = gui.add_tab_group()
        with tabs.add_tab('Plots'):
            self._plots = [
                self._plot('tracking error [% of the bound]', self._joints, ('bound',), 110.0),
                self._plot('torque [N m]', self._joints, ()),
                self._plot('estimates minus truth [% of the prior]', tuple(estimates), (), 100.0),
                self._plot('excitation: log10 of lambda_min', ('lambda_min',), ()),
            ]
            self._table = gui.add_html('')
        with tabs.add_tab('Estimates'):
            self._estimates = gui.add_html('')
        with tabs.add_tab('Events'):
            self._list = gui.add_html('')
        self.event(np.nan, '', '')
        return tabs

    def _plot(
        self, title: str, names: Sequence[str], limits: Sequence[str], span: float = 0.0
    ) -> Any:
        lines: list[Any] = [{'label': 's'}]
        lines += [
            {'label': name, 'stroke': COLOURS[k % len(COLOURS)], 'width': 1.5, 'points': _NO_POINTS}
            for k, name in enumerate(names)
        ]
        edge = {'stroke': ALARM, 'width': 1.0, 'dash': [6, 4], 'points': _NO_POINTS}
        lines += [{'label': sign + name, **edge} for name in limits for sign in '+-']
        scales: Any = {'x': {'time': False}}
        if span:
            scales['y'] = {'range': (-span, span)}
        empty = (np.zeros(1),) * len(lines)
        return self.server.gui.add_uplot(
            empty, tuple(lines), title=title, scales=scales, legend={'show': False}, height=150
        )

    def state(self, level: str, text: str) -> None:
        """Show the controller's state: level (OK, WARN, ERROR, STALE or BAG) and description."""
        self._state = level, text
        self._header.content = (
            f'<div style="margin:4px 12px;padding:6px 10px;border-radius:6px;color:white;'
            f'background:{_LEVELS[level]}"><b>{level}</b> {escape(text)}</div>'
        )

    def notify(self, title: str, text: str) -> None:
        """Show a message in each open page."""
        for client in self.server.get_clients().values():
            client.add_notification(title, text, color='red', auto_close_seconds=15.0)

    def event(self, time: float, kind: str, text: str) -> None:
        """Add an event at a time [s] to the list."""
        if kind:
            self._events.append((time, kind, text))
        if self._list is not None:
            self._list.content = event_table(reversed(self._events))

    def events(self, events: Sequence[tuple[float, str, str]]) -> None:
        """Replace the list with the last of these events."""
        if list(self._events) != list(events[-_EVENTS:]):
            self._events.clear()
            self._events.extend(events)
            self.event(np.nan, '', '')

    def learned(self, prior: Floats, deviation: Floats) -> None:
        """Set the standard deviations (m,) of the estimates before and after the window."""
        self._prior, self._deviation = prior, deviation

    def move(self, past: Sequence[Moment]) -> None:
        """Move the arm to the last of these moments."""
        now = past[-1]
        chain, reach, scene = self._arm.chain, self._arm.reach, self.server.scene
        with self.server.atomic():
            self._drawn.update_cfg(self._posture(now.position))
            tip = self._at(frames(chain, now.position)[-1])
            reference = now.position - now.error
            if np.isfinite(reference).all():
                self._ghost.update_cfg(self._posture(reference))
                if np.isfinite(now.bound).all():
                    radius = tip_radius(chain, reference, now.bound)
                    at = self._at(frames(chain, reference)[-1])
                    scene.add_icosphere(
                        '/bound', radius, color=(230, 159, 0), opacity=0.35, position=at
                    )
            scene.add_icosphere(
                '/payload', 0.045 * reach, color=(213, 94, 0), position=tip, visible=now.loaded
            )
            recent = np.array([one.position for one in past if one.time > now.time - _TRAIL])
            if len(recent) > 1:
                path = self._at(frames(chain, recent)[-1])
                points = np.stack((path[:-1], path[1:]), axis=1)
                scene.add_line_segments(
                    '/path', points, (0, 114, 178), thickness=3.0, thickness_units='screen'
                )

    def plot(self, past: Sequence[Moment]) -> None:
        """Draw these moments in the plots, and the last one in the tables."""
        now = past[-1]
        shown = [one for one in past if one.time > now.time - PAST]
        t = np.array([one.time for one in shown])
        edge = np.full(t.size, 100.0)
        error = np.array([100.0 * one.error / one.bound for one in shown]).T
        torque = np.array([one.torque for one in shown]).T
        off = np.array([100.0 * (one.estimate - np.nan_to_num(one.truth)) for one in shown]).T
        with np.errstate(divide='ignore', invalid='ignore'):
            excitation = np.log10(np.array([[one.lambda_min for one in shown]]))
            curves = error, torque, off / self._prior[:, np.newaxis], excitation
        with self.server.atomic():
            for plot, values in zip(self._plots, curves, strict=True):
                edges = (edge, -edge) if plot is self._plots[0] else ()
                plot.data = (t, *(np.where(np.isfinite(v), v, np.nan) for v in values), *edges)
            self._table.content = joint_table(self._joints, now)
            deviations = self._prior, self._deviation
            self._estimates.content = estimate_table(self._units, now, *deviations)

    def _posture(self, q: Floats) -> dict[str, float]:
        return self._held | dict(zip(self._joints, q.tolist(), strict=True))

    def _at(self, placement: Floats) -> Floats:
        """Transform the origins (..., 3) of placements from the base to the root of the URDF."""
        at: Floats = placement[..., :3, 3] @ self._base[:3, :3].T + self._base[:3, 3]
        return at

    def close(self) -> None:
        """Stop the server."""
        with contextlib.redirect_stdout(io.StringIO()):  # hides its message
            self.server.stop()


_NO_POINTS = {'show': False}


def _hangs(arm: ShownArm) -> bool:
    """Return whether the links turn in a vertical plane, also below their base."""
    return not any(joint.placement[2, 3] for joint in arm.chain.joints)

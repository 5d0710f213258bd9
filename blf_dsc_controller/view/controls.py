# SPDX-License-Identifier: Apache-2.0
"""Buttons and sliders of the live page; the node implements their actions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any, Protocol

import numpy as np

from blf_dsc_controller.analysis.style import GREEN, MUTED
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import Kind, Parameter, Value, flatten, parameters
from blf_dsc_controller.law.telemetry import load_text
from blf_dsc_controller.run import Floats
from blf_dsc_controller.view.moment import Moment

_GAINS = ('barrier', 'surface', 'feedback', 'disturbance', 'torque', 'learning')
_OF_OTHER_LAWS = ('comparison',)
_HEADROOM = 4.0  # end of a slider without a limit, as a multiple of the current value
_STEPS = 400


class Actions(Protocol):
    """Actions of the controls, called in threads of the page's server."""

    def reset(self) -> None:
        """Reset the arm and its controller."""

    def push(self, torque: Sequence[float]) -> None:
        """Push the joints briefly by these torques [N m]."""

    def payload(self, mass: float) -> None:
        """Attach a mass [kg] to the tip."""

    def go_to(self, position: Mapping[str, float], duration: float) -> None:
        """Send a reference to a position of each joint [rad], reached after `duration` [s]."""

    def set_gain(self, name: str, value: Value) -> None:
        """Set a parameter of the controller."""


class Controls:
    """The tabs `Try` and `Gains` of a page.

    Attributes:
        buttons: by their label.
        sliders: by the name of the gain, one for each entry.
    """

    def __init__(
        self, gui: Any, tabs: Any, config: ControllerConfig, actions: Actions, *, simulated: bool
    ) -> None:
        self._gui, self._actions = gui, actions
        self.buttons: dict[str, Any] = {}
        self.sliders: dict[str, list[Any]] = {}
        with tabs.add_tab('Try'):
            self._button('Reset', actions.reset, 'return to the start, forget what was learned')
            if simulated:
                self._add_disturbances(config.joints)
            self._add_reference(config)
        values = flatten(config)
        with tabs.add_tab('Gains'):
            for group in (*_GAINS, *(_OF_OTHER_LAWS if config.law not in _OWN else ())):
                shown = [one for one in live_gains() if one.name.startswith(f'{group}.')]
                with gui.add_folder(group, expand_by_default=group == 'feedback'):
                    for one in shown:
                        self._add_gain(one, values[one.name], config.joints)

    def show(self, changed: Mapping[str, Value]) -> None:
        """Move the sliders of these parameters to the values in force."""
        for name, value in changed.items():
            for slider, entry in zip(self.sliders.get(name, ()), _entries(value), strict=False):
                slider.max = max(slider.max, entry)
                slider.value = entry

    def _button(self, label: str, action: Callable[[], None], hint: str) -> None:
        button = self.buttons[label] = self._gui.add_button(label, hint=hint)
        button.on_click(lambda _: action())

    def _add_disturbances(self, joints: Sequence[str]) -> None:
        joint = self._gui.add_dropdown('joint', tuple(joints), hint='joint to push')
        torque = self._gui.add_slider('push [N m]', -10.0, 10.0, 0.1, 2.0)
        self._button(
            'Push',
            lambda: self._actions.push([torque.value * (one == joint.value) for one in joints]),
            'push this joint with this torque for half a second',
        )
        mass = self._gui.add_slider('payload [kg]', 0.0, 5.0, 0.05, 0.5)
        self._button('Pick up', lambda: self._actions.payload(mass.value), 'attach this payload')
        self._button('Put down', lambda: self._actions.payload(0.0), 'remove the payload')

    def _add_reference(self, config: ControllerConfig) -> None:
        limits = zip(config.limits.position_lower, config.limits.position_upper, strict=True)
        offset = config.reference.offset
        sliders = {}
        for k, (joint, (low, high)) in enumerate(zip(config.joints, limits, strict=True)):
            at = min(max(offset[k] if k < len(offset) else 0.0, low), high)
            sliders[joint] = self._gui.add_slider(f'{joint} [rad]', low, high, 0.001, at)
        duration = self._gui.add_slider('in [s]', 0.5, 20.0, 0.1, 4.0)
        self._button(
            'Go there',
            lambda: self._actions.go_to(
                {joint: one.value for joint, one in sliders.items()}, duration.value
            ),
            'move there and stay; Reset returns to the configured reference',
        )

    def _add_gain(self, one: Parameter, value: Value, joints: Sequence[str]) -> None:
        entries = _entries(value)
        names = joints if one.kind.is_array else ('',)
        low = one.above if one.at_least is None else one.at_least
        high = one.below if one.at_most is None else one.at_most
        top = high or _HEADROOM * max((*entries, 0.0)) or 1.0
        step = top / _STEPS
        bottom = step if one.above is not None else low or 0.0
        unit = f' [{one.unit}]' if one.unit else ''
        label = one.name.rsplit('.', 1)[-1]
        limit = f'; {one.allowed}' if one.allowed else ''
        sliders = self.sliders[one.name] = []
        for name, entry in zip(names, entries, strict=True):
            slider = self._gui.add_slider(
                f'{label} {name}{unit}',
                min(bottom, entry),
                top,
                step,
                entry,
                hint=f'{one.symbol or one.name}: {one.description}{limit}',
            )
            sliders.append(slider)

        def changed(event: Any) -> None:
            if event.client is not None:  # moved by hand, not by `show`
                given = tuple(float(slider.value) for slider in sliders)
                self._actions.set_gain(one.name, given if one.kind.is_array else given[0])

        for slider in sliders:
            slider.on_update(changed)


def live_gains() -> Iterable[Parameter]:
    """Yield the controller's gains, scalar or per joint, that can change while it runs."""
    for one in parameters(ControllerConfig):
        scalar = one.kind is Kind.DOUBLE
        if not one.read_only and (scalar or one.length == ('joints',)):
            yield one


def _entries(value: Any) -> tuple[float, ...]:
    return tuple(value) if isinstance(value, tuple) else (value,)


_OWN = ('blf_dsc', 'model_based')

_NOT_SHOWN = 0.5  # share of the prior's deviation above which an estimate is not identified
_CELL = 'padding:1px 4px;text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums'


def joint_table(joints: Sequence[str], now: Moment) -> str:
    """Return the table of error, bound, torque and limit by joint."""
    head = _row('th', f't = {now.time:.2f} s', 'error [mrad]', 'bound', 'torque [N m]', 'limit')
    columns = 1e3 * now.error, 1e3 * now.bound, now.torque, now.torque_limit
    rows = zip(joints, *columns, strict=True)
    table = _in_table([head, *(_row('td', escape(n), *map(_figure, row)) for n, *row in rows)])
    known = np.isfinite(now.load[0])
    return table + (f'<div style="{_CELL}">held: {load_text(now.load)}</div>' if known else '')


def estimate_table(units: Mapping[str, str], now: Moment, prior: Floats, deviation: Floats) -> str:
    """Return the table of estimates; `prior` and `deviation` are standard deviations (m,)."""
    rows = [_row('th', 'estimate', '', '±', 'truth', 'known')]
    columns = now.estimate, deviation, now.truth, deviation / prior
    for name, unit, value, spread, truth, left in zip(units, units.values(), *columns, strict=True):
        figures = (f'{x:.3g}' if np.isfinite(x) else '-' for x in (value, spread, truth))
        label = f'{escape(name)} <span style="opacity:0.6">{unit}</span>'
        rejected = not np.isfinite(value)
        bar = 'rejected' if rejected else _bar(1.0 - left)
        rows.append(_row('td', label, *figures, bar, pale=rejected or left > _NOT_SHOWN))
    return _in_table(rows)


def event_table(events: Iterable[tuple[float, str, str]]) -> str:
    """Return the table of events: time [s], kind and text."""
    return _in_table(
        f'<tr><td style="{_CELL}">{t:.2f} s</td><td><b>{escape(k)}</b> {escape(e)}</td></tr>'
        for t, k, e in events
    )


def _figure(value: float) -> str:
    return f'{value:.4g}' if np.isfinite(value) else '-'


def _row(tag: str, *cells: str, pale: bool = False) -> str:
    style = _CELL + (';opacity:0.55' if pale else '')
    return '<tr>' + ''.join(f'<{tag} style="{style}">{cell}</{tag}>' for cell in cells) + '</tr>'


def _bar(share: float) -> str:
    percent = 100.0 * min(max(float(np.nan_to_num(share)), 0.0), 1.0)
    colour = GREEN if share > 1.0 - _NOT_SHOWN else MUTED
    fill = f'linear-gradient(to right,{colour} {percent:.0f}%,transparent 0)'
    return f'<div style="width:40px;border:1px solid #bbb;background:{fill}">&nbsp;</div>'


def _in_table(rows: Iterable[str]) -> str:
    return f'<table style="font-size:11px;margin:4px">{"".join(rows)}</table>'

# SPDX-License-Identifier: Apache-2.0
"""What `/diagnostics` says about a controller: its state, loop, learning and load."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.control.log import Log
from blf_dsc_controller.control.motion_input import MotionInput
from blf_dsc_controller.factory.estimate import estimate_names
from blf_dsc_controller.law.contact import is_touched
from blf_dsc_controller.law.perception import DISTANCE
from blf_dsc_controller.messages.named_values import load_text
from blf_dsc_controller.messages.topics import LOAD, PHASE, REASON, REJECTED, STOPS
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.stop_cause import chatter_of
from blf_dsc_controller.supervision.supervisor import Phase, Supervisor

# Levels of diagnostic_msgs/msg/DiagnosticStatus.
OK = b'\x00'
WARN = b'\x01'
ERROR = b'\x02'
STALE = b'\x03'

_PHASES = {
    Phase.INACTIVE: (STALE, 'not in command'),
    Phase.STARTING: (WARN, 'waiting for a joint state to start from'),
    Phase.APPROACHING: (OK, 'approaching the reference'),
    Phase.TRACKING: (OK, 'tracking'),
    Phase.SAFE_STOP: (ERROR, 'stopped'),
}
_NOTABLE = 0.1  # relative to the largest component


class Part(NamedTuple):
    """Status of a part of a controller."""

    name: str
    level: bytes
    message: str
    values: Mapping[str, Any]


class StatusReport:
    """The parts of a controller's status.

    Attributes:
        trajectories: counts accepted and rejected trajectories; None: nobody sends any.
    """

    def __init__(self, log: Log) -> None:
        """Warn, once, of a torque that chatters."""
        self._rejected: Mapping[str, str] = {}
        self._columns = b''  # by which they are
        self.trajectories: MotionInput | None = None
        self._log = log
        self._has_warned = False

    def parts(
        self, lifecycle: str, guard: Guard | None, others: int = 0, missing: str = ''
    ) -> list[Part]:
        """Return the parts, first the state.

        Args:
            lifecycle: state of the node.
            guard: None while the node is not configured.
            others: other publishers of torques.
            missing: what is wrong with the node torque_watchdog; empty if nothing is.
        """
        parts = [self._state(lifecycle, guard)]
        if guard is not None:
            parts += [self._loop(guard, others, missing), self._learning(guard)]
            if guard.controller.settings.payload.size:
                parts.append(_load(guard))
            if guard.config.contact.enabled:
                parts.append(_contact(guard))
        return parts

    def rejected(self, guard: Guard) -> Mapping[str, str]:
        """Return disturbance columns that are not estimated, and why; another object if changed."""
        latch = guard.controller.state.latch
        columns = latch.active.tobytes() + latch.columns_checked.tobytes()
        if columns != self._columns:
            self._columns = columns
            self._rejected = _rejected_columns(guard)
        return self._rejected

    def _state(self, lifecycle: str, guard: Guard | None) -> Part:
        supervisor = guard.supervisor if guard else Supervisor()
        level, message = _PHASES[supervisor.phase]
        values: dict[str, Any] = {PHASE: supervisor.phase, REASON: supervisor.reason}
        values['lifecycle'] = lifecycle
        if guard is None:
            message = 'not configured'
        else:
            values[STOPS] = supervisor.stops
            values['safe torque'] = guard.config.safety.torque
        if supervisor.text:
            message += f': {supervisor.text}'
        return Part('state', level, message, values)

    def _loop(self, guard: Guard, others: int, missing: str) -> Part:
        values = self._loop_values(guard)
        if others:
            return Part('loop', ERROR, 'another node commands torques, too', values)
        if message := missing or _unusual(guard):
            return Part('loop', WARN, message, values)
        if chatter := chatter_of(guard.controller, guard.config):
            self._warn_once(chatter)
            return Part('loop', WARN, chatter, values)
        return Part('loop', OK, _PHASES[guard.supervisor.phase][1], values)

    def _loop_values(self, guard: Guard) -> dict[str, Any]:
        """Return counts of states and samples, cuts of the torque, and oscillations."""
        states, samples, last = guard.states, guard.samples, guard.oscillation.last
        cuts = guard.controller.state.saturation
        off = f'off: {guard.watchdog.why_off}'.removesuffix(': ')
        return {
            'samples': guard.controller.samples,
            'repeated states ignored': states.repeated,
            'samples outside the bound': samples.outside,
            'largest error against the bound': f'{samples.ratio.max():.3g}',
            **_at_tool(guard),
            'states missed': states.missed,
            'samples with a torque at its limit': samples.saturated,
            'messages for other joints': guard.foreign,
            'watchdog on the steady clock': 'on' if guard.watchdog.on else off,
            'samples cut by the torque limit': _by_joint(guard, cuts.level_cuts),
            'samples cut by the torque rate limit': _by_joint(guard, cuts.rate_cuts),
            'last oscillation': last.text if last else 'none',
            'torque sensors': guard.findings.untrusted or 'none or as configured',
            **(self.trajectories.values if self.trajectories else {}),
        }

    def _warn_once(self, chatter: str) -> None:
        if not self._has_warned:
            self._has_warned = True
            self._log.warning(chatter)

    def _learning(self, guard: Guard) -> Part:
        state = guard.controller.state
        learning = 'latched' if state.latch.latched[0] else 'not yet excited'
        values = {
            'lambda_min': f'{state.latch.lambda_min[0]:.3g}',
            'learning': learning,
        }
        values['model changes'] = f'{state.change.changes[0]:.0f}'
        rejected = self.rejected(guard)
        values |= {f'{REJECTED}{column}': why for column, why in rejected.items()}
        if rejected:
            message = f'not estimated: {", ".join(rejected)}'
            return Part('learning', WARN, message, values)
        return Part('learning', OK, learning, values)


def _unusual(guard: Guard) -> str:
    """Return what is unusual about the last sample, the most important first; or empty."""
    samples = guard.samples
    if samples.outside:
        return 'the error has left its bound'
    if guard.oscillation.is_ongoing(guard.reference.time):
        return guard.oscillation.text
    if guard.findings.untrusted:
        return guard.findings.untrusted
    limited = ''
    if samples.saturated_time > 0.0:
        limited = 'torque'
    elif guard.has_sample and guard.controller.sample.cuts.any():
        limited = 'torque rate'
    if not limited:
        return ''
    return f'{limited} at its limit: adaptation by the tracking error is frozen'


def _at_tool(guard: Guard) -> Mapping[str, str]:
    errors = guard.samples.tool_errors
    if errors is None:
        return {}
    error, bound, angle, angle_bound = (1e3 * errors).tolist()
    return {
        'error at the tool': f'{error:.3g} of {bound:.3g} mm',
        'angle at the tool': f'{angle:.3g} of {angle_bound:.3g} mrad',
    }


def _load(guard: Guard) -> Part:
    load = guard.controller.sample.load.tolist()
    values = {name: f'{value:.6g}' for name, value in zip(LOAD, load, strict=True)}
    return Part('load', OK, f'held: {load_text(load)}', values)


def _contact(guard: Guard) -> Part:
    """Return whether something touches the arm, and what did last."""
    last = guard.findings.contacts.last
    values: dict[str, Any] = {
        'contacts': guard.findings.contacts.count,
        'distance': f'{guard.controller.sample.contact[DISTANCE]:.3g}',
        'threshold': f'{guard.config.contact.threshold:g}',
        'tared': str(guard.controller.is_tared).lower(),
    }
    if last is not None:
        unit = guard.config.units[guard.config.joints.index(last.joint)].torque
        values |= {
            'last contact': f'at {(last.stamp - guard.reference.start_stamp) * 1e-9:.3f} s',
            'joint': last.joint,
            'external torque': f'{last.torque:+.3g} {unit}',
            'model error and noise': f'{last.interval:.3g} {unit}',
        }
    if not guard.supervisor.running:
        return Part('contact', OK, 'not monitored: the law is not in command', values)
    if last is not None and is_touched(guard.controller.state.contact):
        return Part('contact', WARN, last.text, values)
    return Part('contact', OK, 'nothing touches the arm', values)


def _by_joint(guard: Guard, counts: np.ndarray) -> str:
    pairs = zip(guard.config.joints, counts, strict=True)
    return (
        ', '.join(f'{joint} {count:.0f}' for joint, count in pairs if count) or 'none'
    )


def _rejected_columns(guard: Guard) -> dict[str, str]:
    """Return why a law that learns does not estimate columns, by their names.

    Each resembles a combination of others in the current window; these are named,
    largest first.
    """
    names = estimate_names(guard.config)
    state, reasons = guard.controller.state, {}
    upper = np.triu(state.window.running[:-1, :-1])
    Phi = upper + np.triu(upper, 1).T
    kept = np.flatnonzero(state.latch.active > 0.0)
    for column in np.flatnonzero(state.latch.active == 0.0).tolist():
        products = Phi[kept, column]
        parts = np.linalg.lstsq(Phi[np.ix_(kept, kept)], products, rcond=None)[0]
        strength = np.abs(parts) * np.sqrt(np.diag(Phi)[kept])
        order = kept[np.argsort(-strength)].tolist()
        alike = [
            names[k] for k in order[: np.sum(strength >= _NOTABLE * strength.max())]
        ]
        explained = float(np.clip(parts @ products / Phi[column, column], 0.0, 1.0))
        reasons[names[column]] = (
            f'{names[column]} is not estimated: this window cannot distinguish it from '
            f'{" + ".join(alike)} ({100 * explained:.4g} % of it is explained by them). '
            'A reference with more tones can separate them; learning.excitation_threshold sets '
            'how clearly'
        )
    return reasons

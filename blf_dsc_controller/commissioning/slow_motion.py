# SPDX-License-Identifier: Apache-2.0
"""A slow motion that does not repeat: its torques show the torque ripple of the drives.

A ripple returns at the same positions.  Where a motion repeats, so does whatever friction, drives
and model err by, and each N of a ripple fits some of it: of random FR3s without ripple, most show
some in 15 s of a motion of 5 s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.commissioning.planned import FROM_LIMITS
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import Value, change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.reference.approach import reference_of
from blf_dsc_controller.reference.terms import sampled

Floats = NDArray[np.float64]

SECONDS = 60.0
"""Time [s] in which such a motion shows the ripple of most joints."""

_PACE = 0.5  # of the tones
_APART = 0.3  # by which the pace of tones differs at most
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)  # whose multiples have no period
_MORE = 0.5  # s of a run, than the time that counts
_STEP = 0.01  # s, between the moments at which ranges are looked at


class SlowMotion(NamedTuple):
    """The motion of an arm with the gains of its configuration."""

    config: ControllerConfig
    posture: Floats  # (n,) rad, where it begins
    duration: float  # s
    ranges: Floats  # (2, n) rad, lowest and highest positions


def slow_frequencies(config: ControllerConfig) -> tuple[float, ...]:
    """Return `reference.frequency` [rad/s] of half the pace, of tones with no period.

    Joints meet at other positions, and each tone of a joint keeps its amplitude: together they
    may go farther than those of the reference.  Empty, unless it is a sum of sinusoids.
    """
    if config.reference.type != 'sinusoids':
        return ()
    return _slowed(np.array(config.reference.frequency))


def slow_motion(config: ControllerConfig) -> SlowMotion:
    """Return the slow motion for a configuration.

    A joint whose limits are near moves less.  An oscillation or a contact stops the arm, whatever
    the configuration says.

    Raises BlfDscError if the reference is no sum of sinusoids.
    """
    if config.reference.type != 'sinusoids':
        raise BlfDscError(
            f'reference.type: got {config.reference.type}, but torque ripple is found along a slow '
            'motion made of the tones of sinusoids: give such a reference, or measure without '
            'ripple'
        )
    values: dict[str, Value] = {**_tones(config), 'safety.oscillation': 'stop'}
    if config.contact.reaction != 'none':
        values['contact.reaction'] = 'stop'
    slow = change(config, values)
    share = _share_within_limits(config, slow)
    if (share < 1.0).any():
        tones = np.reshape(slow.reference.amplitude, (share.size, -1))
        smaller = share[:, None] * tones
        slow = change(slow, {'reference.amplitude': smaller.ravel().tolist()})
    q = _positions(slow)
    ranges = np.array([q.min(axis=0), q.max(axis=0)])
    return SlowMotion(slow, q[0], SECONDS + _MORE, ranges)


def is_slow_motion(made: ControllerConfig, config: ControllerConfig) -> bool:
    """Whether a run with the configuration `made` is the slow motion for another one."""
    if config.reference.type != 'sinusoids':
        return False
    return made.reference == slow_motion(config).config.reference


def _slowed(rates: Floats) -> tuple[float, ...]:
    pace = _PACE * (1.0 + _APART * (_GOLDEN * np.arange(rates.size) % 1.0))
    return tuple(float(f'{rate:.3g}') for rate in pace * rates)


def _tones(config: ControllerConfig) -> dict[str, Value]:
    """Return the parameters of the slowed tones; a single one, which would repeat, becomes two."""
    reference = config.reference
    rates = np.array(reference.frequency)
    if rates.size > 1:
        return {'reference.frequency': _slowed(rates)}
    halves = np.repeat(0.5 * np.array(reference.amplitude), 2)
    return {
        'reference.frequency': _slowed(np.repeat(rates, 2)),
        'reference.amplitude': tuple(halves.tolist()),
        'reference.phase': 2 * reference.phase,
    }


def _share_within_limits(config: ControllerConfig, slow: ControllerConfig) -> Floats:
    """Return the share (n,) of a slow motion with which joints keep away from their limits.

    A reference that is nearer to them may be left as little as it leaves itself.
    """
    own, far = _positions(config), _positions(slow)
    away = np.array([FROM_LIMITS[units] for units in config.units])
    lowest = np.minimum(own.min(axis=0), np.array(config.limits.position_lower) + away)
    highest = np.maximum(own.max(axis=0), np.array(config.limits.position_upper) - away)
    middle = np.array(config.reference.offset)
    below, above = middle - far.min(axis=0), far.max(axis=0) - middle
    with np.errstate(divide='ignore', invalid='ignore'):
        shares = np.array([(middle - lowest) / below, (highest - middle) / above])
    return np.asarray(np.where(shares > 0.0, shares, 1.0).min(axis=0).clip(max=1.0))


def _positions(config: ControllerConfig) -> Floats:
    """Return the positions (k, n) [rad] of the reference over the time of a slow motion."""
    times = np.arange(0.0, SECONDS + _MORE, _STEP)
    return np.asarray(sampled(reference_of(config), times)[:, 0])

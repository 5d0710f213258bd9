# SPDX-License-Identifier: Apache-2.0
"""The motion that excites an arm: a sum of many tones, of which each belongs to one joint.

All joints move at once.  The period holds whole waves of every tone, so the spectrum of a
period has one line for each.  Lines of the joints alternate,

    f = (2 n k + j) / period      for joint j and some k,

so that close to each frequency there is one line of every joint: n experiments at once,
from which the whole matrix of responses follows.  What a period shows between these lines
is noise and friction, and tells how much of a response can be believed.

Torques are alike at all frequencies: a joint with inertia J moves by tau / (J omega^2).  Two
slow tones more move each joint a little.  Where it sticks nevertheless, friction hides and
damps its resonances: then its two tones more are swings of 4 Hz, which travel less than slower
ones of the same speed (`sliding`).  They cancel each other every `BEAT` seconds, so that an
arm which is softly held has no momentum where its run ends.

Phases are random, but for the start: positions, velocities and accelerations
begin at zero, so an arm at rest is not jerked.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.model import inertia_matrices
from blf_dsc_controller.arms.urdf import Chain, frames
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.errors import BlfDscError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_Shrink = Callable[[Floats, Floats], None]

SETTLING = 6.0
"""Time [s] from the start until the period that is looked at."""

SLOW_TONES = 2
"""The last tones of a joint, which keep it sliding."""

BEAT = 2.0
"""Time [s] between the moments at which the swings of all joints vanish."""

SLIDING = 0.1
"""Largest speed of the swings [rad/s]."""

OF_RATE = 0.35
"""Part of the sample rate, above which nothing is excited or looked for."""

_LINES = 80  # of each joint, at most
_SLOWEST, _FASTEST = 2.0, 120.0  # Hz
_SECONDS = 4.0  # of the period, for each joint
_SLOW, _SWING = 1.0, 4.0  # Hz, of slow tones and of swings
_LEAST_SWING = 0.05  # of slow tones, below which the lines shrink, too
_SPEED = 0.25  # of the limit of velocity
_RANGE = 0.8  # of the way to a limit of position; the rest is for errors
_SEED = 0
_NEWTON = 50  # steps at most
_AT_REST = 1e-12  # of the amplitude


class Excitation(NamedTuple):
    """Tones of a motion by joint, and how far it goes."""

    period: float  # s
    bins: Ints  # (n, K) of the spectrum of a period: lines of each joint
    slow: Ints  # (n, 2) likewise: slow tones, or swings, of all joints alike
    amplitude: Floats  # (n, K + 2) rad, of lines and slow tones
    phase: Floats  # (n, K + 2) rad
    travel: float  # m, of the tool from its middle
    speed: Floats  # (n,) rad/s, the largest
    acceleration: Floats  # (n,) rad/s^2, which none exceeds
    swing: Floats  # (n,) N m, torque of slow tones or swings at most, without friction
    sliding: bool  # with swings

    def reference(self, posture: Floats) -> dict[str, object]:
        """Return the parameters of the reference around a posture (n,) [rad].

        The first tone moves nothing: from its frequency `lines_in` takes the period.
        """
        n, lines = self.amplitude.shape
        bins = np.column_stack((self.bins, self.slow))
        amplitude = np.zeros((n, 1 + n * lines))
        for j in range(n):
            amplitude[j, 1 + j * lines : 1 + (j + 1) * lines] = self.amplitude[j]
        rates = 2.0 * np.pi / self.period * np.append(1, bins.ravel())
        return {
            'reference.type': 'sinusoids',
            'reference.offset': _listed(posture),
            'reference.amplitude': _listed(amplitude.ravel()),
            'reference.frequency': _listed(rates),
            'reference.phase': _listed(np.append(0.0, self.phase.ravel())),
        }


class Lines(NamedTuple):
    """Lines of the joints in the spectrum of a period."""

    period: float  # s
    bins: Ints  # (n, K)
    slow: Ints  # (n, 2) of slow tones or swings, which are neither lines nor noise

    @property
    def frequencies(self) -> Floats:
        """Frequencies (K,) [Hz]: the middle of the lines of all joints."""
        return np.asarray(self.bins.mean(axis=0) / self.period)


def lines_in(config: ControllerConfig) -> Lines:
    """Return the lines of the motion that a configuration has.

    Raises BlfDscError if it is none of those of a commissioning.
    """
    reference = config.reference
    n = len(config.joints)
    rates = np.array(reference.frequency)
    if reference.type != 'sinusoids' or rates.size < 4 * n + 1 or (rates.size - 1) % n:
        raise BlfDscError(_OTHER_MOTION)
    bins = rates[1:] / rates[0]
    if np.abs(bins - np.rint(bins)).max() > 1e-6:
        raise BlfDscError(_OTHER_MOTION)
    by_joint = np.rint(bins).astype(np.int64).reshape(n, -1)
    period = 2.0 * np.pi / float(rates[0])
    return Lines(period, by_joint[:, :-SLOW_TONES], by_joint[:, -SLOW_TONES:])


_OTHER_MOTION = (
    'the reference of this run is not the motion of a commissioning: run the parameters that '
    '`blf_dsc commission --write` writes'
)


def excitation(
    config: ControllerConfig,
    posture: Floats,
    share: float,
    travel: float,
    *,
    sliding: bool = False,
) -> Excitation:
    """Return the motion around a posture (n,) [rad] of an arm from a URDF.

    Its torques are `share` of the rated ones (rms), by the inertias of the URDF and
    `robot.rotor_inertia`.  They are less where the tool would travel farther than `travel` [m],
    or a joint would come near its limits, or be faster than a quarter of what it may.  With swings
    (`sliding`), the motion of each joint is made smaller by itself, swings and lines alike.
    """
    n = len(config.joints)
    period = _SECONDS * n
    bins = _bins(n, period, config.sample_time)
    slow = _swings(n, period) if sliding else _slow(n, period)
    chain = config.robot.chain(config.joints)
    inertia = _inertias(config, chain, posture)
    rated = config.robot.efforts(chain)
    lines = _by_torque(share, rated, inertia, bins, period)
    rates = 2.0 * np.pi / period * slow if sliding else 2.0 * np.pi * _SLOW
    swing = np.full(slow.shape, SLIDING / rates / SLOW_TONES)
    held = SLOW_TONES if sliding else 0
    shape = _Shape(np.column_stack((bins, slow)), period, held)
    room = _Room(
        chain=chain,
        posture=posture,
        most=travel,
        speed=_SPEED * np.array(config.limits.velocity),
        below=_RANGE * (posture - np.array(config.limits.position_lower)),
        above=_RANGE * (np.array(config.limits.position_upper) - posture),
    )
    shrink = _shrink_each if sliding else _shrink_all
    amplitude, moves = _shrunk(lines, swing, shape, room, shrink)
    accelerations = amplitude * shape.rates**2
    return Excitation(
        period=period,
        bins=bins,
        slow=slow,
        amplitude=amplitude,
        phase=moves.phase,
        travel=room.travel(moves),
        speed=moves.speed,
        acceleration=accelerations.sum(axis=1),
        swing=inertia * accelerations[:, -SLOW_TONES:].sum(axis=1),
        sliding=sliding,
    )


def _inertias(config: ControllerConfig, chain: Chain, posture: Floats) -> Floats:
    """Return the inertia (n,) [kg m^2] of each joint in a posture (n,) [rad], others at rest."""
    base = parameters_of(config.robot, chain)
    P = base.of(chain.inertias, config.robot.rotors(chain))
    return np.diagonal(inertia_matrices(base.model, P, posture[None])[0])


def _by_torque(
    share: float, rated: Floats, inertia: Floats, bins: Ints, period: float
) -> Floats:
    """Return amplitudes (n, K) [rad] of lines `bins` (n, K) by their torques.

    These are a `share` of `rated` (n,) [N m], and move `inertia` (n,) [kg m^2].
    """
    rate = 2.0 * np.pi / period * bins
    torque = share * rated / math.sqrt(0.5 * bins.shape[1])
    return np.asarray(torque[:, None] / (inertia[:, None] * rate**2))


def _shrunk(
    lines: Floats, swing: Floats, shape: _Shape, room: _Room, shrink: _Shrink
) -> tuple[Floats, _Moves]:
    """Return the amplitudes (n, K + 2) of a motion that has room, and how it moves."""
    factors = np.ones((len(lines), 2))  # of lines and of slow tones or swings
    while True:
        amplitude = np.column_stack((factors[:, :1] * lines, factors[:, 1:] * swing))
        moves = shape.motion(amplitude)
        excess = room.excess(moves)
        if not (excess > 1.0).any():
            return amplitude, moves
        shrink(factors, excess)


def _shrink_all(factors: Floats, excess: Floats) -> None:
    """Make slow tones smaller, of all joints alike; at last lines, too."""
    shrunk = slice(1, 2) if factors[0, 1] > _LEAST_SWING else slice(None)
    factors[:, shrunk] /= max(min(float(excess.max()), 2.0), 1.05)


def _shrink_each(factors: Floats, excess: Floats) -> None:
    """Make lines and swing of each joint smaller that exceeds (n,) something."""
    factors /= np.where(excess > 1.0, excess.clip(1.02, 2.0), 1.0)[:, None]


class _Moves(NamedTuple):
    """How an arm moves over a period."""

    phase: Floats  # (n, K) rad, of its tones
    moved: Floats  # (N, n) rad, from its posture
    speed: Floats  # (n,) rad/s, the largest


class _Room(NamedTuple):
    """How far and how fast an arm may move around a posture."""

    chain: Chain
    posture: Floats  # (n,) rad
    most: float  # m, travel of the tool
    speed: Floats  # (n,) rad/s
    below: Floats  # (n,) rad, downwards
    above: Floats  # (n,) rad, upwards

    def travel(self, moves: _Moves) -> float:
        """Return how far the tool moves from its middle [m]."""
        middle = frames(self.chain, self.posture)[-1][:3, 3]
        tips = frames(self.chain, self.posture + moves.moved)[-1][:, :3, 3]
        return float(np.linalg.norm(tips - middle, axis=1).max())

    def excess(self, moves: _Moves) -> Floats:
        """Return for each joint (n,) how many times more it moves than it may."""
        down, up = -moves.moved.min(axis=0), moves.moved.max(axis=0)
        of_range = np.maximum(down / self.below, up / self.above)
        of_speed = moves.speed / self.speed
        of_travel = self.travel(moves) / self.most
        return np.asarray(np.maximum(np.maximum(of_speed, of_range), of_travel))


class _Shape:
    """Motions of given lines (n, K), by their amplitudes."""

    def __init__(self, bins: Ints, period: float, held: int) -> None:
        """Use lines, of which the last `held` keep their phases."""
        self.rates = 2.0 * np.pi / period * bins  # rad/s
        self._bins = bins
        self._period = period
        self._held = held
        random = np.random.default_rng(_SEED)
        self._phase = random.uniform(0.0, 2.0 * np.pi, bins.shape)
        # the last two tones cancel each other at the start
        self._phase[:, -1] = self._phase[:, -2] + np.pi

    def motion(self, amplitude: Floats) -> _Moves:
        """Return the motion with these amplitudes (n, K) [rad]."""
        rows = zip(amplitude, self._bins, self._phase, strict=True)
        phase = np.array([_from_rest(*row, self._held) for row in rows])
        moved = _over_a_period(amplitude, phase, self._bins)
        rate = np.gradient(moved, self._period / len(moved), axis=0)
        return _Moves(phase, moved, np.abs(rate).max(axis=0))


def _bins(n: int, period: float, sample_time: float) -> Ints:
    """Return the lines (n, K) of the joints: half of the spectrum stays free, for noise."""
    fastest = min(_FASTEST, OF_RATE / sample_time)
    wanted = np.geomspace(_SLOWEST, fastest, _LINES) * period / (2 * n)
    middle = np.unique(np.rint(wanted).astype(np.int64))
    return np.asarray(2 * n * middle + np.arange(n)[:, None])


def _slow(n: int, period: float) -> Ints:
    """Return two slow tones of each joint (n, 2)."""
    first = round(_SLOW * period) - n + np.arange(n)
    return np.column_stack((first, first + 2 * n))


def _swings(n: int, period: float) -> Ints:
    """Return two tones, of all joints alike (n, 2), that are `BEAT` apart.

    They are odd multiples of n.  So are the tones that friction makes of them, since it is an odd
    function of speed; lines are none of these.
    """
    below = 2 * n * round(_SWING * period / (2 * n))
    return np.tile([below - n, below + n], (n, 1))


def _from_rest(amplitude: Floats, bins: Ints, phase: Floats, held: int) -> Floats:
    """Return phases near those given with which a joint begins at rest, in the middle.

    Position, velocity and acceleration at the start are zero, by Newton's method with
    the least change of the phases; those of the last `held` stay.
    """
    rates = bins / bins.max()
    weights = amplitude * np.stack((np.ones_like(rates), rates, rates**2))
    weights /= np.abs(weights).sum(axis=1, keepdims=True)
    turn = np.array([0.0, 0.5 * np.pi, 0.0])[:, None]
    for _ in range(_NEWTON):
        value = (weights * np.cos(phase + turn)).sum(axis=1)
        if np.abs(value).max() < _AT_REST:
            break
        slope = -weights * np.sin(phase + turn)
        slope[:, slope.shape[1] - held :] = 0.0
        phase = phase - np.linalg.lstsq(slope, value, rcond=None)[0]
    return phase


def _over_a_period(amplitude: Floats, phase: Floats, bins: Ints) -> Floats:
    """Return the motion (N, n) [rad] over a period, from the middle."""
    n = len(amplitude)
    count = 4 * (int(bins.max()) + 1)
    spectrum = np.zeros((count // 2 + 1, n), complex)
    for j in range(n):
        spectrum[bins[j], j] = amplitude[j] * np.exp(1j * phase[j])
    return np.asarray(np.fft.irfft(spectrum, count, axis=0) * (count / 2))


def _listed(values: Floats) -> list[float]:
    return [float(each) for each in np.asarray(values)]

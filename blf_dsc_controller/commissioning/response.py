# SPDX-License-Identifier: Apache-2.0
"""The responses of an arm in a posture, from torques sent to what its sensors measured.

In the closed loop, at the n lines around a frequency (`motion`), torques U and positions Y
(n, n) are spectra of n different motions, so

    Y = G_y U,   V = G_v U      G_y = Y U^-1  [rad/(N m)],   G_v = V U^-1  [rad/(s N m)]

whatever feedback was at work, and without a model.  Delays, drives, gears, motors and what
carries the arm are all in it.  The law acts on velocities as its driver measures or
filters them, so theirs are measured, too, and where it acts on efforts, those of efforts.

Gears have sharp resonances that may fall between two frequencies.  Where G_y peaks its
inverse is smooth, as are G_v G_y^-1 and G_e G_y^-1, so these are interpolated.  A peak
between two lines counts only if both lines show more of it than noise (`seen`).

Between the lines there is what the motion did not cause: noise, ripple, and what friction
makes of it.  A line has as much, which gives the standard deviation of each response.

A torque of joint j moves joint i as one of joint i moves joint j: the mass matrix is symmetric,
and so are G_y and G_v while gears are stiff, at low frequencies.  The one that is moved with
little torque says little about a strong joint; the other way round more is known.  So both have
the mean of both there, by their variances, unless they differ by more than noise (`shared`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.commissioning.motion import SETTLING, Lines
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import Run, Stamps

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

_MOST_LOST = 0.01  # of the samples of a period
_FINER = 4  # times as many frequencies as there are lines of a joint
DEVIATIONS = 2.0  # of noise, that count
# Hz, up to which G is symmetric: links that a motor of 20 Hz turns lag others by up to 0.6 there
_RECIPROCAL = 12.0
_BETWEEN = 3  # times n lines to either side, from which the noise is taken


class HiddenError(BlfDscError):
    """The positions do not show the motion at all."""


class Sensed(NamedTuple):
    """The response of efforts at the f frequencies of a `Response`."""

    effort: Complex  # G_e (f, n, n), N m/(N m)
    # (f, 2 n, 2 n) covariance of [E - G_e U; V - G_v U] beside the motion: what moves a link
    # shows in both
    noise: Complex


class Response(NamedTuple):
    """Responses in one posture, at f frequencies."""

    frequency: Floats  # (f,) Hz
    position: Complex  # G_y (f, n, n), rad/(N m)
    velocity: Complex  # G_v (f, n, n), rad/(s N m)
    # (f, n), rms of each sensor beside the motion: of Y - G_y U and V - G_v U
    position_noise: Floats  # rad
    velocity_noise: Floats  # rad/s
    columns: Floats  # (f, n) 1/(N m), size of the columns of U^-1
    shared: NDArray[np.bool_]  # (f, n, n) G_ij and G_ji are the mean of both
    posture: Floats  # (n,) rad, mean
    seen: NDArray[np.bool_]  # (f,) the rest may be noise that looks like a resonance
    speed: Floats  # (n,) rad/s, of all tones: mean square over mean
    friction: Floats  # (n,) N m, a constant one that takes the power of the slow tones
    sensed: Sensed | None = None  # None: the run has no efforts

    def deviations(self) -> tuple[Floats, Floats]:
        """Return the standard deviations (f, n, n) of G_y [rad/(N m)] and G_v [rad/(s N m)]."""
        own = (
            noise[:, :, None] * self.columns[:, None, :]
            for noise in (self.position_noise, self.velocity_noise)
        )
        position, velocity = (
            np.where(self.shared, each * np.sqrt(_weight(each)), each) for each in own
        )
        return position, velocity


def response_of(run: Run, lines: Lines, sample_time: float) -> Response:
    """Return the responses that a run of the motion shows.

    Raises BlfDscError if it has no whole period, too many samples are lost, or the
    positions do not show it.
    """
    rows = _period(run, lines.period, sample_time)
    _check_finite(run, rows)
    position = run.position[rows]
    U, Y, V = (
        _spectrum(each) for each in (run.torque[rows], position, run.velocity[rows])
    )
    at = lines.bins.T
    Y_at = _at_lines(Y, at)
    if (np.linalg.matrix_rank(Y_at) < Y_at.shape[-1]).any():
        raise HiddenError(
            'the positions do not show the motion: friction holds the arm, or it moves by less '
            'than a step of its encoders. Measure with a larger --torque and --travel'
        )
    inverse: Complex = np.asarray(np.linalg.inv(_at_lines(U, at)), complex)
    sent = _Sent(U, at, _between(lines, len(U)), inverse)
    G_y, G_v = sent.response(Y), sent.response(V)
    sensed = None
    if run.effort is not None and np.isfinite(run.effort[rows]).all():
        E = _spectrum(run.effort[rows])
        G_e = sent.response(E)
        both = np.concatenate((G_e, G_v), axis=1)
        sensed = Sensed(G_e, sent.covariance(np.hstack((E, V)), both))
    speed, friction = _rubbing(U, Y, lines)
    at_lines = Response(
        frequency=lines.frequencies,
        position=G_y,
        velocity=G_v,
        position_noise=sent.noise(Y, G_y),
        velocity_noise=sent.noise(V, G_v),
        columns=np.asarray(np.linalg.norm(inverse, axis=1)),
        shared=np.zeros(Y_at.shape, bool),
        posture=np.asarray(position.mean(axis=0)),
        seen=np.ones(len(lines.frequencies), bool),
        speed=speed,
        friction=friction,
        sensed=sensed,
    )
    return refined(reciprocal(at_lines))


class _Sent(NamedTuple):
    """The torques that were sent, and what they say of what was measured meanwhile."""

    U: Complex  # (N, n), spectrum
    at: NDArray[np.int64]  # (f, n), the lines of each motion in it
    between: NDArray[np.bool_]  # (N,), waves that no motion has
    inverse: Complex  # (f, n, n), U^-1 at the lines

    def response(self, measured: Complex) -> Complex:
        """Return the response G (f, m, n) that a spectrum (N, m) shows at the lines."""
        return np.asarray(_at_lines(measured, self.at) @ self.inverse)

    def noise(self, measured: Complex, response: Complex) -> Floats:
        """Return the rms (f, m) of what is measured between the lines beside G U."""
        rests = self._rests(measured, response)
        return np.array([np.sqrt((np.abs(rest) ** 2).mean(axis=0)) for rest in rests])

    def covariance(self, measured: Complex, response: Complex) -> Complex:
        """Return the covariance (f, m, m) of the same."""
        rests = self._rests(measured, response)
        return np.array([rest.T @ rest.conj() / len(rest) for rest in rests])

    def _rests(self, measured: Complex, response: Complex) -> Iterator[Complex]:
        """Yield for each line what is measured between the lines around it beside G U (r, m).

        That is as far around as it takes to have two such waves for each joint.
        """
        U, n = self.U, self.at.shape[1]
        for k, line in enumerate(self.at[:, 0]):
            reach = _BETWEEN * n
            while True:
                low, high = max(1, line - reach), min(len(U), line + n + reach)
                rows = low + np.flatnonzero(self.between[low:high])
                if rows.size >= 2 * n or reach > len(U):
                    break
                reach *= 2
            yield measured[rows] - U[rows] @ response[k].T


def _at_lines(spectrum: Complex, at: NDArray[np.int64]) -> Complex:
    """Return waves (f, m, n) of a spectrum (N, m): of each sensor by the line of each motion."""
    return np.asarray(np.swapaxes(spectrum[at], 1, 2))


def reciprocal(response: Response) -> Response:
    """Return a response, symmetric at low frequencies where it may be so."""
    deviations = response.deviations()
    measured = response.position, response.velocity
    n = response.columns.shape[1]
    shared = (response.frequency <= _RECIPROCAL)[:, None, None] & ~np.eye(n, dtype=bool)
    for G, deviation in zip(measured, deviations, strict=True):
        apart = np.abs(G - _mirrored(G)) ** 2
        variance = deviation**2 + _mirrored(deviation) ** 2
        shared = shared & (apart <= DEVIATIONS**2 * variance)
    position, velocity = (
        np.where(shared, _mirrored(G) + _weight(deviation) * (G - _mirrored(G)), G)
        for G, deviation in zip(measured, deviations, strict=True)
    )
    return response._replace(position=position, velocity=velocity, shared=shared)


def _mirrored(values: NDArray[Any]) -> NDArray[Any]:
    return np.swapaxes(values, 1, 2)


def _weight(deviation: Floats) -> Floats:
    """Return the weight (f, n, n) of G_ij in the mean with G_ji, by the deviations of both."""
    other = _mirrored(deviation) ** 2
    variance = deviation**2 + other
    weight = np.full_like(other, 0.5)
    return np.asarray(np.divide(other, variance, out=weight, where=variance > 0.0))


def refined(response: Response) -> Response:
    """Return a response at more frequencies, interpolated between its own."""
    f = response.frequency
    fine = np.interp(
        np.arange(_FINER * (f.size - 1) + 1) / _FINER, np.arange(f.size), f
    )

    def between(values: NDArray[Any]) -> NDArray[Any]:
        rows = np.interp(fine, f, np.arange(f.size))
        low = np.minimum(rows.astype(int), f.size - 2)
        share = (rows - low).reshape(-1, *([1] * (values.ndim - 1)))
        return np.asarray((1.0 - share) * values[low] + share * values[low + 1])

    square = (2j * np.pi * f)[:, None, None] ** 2
    fine_square = (2j * np.pi * fine)[:, None, None] ** 2
    inverse: Complex = np.asarray(np.linalg.inv(response.position), complex)
    inverse_between = between(inverse / square) * fine_square
    low = np.minimum(np.arange(fine.size) // _FINER, f.size - 2)
    position = np.linalg.inv(inverse_between)
    ratio = between(response.velocity @ inverse)
    sensed = response.sensed
    if sensed is not None:
        of_position = between(sensed.effort @ inverse)
        sensed = Sensed(np.asarray(of_position @ position), between(sensed.noise))
    return Response(
        frequency=fine,
        position=np.asarray(position),
        velocity=np.asarray(ratio @ position),
        position_noise=between(response.position_noise),
        velocity_noise=between(response.velocity_noise),
        columns=between(response.columns),
        shared=response.shared[low] & response.shared[low + 1],
        posture=response.posture,
        seen=_is_seen(response, inverse, inverse_between, low),
        speed=response.speed,
        friction=response.friction,
        sensed=sensed,
    )


def _is_seen(
    response: Response, inverse: Complex, between: Complex, low: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Whether G_y is of the arm where its inverse is interpolated (g,): `between`.

    `inverse` (f, n, n) is that at the lines, of which each is between `low` (g,) and the next.
    A mode in which the arm hardly moves has an inverse that is large and all noise.  Of two such
    lines, the mean may be nearly singular, which looks like a resonance: where G_y exceeds that
    of both lines, both must show what is left of its inverse in that mode.
    """
    left, values, right = np.linalg.svd(between)
    u, v = left[:, :, -1], right[:, -1].conj()
    at_lines = np.linalg.svd(inverse, compute_uv=False)[:, -1]
    seen = np.ones(low.size, bool)
    for k in (low, low + 1):
        A = inverse[k]
        row = np.einsum('gi,gij->gj', u.conj(), A)
        column = np.einsum('gij,gj->gi', A, v)
        value = np.abs(np.einsum('gi,gi->g', u.conj(), column))
        # u^H A dG A v, dG_ij with the deviation rows_i columns_j
        deviation = np.linalg.norm(row * response.position_noise[k], axis=1)
        deviation *= np.linalg.norm(response.columns[k] * column, axis=1)
        seen &= value > DEVIATIONS * deviation
    peaks = values[:, -1] < np.minimum(at_lines[low], at_lines[low + 1])
    peaks[::_FINER] = False  # lines
    return np.asarray(seen | ~peaks)


def _period(run: Run, period: float, T: float) -> NDArray[np.intp]:
    """Return the samples (N + 1,) of the first period after settling.

    On an even grid: each sample is the one nearest to its time.
    """
    count = round(period / T)
    begin = run.stamp[0] + round(1e9 * SETTLING)
    times = begin + np.rint(1e9 * T * np.arange(count + 1)).astype(np.int64)
    if run.stops and run.stops[0].stamp < times[-1]:
        stop = run.stops[0]
        raise BlfDscError(
            f'the arm stopped {1e-9 * (stop.stamp - run.stamp[0]):.3g} s after the start: '
            f'{stop.text}'
        )
    if run.stamp[-1] < times[-1]:
        needed = SETTLING + period
        raise BlfDscError(
            f'the run has {run.duration:.3g} s, but the motion needs {needed:.3g} s'
        )
    nearest = _nearest(run.stamp, times)
    lost = int(np.count_nonzero(np.diff(nearest) == 0))
    if lost > _MOST_LOST * count:
        raise BlfDscError(
            f'{lost} of {count} joint states are missing in the period that counts: measure '
            'with a driver that keeps its rate'
        )
    return nearest


def _check_finite(run: Run, rows: NDArray[np.intp]) -> None:
    """Raise BlfDscError if torques, positions or velocities in some rows are not finite."""
    for name, values in (
        ('torques', run.torque),
        ('positions', run.position),
        ('velocities', run.velocity),
    ):
        if not np.isfinite(values[rows]).all():
            raise BlfDscError(f'the run has {name} that are not finite')


def _nearest(stamp: Stamps, times: Stamps) -> NDArray[np.intp]:
    """Return the sample (N,) with the stamp [ns] nearest to each of N times [ns]."""
    after = np.searchsorted(stamp, times).clip(1, stamp.size - 1)
    is_before = times - stamp[after - 1] < stamp[after] - times
    return np.asarray(after - is_before)


def _spectrum(values: Floats) -> Complex:
    """Return amplitudes (N/2 + 1, n) of the waves of values (N + 1, n), without their drift.

    The first and the last value are a period apart.
    """
    count = len(values) - 1
    drift = np.linspace(0.0, values[-1] - values[0], count + 1)
    return np.asarray(np.fft.rfft((values - drift)[:-1], axis=0) * (2.0 / count))


def _rubbing(U: Complex, Y: Complex, lines: Lines) -> tuple[Floats, Floats]:
    """Return the mean square of the speeds over their mean (n,) [rad/s], and friction (n,) [N m].

    A damping dissipates as much as constant friction of the product with that speed does.
    The friction is that by the power of the slow tones alone: no more than there is, but for
    what joints hand to each other.
    """
    rows = np.union1d(lines.bins, lines.slow)
    V = np.zeros_like(Y)
    V[rows] = 2j * np.pi / lines.period * rows[:, None] * Y[rows]
    count = 2 * (len(Y) - 1)
    speeds = np.abs(np.fft.irfft(V, count, axis=0) * (count / 2.0))
    mean = np.maximum(speeds.mean(axis=0), np.finfo(float).tiny)  # of a joint at rest
    joints = np.arange(Y.shape[1])[:, None]
    power = 0.5 * (U * V.conj()).real[lines.slow, joints].sum(axis=1)
    return np.asarray((speeds**2).mean(axis=0) / mean), np.asarray(power / mean)


def _between(lines: Lines, count: int) -> NDArray[np.bool_]:
    """Return which waves (count,) of the spectrum the motion does not have."""
    free = np.ones(count, bool)
    free[lines.bins.ravel()] = False
    free[lines.slow.ravel()] = False
    free[0] = False
    return free

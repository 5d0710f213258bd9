# SPDX-License-Identifier: Apache-2.0
"""Limit cycles: joints that shake by some mrad at some Hz, without end.

Friction that falls with speed (Stribeck) makes a joint stick and slip, most often a light wrist
with soft gains.  The law's detector of oscillations does not see it: it looks above 8 Hz, and for a
twentieth of the torque limit.  So the errors of a proof are looked at, at rest and in motion.

A limit cycle is a peak of their spectrum that has most of what there is in the band, and is about
as high in both halves of the time.  What dies out, drifts, follows from the reference, or is noise
is none.

The motion has slower errors of its own, and a joint that sticks and slips while it moves has no one
frequency: its peak is wide, and each line of it may be lower than a slower one.  Then the peak as a
whole counts, if it lasts all the time: what rings after each reversal of a joint does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.commissioning.motion import OF_RATE
from blf_dsc_controller.run import Run

Floats = NDArray[np.float64]

HOLD = 6.0
"""Time [s] for which an arm rests after a move, to see whether it shakes."""

STILL, IN_MOTION = 'while the arm holds still', 'in motion'

_LEAST = 5e-4  # rad or m, amplitude from which a limit cycle is told
_SEEN = {STILL: 5.0, IN_MOTION: 10.0}  # s, the last ones of a run
_SLOWEST = {STILL: 1.5, IN_MOTION: 3.0}  # Hz: below, a motion has errors of its own
_BELOW = 3.0  # times as slow, down to where a larger line makes a peak doubtful
_FASTEST = 40.0  # Hz
_LASTS = 0.5  # of the amplitude of one half of the time, that the other has at least
_PURE = 0.5  # of the mean square in the band, that the peak has at least
_WIDE, _LINES = 0.2, 2  # reach of a peak: of its frequency, and lines at least
_STEADY = 0.6  # of its rms, that the median of the amplitude over the time has at least
_NOISE_BANDWIDTH = 1.5  # of a window of Hann, in lines


class LimitCycle(NamedTuple):
    """A joint that shakes."""

    joint: str
    when: str  # STILL or IN_MOTION
    unit: str  # of `amplitude`
    amplitude: float
    frequency: float  # Hz


def limit_cycles(run: Run, when: str) -> list[LimitCycle]:
    """Return the limit cycles in the last seconds of a run, in which the arm moves or not.

    `when` is STILL or IN_MOTION.
    """
    if run.error is None:
        return []
    times = run.time
    if times[-1] - times[0] < 0.5 * _SEEN[when]:  # too short for such frequencies
        return []
    rows = times >= times[-1] - _SEEN[when]
    rows &= np.isfinite(run.error).all(axis=1)
    count = 2 * (int(rows.sum()) // 2)
    if count < 100:  # hardly any errors are known
        return []
    even = np.linspace(times[rows][0], times[rows][-1], count)
    found = []
    for joint, error in zip(run.joints, run.error[rows].T, strict=True):
        values = np.interp(even, times[rows], error)
        peak = _peak(values, float(even[1] - even[0]), _SLOWEST[when])
        if peak is not None:
            found.append(LimitCycle(joint, when, run.units(joint).position, *peak))
    return found


def _peak(error: Floats, T: float, slowest: float) -> tuple[float, float] | None:
    """Return amplitude and frequency [Hz] of a peak in an error (N,), every `T` [s]; None: none."""
    frequency, square = _spectrum(error, T)
    fastest = min(_FASTEST, OF_RATE / T)
    band = np.flatnonzero((frequency >= slowest) & (frequency <= fastest))
    k = int(band[square[band].argmax()])
    if k == band[0]:  # the end of something slower
        return None
    at = float(frequency[k])
    reach = max(_WIDE * at, _LINES * frequency[1])

    def around_peak(frequency: Floats, square: Floats) -> float:
        return float(square[np.abs(frequency - at) <= reach].sum())

    whole = around_peak(frequency, square)
    halves = [around_peak(*_spectrum(each, T)) for each in np.split(error, 2)]
    pure = whole >= _PURE * square[band].sum()
    lasts = min(halves) >= _LASTS**2 * max(halves)
    if whole < _LEAST**2 or not (pure and lasts):
        return None
    slower = (frequency >= slowest / _BELOW) & (frequency < slowest)
    if square[slower].max() > square[k]:
        sums = np.convolve(square, np.ones(2 * _LINES + 1), 'same')
        if sums[slower].max() > whole or not _is_steady(error, T, at, reach):
            return None
    return float(np.sqrt(whole)), at


def _is_steady(error: Floats, T: float, frequency: float, reach: float) -> bool:
    """Whether a wave around a frequency, within `reach` [Hz], is there most of the time."""
    at = np.fft.fftfreq(error.size, T)
    near = np.abs(at - frequency) <= reach  # not its mirror image
    amplitude = np.abs(np.fft.ifft(near * np.fft.fft(np.hanning(error.size) * error)))
    middle = amplitude[error.size // 4 : -error.size // 4]
    return bool(np.median(middle) >= _STEADY * np.sqrt((middle**2).mean()))


def _spectrum(error: Floats, T: float) -> tuple[Floats, Floats]:
    """Return frequencies [Hz] and squares of amplitudes of an error (N,), without its drift.

    A wave spreads over some lines, whose sum has the square of its amplitude.
    """
    at = np.arange(error.size)
    straight = np.polyval(np.polyfit(at, error, 1), at)
    window = np.hanning(error.size)
    amplitude = 2.0 * np.abs(np.fft.rfft(window * (error - straight))) / window.sum()
    frequency = np.asarray(np.fft.rfftfreq(error.size, T), np.float64)
    return frequency, np.asarray(amplitude**2 / _NOISE_BANDWIDTH, np.float64)

# SPDX-License-Identifier: Apache-2.0
"""Rotor inertias that the URDF lacks, measured while the law runs, for the gains of its feedback.

The gains rest on the inertia of each joint, and a geared one's is dominated by the
reflected rotor inertia, which is rarely specified.  The guess, rated torque over 400
rad/s^2, may be wrong either way: the published rotors of an FR3's wrists are 6.9 times it.
Only one that is too heavy is corrected.  A joint that is much lighter makes the loop
oscillate, and this oscillation shows its inertia before it has grown: between the
bandwidth of the motion and that of the noise,

    tau = M a = M_0 a + J~ a,        r = tau - M_0 a,        z^T r = z^T a J~,

with M_0 from P^(0), J~ the error of the guess and z = tau, all through the lags of the
loop and the same band pass.  Sums over all time give J~ in [-J, 0] of each joint.  They
grow only while the acceleration is clear of the noise, which is known by its second
difference: noise comes back through the feedback, where it cannot be told from an arm
without inertia.

A push leaves an r as well, mostly one that no drive explains: it asks for an inertia that
is smaller by two to ten times the guess, or moves the arm against its torque.  So what half
an oscillation shows, from one zero of a to the next, is forgotten at its end if z a is not
positive, or if it asks for more than twice the guess less.  Until then it counts, for the
error of a light drive grows threefold in it; a push makes the gains softer for that long,
or until the acceleration is clear of the noise again where the arm calms down before.

The feedback then acts on M_0 + J~ in place of M_0: its acceleration, damping and
barrier included, minus qr'' gets the torque of J~ as well, as does the rate of d^3.
The damping of a safe stop is scaled by the inertia of each joint with the others free,
interpolated between J~ = -J and 0.  Along the reference nothing changes: what is
learned acts there.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.law.lag import filter_gain

_BAND_END = 0.5  # upper end of the band, times the sample rate
_BAND_BEGIN = 0.06  # lower end, likewise
_POWER_TIME = 0.02  # s, of the two powers that are compared
_POWER_RATIO = 0.1  # their ratio: noise has 0.005, an oscillation 100
# s (rad/s^2)^2, times the inertia: least sum of z a that shows anything
_EVIDENCE = 0.05
_RELEASE_TIME = 0.02  # s, in which the arm settles on its first torque
# times the guess: most that half an oscillation may ask a drive to be lighter
_POSSIBLE = 2.0

# Rows of `State.sums`: z r and z a, those of the half oscillation under way, and
# the last a.
_ZR, _ZA, _HALF_ZR, _HALF_ZA, _A = range(5)

# Rows of `State.lags`: poles of the torque, those of the acceleration, and the last
# samples.
_HELD, _DRIVE, _SENSOR, _TORQUE1, _TORQUE2, _TORQUE_MEAN = range(6)
_RATE1, _RATE2, _RATE_MEAN, _NOISE, _POWER, _VELOCITY, _LAST, _BEFORE = range(6, 14)


class Settings(NamedTuple):
    """The assumed inertias."""

    unsure: int  # 1: errors of the assumed rotor inertias are measured
    lag: float  # of measured velocities and applied torques together, s
    # assumed rotor inertias J that are a guess, kg m^2; 0: known
    rotor: Annotated[Array, 'n']
    # m, least inertia of a joint with the others free, kg m^2
    joint: Annotated[Array, 'n']
    link: Annotated[Array, 'n']  # likewise, without J


class State(NamedTuple):
    """What it keeps from one sample to the next."""

    lags: Annotated[Array, 14, 'n']
    sums: Annotated[Array, 5, 'n']  # of z r and z a
    error: Annotated[Array, 'n']  # J~ <= 0, kg m^2
    gain_scale: Annotated[Array, 'n']  # measured inertia of each joint over the assumed


class Work(NamedTuple):
    """Values of one sample, in the band."""

    torque: Annotated[Array, 'n']  # z, N m
    acceleration: Annotated[Array, 'n']  # a, rad/s^2


@inner
def low_pass(lags: Array, row: int, i: int, gain: float, x: float) -> float:
    """Advance the first-order lag `lags[row, i]` and return it."""
    lags[row, i] += gain * (x - lags[row, i])
    return float(lags[row, i])


@inner
def begin(state: State, dq: Array, applied: Array) -> None:
    """Start the lags at rest, with the torque (n,) held that was `applied` last [N m]."""
    for i in range(dq.size):
        for row in range(_RATE1, _BEFORE + 1):
            state.lags[row, i] = 0.0
        state.lags[_VELOCITY, i] = dq[i]
        for row in range(_RATE1):
            state.lags[row, i] = applied[i]


@inner
def pass_band(
    settings: Settings, state: State, work: Work, dq: Array, applied: Array, dt: float
) -> None:
    """Compute torque and acceleration in the band.

    From the velocity dq (n,) [rad/s] and the torque (n,) that was `applied` [N m].
    """
    lags = state.lags
    late = filter_gain(0.5 * settings.lag, dt) if settings.lag > 0.0 else 1.0
    smooth = filter_gain(dt / _BAND_END, dt)
    slow = filter_gain(dt / _BAND_BEGIN, dt)
    brief = filter_gain(_POWER_TIME, dt)
    for i in range(dq.size):
        torque = low_pass(lags, _DRIVE, i, late, lags[_HELD, i])
        lags[_HELD, i] = applied[i]
        torque = low_pass(lags, _SENSOR, i, late, torque)
        torque = low_pass(lags, _TORQUE1, i, smooth, torque)
        torque = low_pass(lags, _TORQUE2, i, smooth, torque)
        work.torque[i] = torque - low_pass(lags, _TORQUE_MEAN, i, slow, torque)
        rate = (dq[i] - lags[_VELOCITY, i]) / dt
        a = low_pass(lags, _RATE1, i, smooth, rate)
        a = low_pass(lags, _RATE2, i, smooth, a)
        a -= low_pass(lags, _RATE_MEAN, i, slow, a)
        work.acceleration[i] = a
        noise = rate - 2.0 * lags[_LAST, i] + lags[_BEFORE, i]
        low_pass(lags, _NOISE, i, brief, noise * noise)
        low_pass(lags, _POWER, i, brief, a * a)
        lags[_BEFORE, i] = lags[_LAST, i]
        lags[_LAST, i] = rate
        lags[_VELOCITY, i] = dq[i]


@inner
def has_settled(samples: float, dt: float) -> bool:
    """Whether the arm has settled on its first torque, after so many samples of `dt` [s]."""
    return bool(samples * dt >= _RELEASE_TIME)


@inner
def update(
    settings: Settings, state: State, work: Work, Yp: Array, P0: Array, dt: float
) -> None:
    """Update J~ from the last interval; Yp (n, p) P0 = M_0 a is of the band's acceleration."""
    for i in range(settings.rotor.size):
        if settings.rotor[i] == 0.0:
            continue
        if state.lags[_POWER, i] <= _POWER_RATIO * state.lags[_NOISE, i]:
            continue
        r = work.torque[i]
        for j in range(Yp.shape[1]):
            r -= Yp[i, j] * P0[j]
        add_to_sums(settings, state, i, work.torque[i], r, work.acceleration[i], dt)
        estimate(settings, state, i)


@inner
def add_to_sums(
    settings: Settings, state: State, i: int, z: float, r: float, a: float, dt: float
) -> None:
    """Add the last interval to the sums of joint i."""
    sums = state.sums
    if a * sums[_A, i] < 0.0:
        end_half_oscillation(settings, state, i)
    sums[_A, i] = a
    sums[_HALF_ZR, i] += dt * z * r
    sums[_HALF_ZA, i] += dt * z * a


@inner
def end_half_oscillation(settings: Settings, state: State, i: int) -> None:
    """Add the half oscillation under way to the sums, unless no drive explains it."""
    sums = state.sums
    za = sums[_HALF_ZA, i]
    if za > 0.0 and sums[_HALF_ZR, i] >= -_POSSIBLE * settings.rotor[i] * za:
        sums[_ZR, i] += sums[_HALF_ZR, i]
        sums[_ZA, i] += sums[_HALF_ZA, i]
    sums[_HALF_ZR, i] = 0.0
    sums[_HALF_ZA, i] = 0.0


@inner
def estimate(settings: Settings, state: State, i: int) -> None:
    """Compute J~ of joint i, and how its inertia compares with the assumed."""
    J = settings.rotor[i]
    sums = state.sums
    za = sums[_ZA, i] + sums[_HALF_ZA, i]
    least = _EVIDENCE * settings.joint[i]
    zr = sums[_ZR, i] + sums[_HALF_ZR, i]
    error = zr / (za + least) if za >= least else 0.0
    state.error[i] = min(0.0, max(-J, error))
    lost = 1.0 - settings.link[i] / settings.joint[i]
    state.gain_scale[i] = 1.0 + state.error[i] / J * lost

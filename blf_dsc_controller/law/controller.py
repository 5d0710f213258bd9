# SPDX-License-Identifier: Apache-2.0
"""One sample of the loop, and the controller: a law with explicit state, `reset`, and `update`.

See `interface` for what the loop does for every law, and what a law does itself.
"""

from __future__ import annotations

import functools
from math import nan
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.entry import Entry
from blf_dsc_controller.compiled.jit import direct, inner, kernel
from blf_dsc_controller.compiled.layout import Array, pack
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law import (
    barrier,
    external_torque,
    friction,
    oscillation,
    repeats,
    torque,
    torque_sensors,
    truth,
)
from blf_dsc_controller.law.check_state import (
    CONTRADICTION,
    INVALID,
    NOT_SENSORS,
    OSCILLATES,
    Checks,
    checks_of,
    checks_size,
)
from blf_dsc_controller.law.checks import (
    check_sample,
    is_valid_state,
    watch_oscillation,
)
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.laws import for_kernels, for_law, with_gains
from blf_dsc_controller.law.lyapunov import fill_energies
from blf_dsc_controller.law.perception import (
    sense,
    sense_nothing,
    weigh,
    weigh_nothing,
)
from blf_dsc_controller.law.sensor import compare_velocities
from blf_dsc_controller.law.state import (
    Sample,
    Settings,
    Signals,
    State,
    sample_of,
    sample_size,
    settings_of,
    signals_of,
    signals_size,
    state_of,
    state_size,
)
from blf_dsc_controller.law.torque import added_torque
from blf_dsc_controller.law.weighing import DEVIATION
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.reference import terms as reference


@inner
def fill_sample(
    settings: Settings, state: State, signals: Signals, sample: Sample
) -> None:
    """Fill the telemetry sample, except for the terms of (29)."""
    for i in range(settings.n):
        sample.qr[i] = signals.qr[i]
        sample.dqr[i] = signals.dqr[i]
        sample.xi1[i] = signals.xi1[i]
        sample.xi2[i] = signals.xi2[i]
        sample.torque[i] = signals.torque[i]
        sample.disturbance[i] = state.disturbance[i] + signals.friction.torque[i]
        for j in range(settings.p, settings.m):
            sample.disturbance[i] += signals.H[i, j] * state.estimate[j]
        if settings.observer.enabled == 1:
            sample.disturbance[i] += state.observer.torque[i]
        sample.bound[i] = signals.bound[i]
        sample.cuts[i] = signals.saturation.cuts[i]
    for j in range(settings.m):
        sample.estimate[j] = state.estimate[j] if state.latch.active[j] != 0.0 else nan
    sample.lambda_min[0] = state.latch.lambda_min[0]
    sample.latched[0] = state.latch.latched[0]
    sample.changes[0] = state.change.changes[0]
    load = state.weighing.load
    for k in range(load.size):
        is_known = load[DEVIATION + k % DEVIATION] > 0.0
        factor = 1.0 if k < DEVIATION else TWO_SIDED
        sample.load[k] = factor * load[k] if is_known else nan


@inner
def check_measurement(checks: Checks, measurement: Array, dt: float) -> int:
    """Return the flags of a measurement that the law must not use, or 0; update the sensor's."""
    if checks.velocity_limit[0] <= 0.0:
        return 0  # nothing is checked
    if not is_valid_state(checks, measurement):
        return INVALID
    T = checks.sample_time[0]
    if T > 0.0 and compare_velocities(
        checks.sensor, checks.oscillation, T, dt, measurement
    ):
        return INVALID | CONTRADICTION
    return 0


@inner
def take_measurement(
    checks: Checks, signals: Signals, measurement: Array, begins: bool, dt: float
) -> None:
    """Write q, dq and effort into the signals, without repeats if there are checks."""
    used = measurement
    if checks.velocity_limit[0] > 0.0:
        T = checks.sample_time[0]
        repeats.bridge(checks.repeats, measurement, begins, T, dt)
        used = checks.repeats.used
    n = signals.q.size
    for i in range(n):
        signals.q[i] = used[i]
        signals.dq[i] = used[n + i]
        signals.effort[i] = used[2 * n + i]


@inner
def prepare(
    settings: Settings,
    state: State,
    signals: Signals,
    reference_vector: Array,
    t: float,
) -> None:
    """Find what every law reads: torques at work, reference, bound and error."""
    torque.find_added(settings.torque, signals.saturation, signals.q)
    torque.find_applied(
        state.saturation, signals.saturation, state.torque, signals.applied
    )
    reference.evaluate(reference_vector, t, signals.qr, signals.dqr, signals.ddqr)
    truth.update_disturbance(settings.truth, signals.truth, t)
    barrier.update_bound(settings.barrier, signals.barrier, t, signals.bound)
    for i in range(settings.n):
        signals.xi1[i] = signals.q[i] - signals.qr[i]


@inner
def advance(
    law: Law, settings: Settings, state: State, signals: Signals, t: float, dt: float
) -> None:
    """Let the law compute its torque, within its limits, and advance its memory by `dt` [s]."""
    has_last = state.samples[0] > 0.0 or state.saturation.takes_over[0] > 0.0
    law.compute_demand(settings, state, signals, t, dt)
    saturated = torque.saturate(
        settings.torque,
        state.saturation,
        signals.saturation,
        signals.demand,
        state.torque,
        has_last,
        dt,
        signals.torque,
    )
    law.finish(settings, state, signals, dt, saturated)
    for i in range(settings.n):
        state.torque[i] = signals.torque[i]
    state.samples[0] += 1.0


@inner
def step(
    law: Law,
    settings: Settings,
    checks: Checks,
    reference_vector: Array,
    state: State,
    signals: Signals,
    t: float,
    dt: float,
    measurement: Array,
    sample: Sample,
) -> int:
    """Run one sample, from the measurement to the torque; return the flags of its `checks`.

    The measurement is [q (n,) rad, dq (n,) rad/s, effort of the last interval (n,) N
    m], t [s] the time since the start, dt [s] since the last sample (at the first:
    until the next).  The terms of (29) are separate: `lyapunov.fill_energies`.
    """
    flags = check_measurement(checks, measurement, dt)
    if flags != 0:
        return flags
    begins = state.samples[0] == 0.0
    take_measurement(checks, signals, measurement, begins, dt)
    prepare(settings, state, signals, reference_vector, t)
    oscillates = watch_oscillation(settings, checks, signals, begins, dt)
    fault = state.sensors.fault[0]
    advance(law, settings, state, signals, t, dt)
    fill_sample(settings, state, signals, sample)
    if checks.velocity_limit[0] <= 0.0:
        return 0  # nothing is checked
    flags = check_sample(settings, checks, state, signals, sample)
    if state.sensors.fault[0] != fault:
        oscillation.forget_all(checks.oscillation)  # r may have been the cause
        return flags | NOT_SENSORS
    r = state.observer
    if oscillates and not torque_sensors.is_fading(r.faded, r.calmed):
        return flags | OSCILLATES
    return flags


@kernel
def update(
    law: Law,
    model: ArmModel,
    settings_vector: Array,
    state_vector: Array,
    signals_vector: Array,
    sample_vector: Array,
    checks_vector: Array,
    measurement: Array,
    reference_vector: Array,
    t: float,
    dt: float,
    observed: bool,
) -> int:
    """Run `step` on packed vectors; return its flags.  With `observed`, find the terms of (29)."""
    settings = settings_of(settings_vector, model)
    state = state_of(state_vector, settings)
    signals = signals_of(signals_vector, settings)
    sample = sample_of(sample_vector, settings)
    checks = checks_of(checks_vector, settings)
    flags = step(
        law,
        settings,
        checks,
        reference_vector,
        state,
        signals,
        t,
        dt,
        measurement,
        sample,
    )
    if observed and flags & INVALID == 0:
        fill_energies(settings, state, signals, sample)
    return flags


@kernel
def compare(
    model: ArmModel,
    settings_vector: Array,
    checks_vector: Array,
    measurement: Array,
    dt: float,
) -> bool:
    """Run `compare_velocities` on packed vectors, without the law."""
    settings = settings_of(settings_vector, model)
    checks = checks_of(checks_vector, settings)
    T = checks.sample_time[0]
    return compare_velocities(checks.sensor, checks.oscillation, T, dt, measurement)


class LawKernels(NamedTuple):
    """What a compiled loop calls of a controller."""

    update: Entry
    weigh: Entry
    sense: Entry


class Controller:
    """A law with its settings, its reference and its state.

    Attributes:
        law: the law, with its own gains.
        given_law: the same as kernels get it.
        settings: settings of the loop and the learning; views of `settings_vector`.
        state: views of `state_vector`, the whole state of the controller.
        signals: views of the values that the last update computed.
        sample: telemetry of the last update.
        checks: views of `checks_vector`: limits of the checks, which are initially off.
        flags: flags set by the checks in the last update.
    """

    def __init__(self, law: Law, settings: Settings, reference_vector: Array) -> None:
        """Allocate the vectors for settings and a packed reference; compile the kernels."""
        self.law = law
        self.settings_vector = pack(settings)
        self.reference_vector = reference_vector
        self.settings = settings_of(self.settings_vector, settings.model)
        self.state_vector = np.zeros(state_size(self.settings))
        self.signals_vector = np.zeros(signals_size(self.settings))
        self.state = state_of(self.state_vector, self.settings)
        self.signals = signals_of(self.signals_vector, self.settings)
        self.sample_vector = np.zeros(sample_size(self.settings))
        self.sample = sample_of(self.sample_vector, self.settings)
        self.checks_vector = np.zeros(checks_size(self.settings))
        self.checks = checks_of(self.checks_vector, self.settings)
        self.flags = 0
        # contiguous, of the kernel's type
        self._measurement = np.zeros(3 * self.settings.n)
        self._compile()
        self.reset()
        self.reference_at(0.0)
        self.update(0.0, 1e-3, np.zeros(3 * self.settings.n))
        self.perceive(1e-3)
        self.reset()

    def _compile(self) -> None:
        """Compile the kernels for the types of the vectors, which they are called with."""
        self._vectors = (
            self.settings.model,
            self.settings_vector,
            self.state_vector,
            self.signals_vector,
            self.sample_vector,
            self.checks_vector,
            self._measurement,
        )
        views = self.settings, self.state, self.signals
        self.given_law = given = for_kernels(self.law, *views)
        self._update = direct(
            for_law(update, given),
            given,
            *self._vectors,
            self.reference_vector,
            0.0,
            0.0,
            True,
        )
        self._compared = (*self._vectors[:2], self.checks_vector, self._measurement)
        self._compare = direct(compare, *self._compared, 0.0)
        if self.settings.weighing.size:
            self._weigh = direct(weigh, *self._vectors[:4], 0.0)
        if self.settings.contact.enabled:
            self._sense = direct(sense, *self._vectors[:5], 0.0)

    @functools.cached_property
    def kernels(self) -> LawKernels:
        """The kernels of `update` and `perceive`, for a compiled loop."""
        law = self.given_law
        given = (*self._vectors, self.reference_vector, 0.0, 0.0, True)
        weighs = weigh if self.settings.weighing.size else weigh_nothing
        senses = sense if self.settings.contact.enabled else sense_nothing
        return LawKernels(
            Entry(for_law(update, law), law, *given),
            Entry(weighs, *self._vectors[:4], 0.0),
            Entry(senses, *self._vectors[:5], 0.0),
        )

    @property
    def torque_at(self) -> int:
        """Entry of `sample_vector` at which the torque begins."""
        torque = self.sample.torque
        return int(torque.ctypes.data - self.sample_vector.ctypes.data) // 8

    def bound_at(self, t: float) -> Array:
        """Return the bound k(t) (n,) [rad] at time t [s] since the start."""
        return barrier.bound_at(self.settings.barrier, t)

    def reference_at(self, t: float) -> Array:
        """Return the reference qr, dqr, ddqr (3, n) at time t [s] since the start."""
        (now,) = reference.sampled(self.reference_vector, np.array([t]))
        return np.asarray(now)

    @property
    def samples(self) -> int:
        """Number of samples since the start."""
        return int(self.state.samples[0])

    def reset(self) -> None:
        """Return to the initial state: initial estimate, empty filters and window."""
        self.state_vector.fill(0.0)
        self.state.estimate[:] = self.settings.initial_estimate
        self.state.latch.anchor[:] = self.settings.initial_estimate
        self.state.window.min_eigenvector.fill(1.0 / np.sqrt(self.settings.m))
        self.state.latch.active.fill(1.0)
        self.state.rotors.gain_scale.fill(1.0)
        friction.begin(self.settings.friction, self.state.friction)

    def update(self, t: float, dt: float, measurement: Array) -> Array:
        """Return the torque (n,) [N m] for a measurement: a view that the next update overwrites.

        The measurement is [q (n,) rad, dq (n,) rad/s, effort (n,) N m]. The effort is
        that of the last interval, and for the checks and the load observer alone: the law
        learns from the torque that it commanded. t [s] is the time since the start, dt
        [s] since the last sample. If INVALID is among the `flags`, nothing has changed,
        including the torque.

        Raises BlfDscError if the measurement has another shape than (3 n,).
        """
        self._take(measurement)
        self.flags = self._update(
            self.given_law, *self._vectors, self.reference_vector, t, dt, True
        )
        return self.sample.torque

    def compare_velocities(self, dt: float, measurement: Array) -> bool:
        """Compare velocities with positions; return whether one contradicts them.

        The law does not use the state. The measurement (3 n,) is finite, `dt` [s] after
        the last.
        """
        self._take(measurement)
        return bool(self._compare(*self._compared, dt))

    def _take(self, measurement: Array) -> None:
        """Copy a measurement to where the kernels read it."""
        given = np.shape(measurement)
        if given != self._measurement.shape:
            n = self.settings.n
            raise BlfDscError(
                f'measurement: got an array of shape {given}, but {n} joints need ({3 * n},): '
                'positions, velocities and torques, one after the other'
            )
        self._measurement[:] = measurement

    def perceive(self, dt: float) -> bool:
        """Weigh the load and find the external torque, by the row of the last update.

        It was `dt` [s] after the one before.  Returns whether a contact begins.
        """
        if self.settings.weighing.size:
            self._weigh(*self._vectors[:4], dt)
        return bool(
            self.settings.contact.enabled and self._sense(*self._vectors[:5], dt)
        )

    @property
    def can_tare(self) -> bool:
        """Whether the external torque is found, and the arm has rested for long enough."""
        if not self.settings.contact.enabled:
            return False
        return bool(self.state.external.resting[0] >= self.tare_rest)

    @property
    def tare_rest(self) -> float:
        """How long an arm rests before a tare [s]."""
        return external_torque.settling_time(self.settings.external)

    @property
    def is_tared(self) -> bool:
        """Whether a tare is in force."""
        return bool(self.state.external.tared[0])

    def tare(self) -> None:
        """Take the external torque of an arm at rest for zero: see `external_torque`."""
        external_torque.tare(self.state.external, self.state.change.changes[0])

    def take_over(self, torque: Array, q: Array) -> None:
        """Continue from a command (n,) [N m] that acts on an arm at q (n,) [rad].

        Call it before the first update: the rate limit then holds from this torque on.
        """
        self.state.torque[:] = torque
        self.state.saturation.added[:] = added_torque(self.settings.torque, q)
        self.state.saturation.held_back[:] = 0.0
        self.state.saturation.takes_over[0] = 1.0

    def trial(self, t: float, dt: float, measurement: Array) -> Array:
        """Return the torque of an unchecked update that only changes `signals` and `sample`."""
        saved = self.save()
        limit = self.checks.velocity_limit[0]
        self.checks.velocity_limit[0] = 0.0
        try:
            torque: Array = self.update(t, dt, measurement).copy()
        finally:
            self.checks.velocity_limit[0] = limit
        self.restore(saved)
        return torque

    def retune(self, law: Law, settings: Settings) -> None:
        """Replace the gains of the law, and settings that change no size; the state stays."""
        self.law = law
        self.given_law = with_gains(self.given_law, law)
        self.settings_vector[:] = pack(settings)

    def save(self) -> Array:
        """Return a copy of the whole state."""
        return np.array(self.state_vector)

    def restore(self, saved: Array) -> None:
        """Return to a saved state; the loop continues from there bit for bit."""
        self.state_vector[:] = saved

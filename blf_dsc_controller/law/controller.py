# SPDX-License-Identifier: Apache-2.0
"""The controller: a law with its settings and explicit state, whose kernels it compiles and calls.

What a sample does is in `step`, what follows after its torque in `perception`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from blf_dsc_controller.compiled.jit import direct
from blf_dsc_controller.compiled.layout import Array, pack
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law import barrier, external_torque, load_observer, reversals
from blf_dsc_controller.law.check_state import INVALID, checks_of, checks_size
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.laws import for_kernels, for_law, with_gains
from blf_dsc_controller.law.perception import estimate_payload, sense
from blf_dsc_controller.law.start import Start, keep
from blf_dsc_controller.law.state import (
    Settings,
    sample_of,
    sample_size,
    settings_of,
    signals_of,
    signals_size,
    state_of,
    state_size,
)
from blf_dsc_controller.law.step import advance, compare, update
from blf_dsc_controller.law.torque import added_torque
from blf_dsc_controller.reference import terms as reference


class Controller:
    """A law with its settings, its reference and its state.

    Attributes:
        law: the law, with its own gains.
        kernel_law: the same as kernels get it.
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
        self.kernel_law = kernel_law = for_kernels(self.law, *views)
        self._update = direct(for_law(update, kernel_law), *self.arguments, 0.0, 0.0)
        self._advance = direct(for_law(advance, kernel_law), *self.arguments_after)
        self._compared = (*self._vectors[:2], self.checks_vector, self._measurement)
        self._compare = direct(compare, *self._compared, 0.0)
        if self.settings.payload.size:
            self._estimate_payload = direct(estimate_payload, *self._vectors[:4], 0.0)
        if self.settings.contact.enabled:
            self._sense = direct(sense, *self._vectors[:5], 0.0)

    @property
    def arguments(self) -> tuple[Any, ...]:
        """What the kernel `update` takes before t and dt."""
        return self.kernel_law, *self._vectors, self.reference_vector

    @property
    def arguments_after(self) -> tuple[Any, ...]:
        """What the kernel `advance` takes."""
        return self.kernel_law, *self._vectors[:5]

    def bound_at(self, t: float) -> Array:
        """Return the bound k(t) (n,) [rad] at time t [s] since the start."""
        return barrier.bound_at(self.settings.barrier, t)

    def reference_at(self, t: float) -> Array:
        """Return the reference qr, dqr, ddqr (3, n) at time t [s] since the start."""
        (sample,) = reference.sampled(self.reference_vector, np.array([t]))
        return np.asarray(sample)

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
        reversals.begin(self.settings.friction.reversals, self.state.friction.reversals)

    def begin(self, start: Start) -> None:
        """Begin with the next update; of the state, what `KEPT` names for this start goes on."""
        before = state_of(self.save(), self.settings)
        self.reset()
        keep(start, before, self.state)

    def update(self, t: float, dt: float, measurement: Array) -> Array:
        """Return the torque (n,) [N m] of `command`, and `advance`."""
        torque = self.command(t, dt, measurement)
        if not self.flags & INVALID:
            self.advance()
        return torque

    def advance(self) -> None:
        """Advance the state by the sample of the last command, whose torque has been sent."""
        self._advance(*self.arguments_after)

    def command(self, t: float, dt: float, measurement: Array) -> Array:
        """Return the torque (n,) [N m] for a measurement: a view that the next one overwrites.

        Then call `advance`, which learns: that takes longer, and no torque of this sample needs
        it.

        The measurement is [q (n,) rad, dq (n,) rad/s, effort (n,) N m]. The effort is
        that of the last interval, and for the checks and the load observer alone: the law
        learns from the torque that it commanded. t [s] is the time since the start, dt
        [s] since the last sample. If INVALID is among the `flags`, nothing has changed,
        including the torque.

        Raises BlfDscError if the measurement has another shape than (3 n,).
        """
        self._take(measurement)
        self.flags = self._update(*self.arguments, t, dt)
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
        shape = np.shape(measurement)
        if shape != self._measurement.shape:
            n = self.settings.n
            raise BlfDscError(
                f'measurement: got an array of shape {shape}, but {n} joints need ({3 * n},): '
                'positions, velocities and torques, one after the other'
            )
        self._measurement[:] = measurement

    def perceive(self, dt: float) -> bool:
        """Weigh the load and find the external torque, by the row of the last update.

        It was `dt` [s] after the one before.  Returns whether a contact begins.
        """
        if self.settings.payload.size:
            self._estimate_payload(*self._vectors[:4], dt)
        return bool(
            self.settings.contact.enabled and self._sense(*self._vectors[:5], dt)
        )

    @property
    def can_tare(self) -> bool:
        """Whether the external torque is computed, and the arm has rested for long enough."""
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

    def expect(self, load: Array) -> None:
        """Let the mean of the prior have a `load`, base parameters (p,), from now on."""
        mean = self.settings.prior_mean
        mean[:] = self.settings.initial_estimate
        mean[: load.size] += load

    def shift_estimate(self, change: Array) -> None:
        """Add an expected `change` (p,) of base parameters to the estimate, with its torque."""
        for parameters in (self.state.estimate, self.state.latch.anchor):
            parameters[: change.size] += change
        load_observer.expect(self.settings.observer, self.state.observer, change)

    def replace_torque(self, torque: Array) -> None:
        """Let another torque (n,) [N m] leave than the one of the last update."""
        self.sample.torque[:] = torque
        self.state.torque[:] = torque

    def trial(self, t: float, dt: float, measurement: Array) -> Array:
        """Return the torque of an unchecked update that only changes `signals` and `sample`."""
        saved = self.save()
        limit = self.checks.velocity_limit[0]
        self.checks.velocity_limit[0] = 0.0
        try:
            torque: Array = self.command(t, dt, measurement).copy()
        finally:
            self.checks.velocity_limit[0] = limit
        self.restore(saved)
        return torque

    def retune(self, law: Law, settings: Settings) -> None:
        """Replace the gains of the law, and settings that change no size; the state stays."""
        self.law = law
        self.kernel_law = with_gains(self.kernel_law, law)
        self.settings_vector[:] = pack(settings)

    def save(self) -> Array:
        """Return a copy of the whole state."""
        return np.array(self.state_vector)

    def restore(self, saved: Array) -> None:
        """Return to a saved state; the loop continues from there bit for bit."""
        self.state_vector[:] = saved

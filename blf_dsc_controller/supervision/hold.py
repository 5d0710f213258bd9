# SPDX-License-Identifier: Apache-2.0
"""The torque that holds an arm without its law, and ramps to it.

It is zero, damping -D v, or damping with gravity H(q, 0, 0, 0) P^ and a load, as `safety.torque`
says, less what the drives add.  Only trusted states enter it.  Without one there is no velocity
to damp, and a load that the arm has not shown to carry fades within half a second: what is left
is the torque that held the arm where it was last.
"""

from __future__ import annotations

from enum import Enum
from math import inf

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller_groups import Safety
from blf_dsc_controller.law.sensor import FILTER
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.law.torque import added_torque
from blf_dsc_controller.reference.approach import AT_REST
from blf_dsc_controller.supervision.braking import (
    braking_matrix,
    known_inertia,
    within_gap,
)
from blf_dsc_controller.supervision.command_effect import CommandEffect
from blf_dsc_controller.supervision.envelope import limited
from blf_dsc_controller.supervision.model_torque import gravity_torque, needed_torque
from blf_dsc_controller.supervision.observed_load import OBSERVER, ObservedLoad
from blf_dsc_controller.supervision.reading import Readings
from blf_dsc_controller.supervision.swing import Swing

Vector = NDArray[np.float64]

FADE_TIME = 0.5
"""Time [s] in which a load that is not sure fades while no state is trusted, and without gravity
what the law held the arm by, once it is deactivated."""

_RESTED = 10.0 / OBSERVER[1]  # s at rest, in which the observed load settles
_CALM_OBSERVER = 10.0, 10.0  # rad/s: slow against the oscillation of elastic joints


class Load(Enum):
    """Where the load besides the model comes from."""

    OBSERVED = 'from the motion, since the commands act on the arm'
    AWAITED = 'as the ramp began, until commands have had an effect on the arm'
    UNTIL_MOVED = 'from the motion until the arm has rested and moves again'
    KEPT = 'as the arm rested: another moves it'
    REFUTED = 'as the ramp began, while the arm speeds up'
    YIELDS = 'as the ramp began, to give way to a contact'


_OBSERVED = (Load.OBSERVED, Load.UNTIL_MOVED)
_ANSWERING = (*_OBSERVED, Load.AWAITED)


class Hold:
    """The torque without the law: a ramp from the last torque to the one that holds the arm.

    It obeys the rate limit, except for the last torque of all.

    The load that holds the arm besides the model's gravity is observed from its motion,
    also during the stop (`ObservedLoad`).  So an arm comes to rest with a payload, or with
    a model, that the law had not learned yet.  Estimated friction is not part of the load,
    since friction helps to brake.

    Above its first resonance, an elastic joint accelerates other than a rigid one, and shows
    a wrong load.  An observer with one pole of 30 1/s lets an oscillation go on at up to
    20 rad/s.  Two poles of 10 1/s do not feed an oscillation, but let a load sink further: an
    arm that oscillates at the stop has these, and so has each joint that swings during it,
    one that has left command and rests, and one whose velocities are differences of positions
    behind a low pass.

    If commands do not reach the arm, the observed load would grow for ever.  `Load` says when it
    is kept instead: after a stop that may have this cause until the arm accelerates, as it does
    if commands act on it (`CommandEffect`); while another node may command the arm; and while the
    arm speeds up.

    A joint that swings under its damping gets the share of it that it bears (`Swing`).

    Attributes:
        load: torque (n,) [N m] that the model lacks; initially that of the motion before
            (`RecentMotion`), or the disturbance estimate of the law.
        commanded: the last torque (n,) [N m], from the law or this ramp.
        missed_change: change (n,) [N m] of the commands since the stop to which the arm has not
            answered, for the torque that showed it; else None.
        longest_step: time [s] for which one torque may change at the rate limit.
    """

    def __init__(
        self, readings: Readings, settings: Settings, estimate: Vector, period: float
    ) -> None:
        """Hold the arm of these `readings`, by its model and the `estimate` (m,) of its law.

        `period` is the sample time [s].
        """
        n = settings.n
        self.commanded = np.zeros(n)
        self.load = np.zeros(n)
        self.missed_change: Vector | None = None
        self.configure(settings, estimate, period)
        self._last, self._sensor = readings.last, readings.sensor
        self._start = np.zeros(n)
        self._duration = self._elapsed = 0.0
        self._usual = ObservedLoad(n, OBSERVER)
        self._calm = ObservedLoad(n, _CALM_OBSERVER)
        self._oscillates = False
        self._known_load = np.zeros(n)
        self._seen = -1  # ns, stamp of the last trusted state that has been observed
        # N m, mean of the torques since the last trusted state, and s, for which they were sent
        self._sent = np.zeros(n)
        self._sent_for = 0.0
        self._effect = CommandEffect(n)
        self._swing = Swing(n)
        self._source = Load.OBSERVED
        self._rested = self._moved = 0.0  # s, in a row, and since it has rested

    def configure(self, settings: Settings, estimate: Vector, period: float) -> None:
        """Use another model from the next torque on."""
        self._settings, self._estimate = settings, estimate
        self.longest_step = period

    @property
    def has_swung(self) -> NDArray[np.bool_]:
        """Whether each joint (n,) has swung under the damping since the ramp began."""
        return self._swing.has_swung

    @property
    def carries(self) -> bool:
        """Whether `load` is what the arm has shown that its commands carry."""
        return self._source in (*_OBSERVED, Load.KEPT)

    def gravity(self, estimate: Vector) -> Vector:
        """Return the torque (n,) [N m] that holds the model of an estimate (m,) at rest."""
        return gravity_torque(self._settings, estimate, self._last.q)

    @property
    def carried(self) -> Vector:
        """The torque (n,) [N m] that holds the arm: gravity and load."""
        return self.gravity(self._estimate) + self.load

    def begin(
        self,
        load: Vector,
        *,
        ramp: float = 0.0,
        source: Load = Load.OBSERVED,
        oscillates: bool = False,
    ) -> None:
        """Begin to hold, with this `load`, by a linear `ramp` [s] from the last torque.

        The load of an arm that `oscillates` is observed more slowly.
        """
        self._begin_observing(load)
        self._known_load[:] = load
        self._effect.restart()
        self._oscillates = oscillates
        self._swing.begin()
        self._source = source
        self._rested = self._moved = self._sent_for = 0.0
        self._start[:] = self.commanded
        self._duration = ramp
        self._elapsed = 0.0

    def yield_to_contact(self) -> None:
        """Give way, with gravity and damping, until the next ramp; observe no load."""
        self.load[:] = self._known_load
        self._source = Load.YIELDS

    def start_observing(self) -> None:
        """Observe the load from now on: it is known that commands reach the arm."""
        if self._source is Load.AWAITED:
            self._source = Load.OBSERVED

    def forget_load(self) -> None:
        """Observe the load from zero on."""
        self._begin_observing(0.0)

    def stop_observing(self) -> None:
        """Return from an observed load to that known at the stop, until `observe_again`."""
        if self._source is Load.OBSERVED:
            self.load[:] = self._known_load
            self._source = Load.REFUTED

    def observe_again(self) -> None:
        """Observe the load from what was known at the stop on, of an arm that sped up before."""
        if self._source is Load.REFUTED:
            self._begin_observing(self._known_load)
            self._source = Load.OBSERVED

    @property
    def is_settled(self) -> bool:
        """Whether the arm rests, as far as its states show, and its load has had time to settle."""
        left_for = self._elapsed - self._duration  # s, since the end of the ramp
        return (
            (self._source is not Load.UNTIL_MOVED or left_for >= _RESTED)
            and self._last.age == 0.0
            and float(np.abs(self._last.dq).max()) < AT_REST
        )

    def leave(self, safety: Safety) -> Vector | None:
        """Return the last torque (n,) [N m]; None before the first usable state.

        It is not damped: a driver may hold it for ever, and a constant torque damps
        nothing.
        """
        self._duration = 0.0
        self._last.dq[:] = self._last.slow[:] = 0.0
        return self.advance(safety, 0.0)

    def advance(self, safety: Safety, dt: float) -> Vector | None:
        """Return the torque (n,) [N m] `dt` [s] later; None before a usable state."""
        last, limit = self._last, self._settings.torque.limit
        if last.age == inf:
            return None
        self.missed_change = None
        self._count_torque(dt)
        M = known_inertia(self._settings, last.q)
        kind = 'hold_gravity' if self._source is Load.YIELDS else safety.torque
        self._keep_load_once_moved(dt)
        is_new = last.stamp != self._seen
        self._seen = last.stamp
        if kind == 'hold_gravity' and is_new:
            self._observe_if_answered(M)
        if last.age > 0.0:
            self._swing.forget()
        elif dt > 0.0:
            noise = self._sensor.noise[: self.load.size]
            self._swing.observe(last.slow, noise, self._sensor.resolution, dt)
        if is_new:
            self._sent_for = 0.0
        goal = self._goal(kind, np.array(safety.damping), M)
        goal = limited(goal, None, limit, limit)
        self._elapsed += dt
        if self._elapsed < self._duration:
            goal = self._start + self._elapsed / self._duration * (goal - self._start)
        before = self.commanded if dt > 0.0 else None
        rate = self._settings.torque.rate_limit
        step = np.where(rate > 0.0, rate * min(dt, self.longest_step), inf)
        self.commanded[:] = limited(goal, before, limit, step)
        return self.commanded

    def observe(self, dt: float) -> None:
        """Update the load by the motion of the last `dt` [s] and its torque, of another."""
        self._swing.begin()
        needed = self._needed()
        if needed is not None:
            M = known_inertia(self._settings, self._last.q)
            self._sent[:] = self.commanded
            self._update_load(needed, dt, M)

    def _count_torque(self, dt: float) -> None:
        """Average the torques since the last trusted state: the last was sent `dt` [s] ago."""
        self._sent_for += dt
        if self._sent_for == dt:
            self._sent[:] = self.commanded
        else:
            self._sent += dt / self._sent_for * (self.commanded - self._sent)

    def _goal(self, kind: str, damping: Vector, M: Vector | None) -> Vector:
        """Return the torque (n,) [N m] of a `kind` that the ramp leads to.

        The `damping` (n,) [N m s/rad] is that of the configuration; with gravity held D is that
        of `braking_matrix`, and smaller while states have gaps (`within_gap`).
        """
        settings, last = self._settings, self._last
        kept = 1.0 if self.carries else max(0.0, 1.0 - last.age / FADE_TIME)
        damping = self._swing.share * damping
        torque = np.zeros(settings.n)
        with np.errstate(over='ignore', invalid='ignore'):  # the caller limits it
            if kind == 'damping':
                borne = within_gap(M, damping, last.gap)
                torque -= borne * last.slow
            if kind == 'hold_gravity':
                D = braking_matrix(M, damping, last.gap)
                torque -= D @ last.slow
                torque += self.gravity(self._estimate) + kept * self.load
                torque -= added_torque(settings.torque, last.q)
        return torque

    def _keep_load_once_moved(self, dt: float) -> None:
        """Return to the load of an arm that has rested out of command, once another moves it.

        It moves for longer then than its load takes to settle: a drift, with its load, ends before.
        """
        if self._source is not Load.UNTIL_MOVED or self._last.age > 0.0:
            return
        if float(np.abs(self._last.slow).max()) <= AT_REST:
            self._moved = 0.0
            self._rested += dt if self._elapsed >= self._duration else 0.0
            if self._rested > _RESTED:
                self._known_load[:] = self.load
            return
        if self._rested > _RESTED or self._moved > 0.0:
            self._moved += dt
        self._rested = 0.0
        if self._moved > _RESTED:
            self.load[:] = self._known_load
            self._source = Load.KEPT

    def _observe_if_answered(self, M: Vector | None) -> None:
        """Observe the load as far as the arm answers to commands, or find that it does not."""
        needed = self._needed() if self._source in _ANSWERING else None
        if needed is None:
            return
        dt = self._last.interval
        if self._source is Load.AWAITED:
            limit = self._settings.torque.limit
            still = self.gravity(self._estimate)
            still -= added_torque(self._settings.torque, self._last.q)
            self._effect.update(needed - still, limit, dt)
            change = self.commanded - self._start
            if self._effect.is_proven:
                self._source = Load.OBSERVED
            elif self._effect.await_effect(change, limit, dt):
                self.missed_change = change
        if self._source in _OBSERVED:
            self._update_load(needed, dt, M)

    def _needed(self) -> Vector | None:
        """Return the command (n,) [N m] behind the last motion; None if unknown."""
        last = self._last
        if last.ddq is None:
            return None
        needed = needed_torque(
            self._settings, self._estimate, last.q, last.dq, last.ddq
        )
        return needed if np.isfinite(needed).all() else None

    def _update_load(self, needed: Vector, dt: float, M: Vector | None) -> None:
        """Update the load, once the arm answers to the damping that a gap had switched off."""
        if not self._last.has_settled:
            return
        limit = self._settings.torque.limit
        lacking = self._sent - needed
        noise = self._noise_of_steps(M)
        for each in (self._usual, self._calm):
            each.update(lacking, limit, dt, noise)
        is_calm = self._oscillates | self._swing.has_swung | (self._rested > _RESTED)
        is_calm |= not self._last.is_measured
        self.load[:] = np.where(is_calm, self._calm.load, self._usual.load)

    def _noise_of_steps(self, M: Vector | None) -> Vector | float:
        """Return the torque (n,) [N m] of the accelerations that the steps of encoders show.

        They are of differences of velocities, and these of positions; 0 without a model.
        """
        last = self._last
        if M is None:
            return 0.0
        averaged = last.interval if last.is_measured else FILTER
        acceleration = self._sensor.resolution / (last.interval * averaged)
        noise: Vector = np.abs(M) @ acceleration
        return noise

    def _begin_observing(self, load: Vector | float) -> None:
        for each in (self._usual, self._calm):
            each.begin(load)
        self.load[:] = load

# SPDX-License-Identifier: Apache-2.0
"""The safe torque from the last usable state, and ramps to it."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from math import inf

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller_groups import Safety
from blf_dsc_controller.law.state import Settings
from blf_dsc_controller.law.torque import added_torque
from blf_dsc_controller.reference.approach import AT_REST
from blf_dsc_controller.supervision.braking import braking_matrix, within_gap
from blf_dsc_controller.supervision.command_effect import CommandEffect
from blf_dsc_controller.supervision.envelope import limited
from blf_dsc_controller.supervision.last_state import LastState
from blf_dsc_controller.supervision.model_torque import gravity_torque, needed_torque
from blf_dsc_controller.supervision.observed_load import OBSERVER, ObservedLoad
from blf_dsc_controller.supervision.reading import Readings
from blf_dsc_controller.supervision.swing import Swing

Vector = NDArray[np.float64]

FADE_TIME = 0.5
"""Time [s] in which the torque fades while no usable state arrives."""

_RESTED = 10.0 / OBSERVER[1]  # s at rest, in which the observed load settles
_CALM_OBSERVER = 10.0, 10.0  # rad/s: slow against the oscillation of elastic joints
# of the damping: an elastic joint that oscillates passes for a light one
_LIGHTEST = 0.5


class Load(Enum):
    """Where the load besides the model comes from."""

    OBSERVED = 'from the motion, since the commands act on the arm'
    UNTIL_MOVED = 'from the motion until the arm has rested and moves again'
    KEPT = 'as the arm rested: another moves it'
    REFUTED = 'as the ramp began: the arm has sped up since'
    YIELDS = 'as the ramp began, to give way to a contact'


def safe_torque(
    safety: Safety,
    settings: Settings,
    last: LastState,
    estimate: Vector,
    load: Vector,
    scale: Vector | float = 1.0,
) -> Vector:
    """Return the safe torque (n,) [N m], within the torque limit and always finite.

    It is zero, damping -D v, or damping plus gravity H(q, 0, 0, 0) P^ and `load` (n,)
    [N m] as far as the drive does not add them, and fades to zero while no usable state
    arrives. D is the configured damping times `scale` (n,), with gravity held that of
    `braking_matrix`; v is the velocity `last.slow`.  While states have gaps D is smaller
    (`within_gap`).
    """
    torque = np.zeros(settings.n)
    if last.age >= FADE_TIME:
        return torque
    with np.errstate(over='ignore', invalid='ignore'):  # checked below
        damping = scale * np.array(safety.damping)
        if safety.torque == 'damping':
            borne = within_gap(settings, damping, last.q, last.gap)
            torque -= borne * last.slow
        if safety.torque == 'hold_gravity':
            torque -= braking_matrix(settings, damping, last.q, last.gap) @ last.slow
            torque += gravity_torque(settings, estimate, last.q) + load
            torque -= added_torque(settings.torque, last.q)
    torque = limited(torque, None, settings.torque.limit, settings.torque.limit)
    return torque * (1.0 - last.age / FADE_TIME)


class SafeTorque:
    """The torque without the law: a ramp from the last torque to the safe torque.

    It obeys the rate limit, except for the last torque of all.

    The load that holds the arm besides the model's gravity is observed from its motion,
    also during the stop (`ObservedLoad`).  So an arm comes to rest with a payload, or with
    a model, that the law had not learned yet.  Estimated friction is not part of the load,
    since friction helps to brake.

    Above its first resonance, an elastic joint accelerates other than a rigid one, and shows
    a wrong load.  An observer with one pole of 30 1/s lets an oscillation go on at up to
    20 rad/s.  Two poles of 10 1/s do not feed an oscillation, but let a load sink further: an
    arm that oscillates at the stop has these, and so has each joint that swings during it, and
    one that has left command and rests.

    If commands do not reach the arm, the observed load would grow for ever.  After a stop that
    may have this cause, the load is kept until the arm accelerates, as it does if commands act
    on it (`CommandEffect`).  So it is while another node may command the arm, and once the
    arm has sped up (`Load`).

    A joint that swings under its damping gets the share of it that it bears (`Swing`).

    Attributes:
        load: torque (n,) [N m] that the model lacks; initially that of the motion before
            (`RecentMotion`), or the disturbance estimate of the law.
        commanded: the last torque (n,) [N m], from the law or this ramp.
        last: the last usable joint state.
        missed_change: change (n,) [N m] of the commands since the stop to which the arm has not
            answered, for the torque that showed it; else None.
        longest_step: time [s] for which one torque may change at the rate limit.
        scale: factor (n,) on the damping: measured inertia of the joints over the assumed; at
            least a half of it is used.
    """

    def __init__(self, readings: Readings) -> None:
        """Hold the arm of these `readings`."""
        n = readings.last.q.size
        self.last = readings.last
        self._sensor = readings.sensor
        self.commanded = np.zeros(n)
        self.load = np.zeros(n)
        self.scale = np.ones(n)
        self.missed_change: Vector | None = None
        self.longest_step = inf
        self._start = np.zeros(n)
        self._duration = self._elapsed = 0.0
        self._usual = ObservedLoad(n, OBSERVER)
        self._calm = ObservedLoad(n, _CALM_OBSERVER)
        self._oscillates = False
        self._known_load = np.zeros(n)
        self._effect = CommandEffect(n)
        self._swing = Swing(n)
        self._reached = True
        self._source = Load.OBSERVED
        self._rested = 0.0  # s, in a row

    @property
    def has_swung(self) -> NDArray[np.bool_]:
        """Whether each joint (n,) has swung under the damping since the ramp began."""
        return self._swing.has_swung

    @property
    def carries(self) -> bool:
        """Whether `load` is what the arm has shown that its commands carry."""
        return (self._observes or self._source is Load.KEPT) and self._reached

    @property
    def _observes(self) -> bool:
        return self._source in (Load.OBSERVED, Load.UNTIL_MOVED)

    def begin_ramp(
        self,
        duration: float,
        load: Vector,
        *,
        source: Load = Load.OBSERVED,
        reached: bool = True,
        oscillates: bool = False,
    ) -> None:
        """Start a linear ramp of `duration` [s] at the last torque, with this `load`.

        If commands may not have `reached` the arm, the load is observed once they have
        an effect; that of an arm that `oscillates` more slowly.
        """
        self._begin_observing(load)
        self._known_load[:] = load
        self._effect.restart()
        self._reached = reached
        self._oscillates = oscillates
        self._swing.begin()
        self._source = source
        self._rested = 0.0
        self._start[:] = self.commanded
        self._duration = duration
        self._elapsed = 0.0

    def yield_to_contact(self) -> None:
        """Give way, with gravity and damping, until the next ramp; observe no load."""
        self.stop_observing()
        self._source = Load.YIELDS

    def start_observing(self) -> None:
        """Observe the load from now on: it is known that commands reach the arm."""
        self._reached = True

    def forget_load(self) -> None:
        """Observe the load from zero on."""
        self._begin_observing(0.0)

    def stop_observing(self) -> None:
        """Return to the load that was known at the stop, until the next ramp."""
        self.load[:] = self._known_load
        self._source = Load.REFUTED

    @property
    def is_settled(self) -> bool:
        """Whether the ramp is over and the arm at rest, as far as its states show."""
        is_over = self._elapsed >= self._duration
        return (
            is_over
            and self.last.age == 0.0
            and float(np.abs(self.last.dq).max()) < AT_REST
        )

    def leave(
        self, safety: Safety, settings: Settings, estimate: Vector
    ) -> Vector | None:
        """Return the last torque (n,) [N m]; None before the first usable state.

        It is not damped: a driver may hold it for ever, and a constant torque damps
        nothing.
        """
        self._duration = 0.0
        self.last.dq[:] = self.last.slow[:] = 0.0
        return self.advance(safety, settings, estimate, 0.0)

    def advance(
        self, safety: Safety, settings: Settings, estimate: Vector, dt: float
    ) -> Vector | None:
        """Return the torque (n,) [N m] `dt` [s] later; None before a usable state."""
        if self.last.age == inf:
            return None
        self.missed_change = None
        if self._source is Load.YIELDS:
            safety = replace(safety, torque='hold_gravity')
        self._keep_load_once_moved(dt)
        if safety.torque == 'hold_gravity' and self._observes:
            needed = self._needed(settings, estimate)
            if needed is not None:
                self._observe_if_proven(settings, estimate, needed, dt)
        if self.last.age > 0.0:
            self._swing.forget()
        elif dt > 0.0:
            noise = self._sensor.noise[: self.load.size]
            self._swing.observe(self.last.slow, noise, self._sensor.resolution, dt)
        scale = self._swing.share * np.maximum(self.scale, _LIGHTEST)
        goal = safe_torque(safety, settings, self.last, estimate, self.load, scale)
        self._elapsed += dt
        if self._elapsed < self._duration:
            goal = self._start + self._elapsed / self._duration * (goal - self._start)
        last = self.commanded if dt > 0.0 else None
        step = settings.torque.rate_limit * min(dt, self.longest_step)
        step = np.where(settings.torque.rate_limit > 0.0, step, inf)
        self.commanded[:] = limited(goal, last, settings.torque.limit, step)
        return self.commanded

    def _keep_load_once_moved(self, dt: float) -> None:
        """Observe the load of an arm that has left command until it has rested, and moves again."""
        if self._source is not Load.UNTIL_MOVED or self.last.age > 0.0:
            return
        moves = float(np.abs(self.last.slow).max()) > AT_REST
        if moves and self._rested > _RESTED:
            self._source = Load.KEPT
        is_over = self._elapsed >= self._duration
        self._rested = self._rested + dt if is_over and not moves else 0.0

    def observe(self, settings: Settings, estimate: Vector, dt: float) -> None:
        """Update the load by the motion of the last `dt` [s] and its torque, of another."""
        self._swing.begin()
        needed = self._needed(settings, estimate)
        if needed is not None:
            self._update_load(settings, needed, dt)

    def _observe_if_proven(
        self, settings: Settings, estimate: Vector, needed: Vector, dt: float
    ) -> None:
        if not self._reached:
            still = gravity_torque(settings, estimate, self.last.q)
            still -= added_torque(settings.torque, self.last.q)
            limit = settings.torque.limit
            self._effect.update(needed - still, limit, dt)
            self._reached = self._effect.is_proven
            change = self.commanded - self._start
            if not self._reached and self._effect.await_effect(change, limit, dt):
                self.missed_change = change
        if self._reached:
            self._update_load(settings, needed, dt)

    def _needed(self, settings: Settings, estimate: Vector) -> Vector | None:
        """Return the command (n,) [N m] behind the last motion; None if unknown."""
        last = self.last
        if last.ddq is None:
            return None
        needed = needed_torque(settings, estimate, last.q, last.dq, last.ddq)
        return needed if np.isfinite(needed).all() else None

    def _update_load(self, settings: Settings, needed: Vector, dt: float) -> None:
        limit = settings.torque.limit
        lacking = self.commanded - needed
        for each in (self._usual, self._calm):
            each.update(lacking, limit, dt)
        is_calm = self._oscillates | self._swing.has_swung | (self._rested > _RESTED)
        self.load[:] = np.where(is_calm, self._calm.load, self._usual.load)

    def _begin_observing(self, load: Vector | float) -> None:
        for each in (self._usual, self._calm):
            each.begin(load)
        self.load[:] = load

# SPDX-License-Identifier: Apache-2.0
"""The pole of the load observer: the fastest stable one of the measured arm, in every posture.

An arm with joint torque sensors has a second loop, r (`law.load_observer`).  At the torques of
all joints, with the measured response G_e of the efforts and the inertia M_l of the model's links,

    L = C_y G_y + C_v G_v - F_L (F_s G_e - M_l D G_v)

F_L is the pole, F_s the lag of velocities, which efforts wait for, and D the difference quotient
of a sample.  As r is faster, I + L comes nearer to being singular where gears resonate: an arm
whose r oscillates has hardly a modulus margin there.  So poles are tried from slow to fast while
`ENOUGH` is left, and `BARELY` with noise counted against it.  That is less than the gains alone
must have, since r that oscillates all the same is left out, and a slow r costs accuracy.

Below `RESONANT`, r makes an arm that holds an unknown load as light as the model: of its torque
no more than M_l / M is left, by design, whatever the pole.  There `BARELY` is enough, noise not
counted: r is stable for any load while gears are stiff.

Efforts must be those of sensors at the links first.  Where gears are stiff, those of the joint
that the motion moves are M_l D V: on random arms the difference has at most a quarter of their
square, and a hundredth as a rule; of efforts in another unit, of another sign or joint it has
more than half.  Commands are U, a few samples late, and nothing else.

Poles end with `POLES`: a faster one gains little and hands the noise of velocities to the torque.
At 300 rad/s a Panda's error at a pick-up is 6.0 instead of 6.8 mrad, but its r, which noise moves
by 0.6 N m rms, is taken for one that oscillates and left out within 8 s; at 200 rad/s not in 300 s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import JointGains
from blf_dsc_controller.arms.linear_loop import SLOWEST, low_pass
from blf_dsc_controller.commissioning.margin import (
    BARELY,
    Loops,
    Margin,
    SingularValues,
    singular_values,
)
from blf_dsc_controller.commissioning.response import Response, Sensed

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

POLES = (10.0, 16.0, 25.0, 40.0, 60.0, 100.0, 150.0, 200.0)
"""Poles of r [rad/s] that are tried, from slow to fast."""

ENOUGH = 0.25
"""Modulus margin that r leaves where gears resonate, noise not counted."""

RESONANT = 20.0
"""Frequency [Hz] from which on gears may resonate."""

_UNLIKE = 0.5  # share of the square of efforts that M_l D V may leave
_AS_COMMANDS = 0.01  # of that, what efforts that are commands leave beside U
_LATEST = 3  # samples, by which these may be late


class ObserverPole(NamedTuple):
    """The chosen pole, and what limits it."""

    pole: float  # L, rad/s; 0: none
    margin: Margin  # with it, or with the slowest that is tried, where gears resonate
    why_none: str = ''  # of efforts that are no torques of the links
    noise_hides: bool = False  # whether noise alone speaks against a faster one


class _Left(NamedTuple):
    """The modulus margins that a pole leaves."""

    resonant: Margin  # from `RESONANT` on, noise not counted
    with_noise: float  # the same with noise counted
    below: float  # below `RESONANT`, noise not counted


class SensedLoops(NamedTuple):
    """Measured arms in k postures, and r by its pole."""

    loops: Loops
    sensed: tuple[Sensed, ...]  # of each of the loops' responses
    links: Floats  # M_l (k, n, n), kg m^2
    sensor_lag: float  # of velocities, s

    def singular_values(self, gains: JointGains, pole: float) -> list[SingularValues]:
        """Return the least singular values of I + L in each posture."""
        of_each = zip(self.loops.responses, self.sensed, self.links, strict=True)
        return [self._singular_values(*each, gains, pole) for each in of_each]

    def fastest_pole(self, gains: JointGains) -> ObserverPole:
        """Return the fastest pole that is borne, with all that are slower.

        0 if none is, or if the efforts are not those of sensors at the links.
        """
        chosen = ObserverPole(0.0, self._left(gains, POLES[0]).resonant)
        if why := self.why_no_sensors:
            return chosen._replace(why_none=why)
        for pole in POLES:
            left = self._left(gains, pole)
            is_borne = left.resonant.value >= ENOUGH and left.below >= BARELY
            if not is_borne or left.with_noise < BARELY:
                return chosen._replace(noise_hides=is_borne)
            chosen = ObserverPole(pole, left.resonant)
        return chosen

    @property
    def why_no_sensors(self) -> str:
        """Why efforts cannot be those of sensors at the links; empty if they can.

        By the posture that speaks for it most: in another one, the arm may hold a load.
        """
        unlike, as_commands = np.array(
            [
                self._unlike(*each)
                for each in zip(
                    self.loops.responses, self.sensed, self.links, strict=True
                )
            ]
        ).T
        if as_commands.max() < _AS_COMMANDS:
            return 'efforts are the commands, a few samples late'
        if unlike.min() > _UNLIKE:
            return (
                'efforts do not move the links: '
                f'{100.0 * min(float(np.sqrt(unlike.min())), 1.0):.0f} % of them or more are '
                'not the torque of these'
            )
        return ''

    def _unlike(
        self, response: Response, sensed: Sensed, links: Floats
    ) -> tuple[float, float]:
        """Return how unlike M_l D V efforts are, and how much more so U: means of the joints."""
        T, f = self.loops.sample_time, response.frequency
        rows = response.seen & (f >= SLOWEST) & (f < RESONANT)
        z: Complex = np.exp(2j * np.pi * f[rows] * T)
        effort = np.diagonal(sensed.effort[rows], axis1=1, axis2=2)
        moving = ((1.0 - 1.0 / z) / T)[:, None, None] * links @ response.velocity[rows]
        late = effort * self._late(z)[:, None]
        left = _square(late - np.diagonal(moving, axis1=1, axis2=2))
        of_commands = min(
            _mean(_square(effort - (z**-k)[:, None]) / left) for k in range(_LATEST + 1)
        )
        return _mean(left / _square(late)), of_commands

    def _late(self, z: Complex) -> Complex:
        """Return the response (f,) of the lag of velocities."""
        if self.sensor_lag == 0.0:
            return np.ones_like(z)
        return low_pass(np.exp(-self.loops.sample_time / self.sensor_lag), z)

    def _left(self, gains: JointGains, pole: float) -> _Left:
        """Return the margins that a pole leaves, over all postures."""
        resonant, with_noise, below = [], [], []
        for k, (response, values) in enumerate(
            zip(self.loops.responses, self.singular_values(gains, pole), strict=True)
        ):
            f, seen = response.frequency, response.seen
            counts = seen & (f >= RESONANT)
            resonant.append(values.margin(f, counts, k, noise=False))
            with_noise.append(values.margin(f, counts, k).value)
            rigid = seen & (f >= SLOWEST) & (f < RESONANT)
            below.append(values.margin(f, rigid, k, noise=False).value)
        return _Left(min(resonant), min(with_noise), min(below))

    def _singular_values(
        self,
        response: Response,
        sensed: Sensed,
        links: Floats,
        gains: JointGains,
        pole: float,
    ) -> SingularValues:
        """Return them in one posture, with M_l (n, n) of the `links`."""
        T = self.loops.sample_time
        z: Complex = np.exp(2j * np.pi * response.frequency * T)
        quotient = (1.0 - 1.0 / z) / T
        F_L = low_pass(np.exp(-T * pole), z)
        # r from [effort; velocity]
        of_effort = (F_L * self._late(z))[:, None, None] * np.eye(len(links))
        of_velocity = -(F_L * quotient)[:, None, None] * links
        C_y, C_v = self.loops.law(response, gains)
        L = C_y @ response.position + (C_v - of_velocity) @ response.velocity
        L -= of_effort @ sensed.effort
        position, velocity = response.deviations()
        dL = np.abs(C_y) @ position + np.abs(C_v) @ velocity
        dL += self._deviation(response, sensed, np.dstack((of_effort, of_velocity)))
        return singular_values(L, dL, response.shared)

    def _deviation(
        self, response: Response, sensed: Sensed, of_both: Complex
    ) -> Floats:
        """Return the standard deviations (f, n, n) of r by torques."""
        variance = np.einsum(
            'fia,fab,fib->fi', of_both, sensed.noise, of_both.conj(), optimize=True
        ).real
        own = np.sqrt(variance.clip(0.0))
        return np.asarray(own[:, :, None] * response.columns[:, None, :])


def _square(values: Complex) -> Floats:
    """Return the sum of squares (n,) over the frequencies (f, n), a little above zero."""
    return np.asarray((np.abs(values) ** 2).sum(axis=0) + 1e-9)


def _mean(values: Floats) -> float:
    """Return the geometric mean over the joints."""
    return float(np.exp(np.log(values).mean()))

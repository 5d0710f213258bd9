# SPDX-License-Identifier: Apache-2.0
"""An arm whose motors close a PD of their own, from frames that come at the host's rate.

Between two frames the motors compute, at their own rate and from their own encoders,
tau = kp (q_f - q) + kd (dq_f - dq) + t (`motors.frame`), cut at the range of the torque.
The arm is the plant of a configuration, whose encoders and drives are then those of the
motors: `sensor.side`, `sensor.resolution` and `sensor.velocity_pole` are what the motors
see, `actuator.torque_limit` what they bear.  What the host sees of it is rounded once
more, to the fields of a frame.  `actuator.delay` counts frames on the bus.

The last frame is held: a host that dies leaves the motors with it.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.motors.frame import Frame, Ranges
from sim_plant.plant import plant_of

Vector = NDArray[np.float64]

RATE = 10_000.0
"""Rate of the motors' own loop [Hz]."""

IN_REAL_TIME = 2000.0
"""Rate of simulated motors in real time [Hz]: Python is no faster."""


class MotorPlant:
    """A simulated arm with such motors: call `measure()`, then `step(frame)`, in turn.

    Attributes:
        plant: the arm, sampled at the rate of the motors.
        config: its configuration.
        per_frame: samples of the motors in a period of the host.
        frames: frames so far, which is the time in periods of the host.
    """

    def __init__(
        self,
        config: PlantConfig,
        ranges: Ranges,
        rate: float = RATE,
        *,
        as_reported: bool = False,
    ) -> None:
        """Build the arm of a configuration, at the sample time of its host.

        `as_reported`: the motors know no more than they report, rounded to a frame.

        Raises:
            BlfDscError: the motors' rate is no multiple of the host's.
        """
        self.per_frame = round(config.sample_time * rate)
        if abs(self.per_frame - config.sample_time * rate) > 1e-6 * self.per_frame:
            raise BlfDscError(
                f'sample_time: got {config.sample_time:g} s, but motors at {rate:g} Hz need a '
                f'multiple of {1.0 / rate:g} s'
            )
        own = {'sample_time': config.sample_time / self.per_frame, 'actuator.delay': 0}
        self.config = change(config, own)
        self.plant = plant_of(self.config)
        self.ranges = ranges
        self._as_reported = as_reported
        n = len(config.joints)
        self._last = Frame(*np.zeros((5, n)))
        self._on_the_bus = deque([self._last] * config.actuator.delay)
        self.frames = 0

    def measure(self) -> Vector:
        """Return [q, dq, torque] (3, n) as the motors report them: rounded, and cut."""
        q, dq, effort = self._own()
        ranges = self.ranges
        return np.array(
            [
                ranges.position.nearest(q),
                ranges.velocity.nearest(dq),
                ranges.torque.nearest(effort),
            ]
        )

    def step(self, frame: Frame) -> None:
        """Send a frame, and advance by a period of the host."""
        self._last = frame
        self._on_the_bus.append(frame)
        self.advance(self._on_the_bus.popleft(), self.per_frame)
        self.frames += 1

    def coast(self) -> None:
        """Advance by a period of a host that sends nothing."""
        self.step(self._last)

    def advance(self, frame: Frame, samples: int) -> None:
        """Advance by samples of the motors, in which they have a frame."""
        for _ in range(samples):
            q, dq, _ = self.measure() if self._as_reported else self._own()
            self.plant.step(self.ranges.torque.cut(frame.torque_at(q, dq)))

    def _own(self) -> Vector:
        """Return [q, dq, torque] (3, n) as the motors know them."""
        return np.asarray(self.plant.measure().reshape(3, -1))

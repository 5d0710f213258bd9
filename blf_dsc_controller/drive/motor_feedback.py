# SPDX-License-Identifier: Apache-2.0
"""The law's feedback inside the motors' own PD: a frame for each torque.

The part of the feedback that a PD can do goes to the motors, which close it without the
delay of a bus, from encoders that no frame rounds.  The rest of the law's torque is
their feed-forward.  The law itself computes, learns and records the same torque as
without.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plausibility import STIFFNESS
from blf_dsc_controller.configuration.rules import When
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.law.local_gains import LocalGains
from blf_dsc_controller.motors.frame import Frame, Gains, Motion, Ranges, split
from blf_dsc_controller.warnings.table import config_warnings

Vector = NDArray[np.float64]
# s, with which the gains that the maker of a YAM runs in its motors are stable
_SAMPLE, _LAG = 0.001, 0.0005


def as_in_motors(config: ControllerConfig) -> ControllerConfig:
    """Return a configuration whose margins are those of its feedback inside the motors.

    They close it at 10 kHz or more, without a bus.  A sample of at most 1 ms and a lag of half of
    one leave room for how they find their velocities.
    """
    fast = {
        'sample_time': min(config.sample_time, _SAMPLE),
        'robot.lag': min(config.robot.lag, _LAG),
    }
    return change(config, fast)


def robot_warnings(config: ControllerConfig, *, in_motors: bool) -> list[str]:
    """Return the warnings before a robot moves, whose motors may close the feedback."""
    loop = as_in_motors(config) if in_motors else config
    return config_warnings(loop, When.START | When.ROBOT, in_motors=in_motors)


def closed_in_motors(config: ControllerConfig) -> ControllerConfig:
    """Return a configuration whose gains are not those of a loop over the bus.

    They are as high as is stable in the motors.
    """
    return change(config, {'insist': (*config.insist, STIFFNESS)})


class MotorFeedback:
    """Frames for motors with a PD of their own.

    Attributes:
        ranges: what a frame can carry.
    """

    def __init__(
        self, controller: ArmController, ranges: Ranges, latency: float
    ) -> None:
        """Prepare for motors that act on a frame `latency` [s] after the state behind it.

        Raises:
            BlfDscError: the law is one of a file, whose feedback is not known.
        """
        self.ranges = ranges
        self._guard = controller.guard
        self._ahead = latency + 0.5 * controller.config.sample_time
        self._gains = LocalGains(self._guard.controller)
        n = len(controller.joints)
        self._nothing = Motion(np.zeros(n), np.zeros(n))

    def frame(self, torque: Vector) -> Frame:
        """Return the frame for the torque (n,) [N m] of the last state.

        In a safe stop it damps, by `safety.damping`, and holds no position.
        """
        guard = self._guard
        signals = guard.controller.signals
        if not guard.has_sample:
            return self._stopping(torque)
        later = guard.controller.reference_at(guard.reference.time + self._ahead)
        return split(
            torque,
            Motion(signals.q, signals.dq),
            Motion(signals.qr, signals.dqr),
            Motion(later[0], later[1]),
            Gains(*self._gains.evaluate()),
            self.ranges,
        )

    def _stopping(self, torque: Vector) -> Frame:
        guard = self._guard
        safety = guard.config.safety
        damping = np.array(safety.damping)
        if safety.torque == 'zero':
            damping[:] = 0.0
        measured = Motion(guard.readings.last.q, guard.readings.last.slow)
        here = Motion(measured.q, self._nothing.dq)
        gains = Gains(self._nothing.q, damping)
        return split(torque, measured, here, here, gains, self.ranges)

# SPDX-License-Identifier: Apache-2.0
"""The cause of a stop, where an arm left its bound or did not follow its commands.

It may be an oscillation, a torque that only repeats the noise of a sensor, or a torque at its
limit.  Each has a remedy of its own, which is not that of the check that stops the arm.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.torque import RATE_CUT
from blf_dsc_controller.supervision.oscillation_check import OscillationCheck

_CHATTER = 0.11  # of the torque limit; 20 bits leave a Panda 0.01, 16 bits 0.13
# of the sensor's noise: a step that is larger makes it, a sum of others hides one
_STEPPED = 1.5
_SATURATED = 0.05  # s: brakes that close in motion leave the bound sooner


def chatter_of(controller: Controller, config: ControllerConfig) -> str:
    """Return what to do about a torque that changes much in each sample; empty if it does not."""
    checks = controller.checks
    limit = controller.settings.torque.limit
    steps = np.sqrt(checks.effect.chatter)
    worst = int(np.argmax(steps / limit))
    if not steps[worst] > _CHATTER * limit[worst]:
        return ''
    units = config.units[worst]
    step = float(checks.sensor.resolution[worst])
    is_stepped = step > _STEPPED * float(np.sqrt(checks.sensor.noise[worst]))
    why = (
        f'its positions come in steps of {1e3 * step:.2g} {units.of("mrad")}, and its velocity '
        'with them'
        if is_stepped
        else 'its measured velocity is noisy, or the gains are too high for its drive'
    )
    return (
        f'the torque of {config.joints[worst]} changes by {steps[worst]:.2g} {units.torque} rms '
        f'each sample: {why}. Lower the pole of the velocity filter and add its lag to '
        'robot.lag, which makes the gains softer'
    )


class StopCause:
    """Finds the cause of a stop that is about to follow."""

    def __init__(
        self,
        config: ControllerConfig,
        controller: Controller,
        oscillation: OscillationCheck,
    ) -> None:
        self._config = config
        self._controller = controller
        self._oscillation = oscillation
        self._limited = 0  # number of the joint that was last at its limit

    def take_limited(self, joint: int) -> None:
        """Take note of the joint that needs more than its torque limit."""
        self._limited = joint

    @property
    def oscillation(self) -> str:
        """What oscillates, and the remedy; empty if nothing does."""
        return self._oscillation.cause

    @property
    def vibration(self) -> str:
        """What oscillates or chatters, and the remedy; empty if nothing does."""
        return self.oscillation or chatter_of(self._controller, self._config)

    def text(self, saturated_time: float) -> str:
        """Return the cause, and the remedy; empty if it is unknown.

        A torque has been at its limit for `saturated_time` [s].
        """
        return self.vibration or self.saturation(saturated_time)

    def saturation(self, time: float) -> str:
        """Return which joint has lacked torque for long, `time` [s]; empty if none has."""
        if time < _SATURATED:
            return ''
        settings = self._controller.settings
        i = self._limited
        demands = (
            f'joint {self._config.joints[i]!r} has demanded more than its torque limit of '
            f'{settings.torque.limit[i]:g} {self._config.units[i].torque} for {time:.2g} s'
        )
        if self._controller.signals.saturation.cuts[i] >= RATE_CUT:
            return (
                f'{demands}, and torque.rate_limit delays what it gets: raise it to what the drive '
                'tolerates, or lower the gains'
            )
        remedies = 'follow a slower reference, carry less, or give the true limit as torque.limit'
        if self._controller.checks.effect.compares[0] == 0.0:  # no effort proves it
            remedies += '; a drive that gives less than it is sent demands more, too'
        return f'{demands}: {remedies}'

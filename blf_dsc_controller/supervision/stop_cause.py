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


def saturation_of(
    controller: Controller, config: ControllerConfig, joint: int, time: float
) -> str:
    """Return that a joint has lacked torque for long, `time` [s]; empty if it has not."""
    if time < _SATURATED:
        return ''
    demands = (
        f'joint {config.joints[joint]!r} has demanded more than its torque limit of '
        f'{controller.settings.torque.limit[joint]:g} {config.units[joint].torque} for '
        f'{time:.2g} s'
    )
    if controller.signals.saturation.cuts[joint] >= RATE_CUT:
        return (
            f'{demands}, and torque.rate_limit delays what it gets: raise it to what the drive '
            'tolerates, or lower the gains'
        )
    remedies = (
        'follow a slower reference, carry less, or give the true limit as torque.limit'
    )
    if controller.checks.effect.compares[0] == 0.0:  # no effort proves it
        remedies += '; a drive that gives less than it is sent demands more, too'
    return f'{demands}: {remedies}'

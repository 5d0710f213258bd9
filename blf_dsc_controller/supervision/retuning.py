# SPDX-License-Identifier: Apache-2.0
"""New gains for a running law: what cannot be taken now, and the change without a bump.

At the moment of a change the errors stay what they are while the gains on them jump, and so would
the torque. Two memories of the law take up the difference: the surface filter is moved along with
the virtual control, so that alpha2' goes on as it was, and the disturbance estimate, the integrator
of the law, gives what is left. It then finds its own value again at the speed of its gain; a joint
whose gain is 0 has no integrator, and its torque steps.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.compiled.layout import pack
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law import factory as assembly
from blf_dsc_controller.law import funnel
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.settings import LINEAR

Vector = NDArray[np.float64]
_STABLE = 2.0  # of a step along a rate: x += -a x diverges from a = 2 on


def take(controller: Controller, config: ControllerConfig) -> None:
    """Put a configuration in force."""
    controller.settings_vector[:] = pack(assembly.settings_of_config(config))


def transfer(
    controller: Controller, config: ControllerConfig, t: float, measurement: Vector
) -> None:
    """Put a configuration in force such that the torque for the last measurement stays.

    Args:
        controller: between two samples.
        config: to be put in force.
        t: time of the last sample [s].
        measurement: what it was answered to, (3 n,).
    """
    before_beta2, before = _trial(controller, t, config.sample_time, measurement)
    take(controller, config)
    state = controller.state
    if controller.settings.surface != LINEAR:
        after_beta2, _ = _trial(controller, t, config.sample_time, measurement)
        state.alpha2[:] += after_beta2 - before_beta2
    step = _trial(controller, t, config.sample_time, measurement)[1] - before
    integrates = controller.settings.gamma > 0.0
    state.disturbance[integrates] -= step[integrates]


def _trial(
    controller: Controller, t: float, dt: float, measurement: Vector
) -> tuple[Vector, Vector]:
    """beta2 and demanded torque for a measurement, without leaving a trace in the state."""
    saved = controller.save()
    controller.update(t, dt, measurement)
    controller.restore(saved)
    return controller.signals.beta2.copy(), controller.signals.demand.copy()


def objections(controller: Controller, config: ControllerConfig, t: float) -> list[str]:
    """Why a running law cannot take a valid configuration at the time t [s], a sentence each."""
    return [
        *_bound_objections(controller, config, t),
        *_torque_objections(controller, config),
        *_learning_objections(controller, config),
    ]


def _bound_objections(controller: Controller, config: ControllerConfig, t: float) -> Iterator[str]:
    errors = np.abs(controller.sample.xi1)
    funnel.narrow(assembly.settings_of_config(config), controller.signals, t)
    for joint, error, bound in zip(config.joints, errors, controller.signals.bound, strict=True):
        if not error < bound:
            yield (
                f'barrier.bound: {joint} is {error:.6g} rad from its reference now, outside of a '
                f'bound of {bound:g} rad: ask for a wider one, or again once the error is smaller'
            )


def _torque_objections(controller: Controller, config: ControllerConfig) -> Iterator[str]:
    torques = np.abs(controller.sample.torque)
    for joint, torque, limit in zip(config.joints, torques, config.torque.limit, strict=True):
        if torque > limit:
            yield (
                f'torque.limit: {joint} is held with {torque:.4g} N m now, more than a limit of '
                f'{limit:g} N m: ask for a higher one'
            )


def _learning_objections(controller: Controller, config: ControllerConfig) -> Iterator[str]:
    state, p = controller.state, controller.settings.p
    learning = config.learning
    norm = float(np.linalg.norm(state.estimate[:p]))
    if norm > learning.radius:
        yield (
            f'learning.radius: the estimate is at {norm:.4g} kg m^2 now, outside of a ball of '
            f'{learning.radius:g} kg m^2: ask for a larger one'
        )
    if state.latched[0] == 0.0:
        return
    gain = max(*learning.adaptation_gain, assembly.COLUMN_GAIN if len(state.estimate) > p else 0.0)
    stretch = 1.0 if learning.update == 'newton' else float(np.linalg.norm(state.Phi, 2))
    step = learning.weight * gain * stretch * config.sample_time
    if step >= _STABLE:
        yield (
            f'learning.weight: with the update {learning.update}, each sample would correct the '
            f'estimates by {step:.3g} times their error, which diverges from {_STABLE:g} on: lower '
            'learning.weight or learning.adaptation_gain'
        )

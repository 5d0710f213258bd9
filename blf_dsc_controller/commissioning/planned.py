# SPDX-License-Identifier: Apache-2.0
"""The motions by which an arm from a URDF is measured, and with which gains."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import BESIDE, JointGains, unknown_arm
from blf_dsc_controller.commissioning.chosen import as_parameters, with_gains
from blf_dsc_controller.commissioning.motion import (
    BEAT,
    SETTLING,
    Excitation,
    excitation,
)
from blf_dsc_controller.commissioning.run_parameters import shaking_parameters
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.configuration.plausibility import hint_at_degrees
from blf_dsc_controller.configuration.schema import Value, change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.run import SLIDING, TURNING, JointUnits
from blf_dsc_controller.warnings.reference_load import along

Floats = NDArray[np.float64]

TORQUE = 0.03
"""Torque of the motion, rms, as a share of the rated one."""
TRAVEL = 0.01
"""How far the tool may travel in the motion, from its middle [m]."""
POSTURES = 3
"""Postures of the reference in which an arm is measured, if nothing else is asked for."""

_SAME = 0.01  # rad or m, between postures that show the same

FROM_LIMITS = {TURNING: 0.05, SLIDING: 2.0 * TRAVEL}  # rad or m


class Planned(NamedTuple):
    """A motion to run, and how far it goes."""

    config: ControllerConfig
    # parameters of `config` that differ from those of the arm in use
    values: dict[str, object]
    posture: Floats  # (n,) rad
    excitation: Excitation
    share: float = 1.0  # of the gains of the arm in use
    torque: float = TORQUE  # rms, as a share of the rated one, at most

    @property
    def duration(self) -> float:
        """Time [s] that a run needs, a little more than the period that counts.

        Swings end where they vanish.
        """
        more = BEAT if self.excitation.sliding else 0.5
        return SETTLING + self.excitation.period + more


def postures_of(
    config: ControllerConfig, count: int = POSTURES, here: Floats | None = None
) -> Floats:
    """Return postures (count, n) [rad] that the configured reference visits.

    One to hold visits only `here` (n,) [rad], where the arm is. Raises BlfDscError if it
    is not known.
    """
    if config.reference.type == 'hold':
        if here is None:
            raise BlfDscError(
                'reference.type: got hold, with which the arm stays where it begins: give the '
                'postures in which to measure it (--posture, in rad or m), or a reference '
                'that moves'
            )
        return here[None]
    found = np.asarray(along(config, count)[0])
    distances = np.abs(found[:, None] - found).max(axis=2)
    if distances[np.triu_indices(count, 1)].min(initial=np.inf) > _SAME:
        return found
    # One tone, all joints in phase: an arm passes its postures again on the way back.
    return np.asarray(along(config, 4 * count)[0][1::4])


def plan(
    config: ControllerConfig,
    posture: Floats,
    *,
    torque: float,
    travel: float,
    sliding: bool,
    share: float,
) -> Planned:
    """Return the motion around a posture (n,) [rad] by which an arm is measured.

    `sliding` adds swings that keep joints sliding which would stick without.  The arm has a
    `share` of the gains of the configuration.

    Raises BlfDscError if the arm is not from a URDF, or if its feedback acts through the
    inertia matrix, which may make an arm with elastic joints unstable.
    """
    if config.model != 'urdf':
        raise BlfDscError(
            'robot.urdf: got none, but commissioning needs an arm from a URDF'
        )
    if config.feedback.inertia != 'none':
        raise BlfDscError(
            f'feedback.inertia: got {config.feedback.inertia}, but an arm is measured with '
            'gains of its joints, each on its own: give none'
        )
    gains = softer(config, share)
    arm = with_gains(config, gains) if gains else config
    _check_posture(config, posture)
    tones = excitation(arm, posture, torque, travel, sliding=sliding)
    values = {**gains, **shaking_parameters(arm, tones, posture)}
    return Planned(change(arm, values), values, posture, tones, share, torque)


def softer(config: ControllerConfig, share: float) -> dict[str, Value]:
    """Return a share of the gains of the measurement, by dotted name: none, if it is all."""
    if share == 1.0:
        return {}
    gains = measuring_gains(config).scaled(share)
    return as_parameters(gains.stiffness, gains.damping)


def measuring_gains(config: ControllerConfig) -> JointGains:
    """Return the gains with which an arm is measured."""
    arm, _ = design_of(config)
    gains = arm.joints or unknown_arm(arm.rotors)
    lag = np.array(config.feedback.lags(len(config.joints)))
    return gains.scaled(arm.stiffness)._replace(
        damping_lag=lag, integral_fraction=BESIDE
    )


def _check_posture(config: ControllerConfig, posture: Floats) -> None:
    n = len(config.joints)
    if posture.shape != (n,):
        raise BlfDscError(
            f'posture: got {posture.size} angles, but the arm has {n} joint{"s" * (n > 1)}'
        )
    limits = zip(
        config.joints,
        config.units,
        posture,
        config.limits.position_lower,
        config.limits.position_upper,
        strict=True,
    )
    for joint, units, at, lower, upper in limits:
        away = FROM_LIMITS[units]
        if not lower + away <= at <= upper - away:
            raise BlfDscError(
                f'posture: {joint} would be at {at:.4g} {units.position}, '
                f'{_beyond(float(at), lower, upper, units)}'
            )


def _beyond(at: float, lower: float, upper: float, units: JointUnits) -> str:
    """Return how a position is past or near the limits of its joint, with a hint at degrees."""
    unit = units.position
    limits = f'its limits, {lower:g} to {upper:g} {unit}'
    if lower <= at <= upper:
        return f'less than {FROM_LIMITS[units]:g} {unit} from {limits}'
    hint = hint_at_degrees(at, lower, upper) if units == TURNING else ''
    return f'beyond {limits}{hint}'

# SPDX-License-Identifier: Apache-2.0
"""The configuration with which an arm is measured again, by what its first run shows.

If only the URDF is known, motors are guessed, friction is unknown, and the gains are soft enough
for any arm.  Joints then stick, and show neither their inertia nor how late torques are; gains for
the guessed inertia may be a tenth of what is stable.  So the first posture is measured again:
with half of the gains that are stable by the first run, and with the friction of that run
compensated.  The joints slide, and show more.

Gains that a configuration gives, or that follow from the stiffness of its gears, stay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import JointGains
from blf_dsc_controller.commissioning.chosen import as_parameters, with_gains
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.configuration.schema import Value, flatten

Floats = NDArray[np.float64]

MOST_ANEW = 2
"""How often the first posture is measured again with a better configuration, at most."""

FAR_ABOVE = 5.0
"""Times the gains of a measurement, above which friction may act otherwise on the chosen ones."""

ABOVE_IF_HIDDEN = 2.5
"""The same, where friction hides an inertia: half of such gains may show it."""

_SHARE = 0.5  # of the gains with which an arm is stable, to measure it with
_OF_STUCK = 2.0  # times those of the measurement: friction damps what is measured
_NAMES = (
    'robot.coulomb',
    'robot.lag',
    'robot.rotor_inertia',
    'feedback.joint_stiffness',
    'feedback.joint_damping',
)


def is_known_by_urdf_only(config: ControllerConfig) -> bool:
    """Whether gains are neither given nor follow from gears: they suit guessed motors only."""
    given = config.feedback
    return (
        config.model == 'urdf'
        and given.inertia == 'none'
        and not given.joint_stiffness
        and design_of(config)[1] is None
    )


def known_friction(config: ControllerConfig) -> Floats:
    """Return the dry friction (n,) [N m] that the law compensates."""
    robot = config.robot
    return np.array(robot.friction(robot.chain(config.joints))['coulomb'])


def better_configuration(
    config: ControllerConfig,
    found: dict[str, Value],
    start: JointGains,
    friction: Floats,
    sticks: NDArray[np.bool_],
) -> ControllerConfig:
    """Return the configuration with which to measure an arm again.

    By runs with `config` the parameters `found` and the `friction` (n,) [N m] are known; `start`
    are the gains of these runs.  Those of a joint that `sticks` (n,) at most double.
    """
    chosen = np.array(
        [found['feedback.joint_stiffness'], found['feedback.joint_damping']]
    )
    measured = np.array([start.stiffness, start.damping])
    most = np.where(sticks, _OF_STUCK * measured, np.inf)
    stiffer = np.maximum(np.minimum(_SHARE * chosen, most), measured)
    values = {name: value for name, value in found.items() if name in _NAMES}
    values |= as_parameters(*stiffer)
    values['robot.coulomb'] = tuple(np.maximum(known_friction(config), friction))
    return with_gains(config, values)


def as_measured(
    config: ControllerConfig, configs: Sequence[ControllerConfig]
) -> ControllerConfig:
    """Return the configuration with what the last run knew of an arm with guessed motors.

    `configs` are those of the runs.
    """
    given = flatten(configs[-1])
    if not is_known_by_urdf_only(config) or not _is_better_known(config, given):
        return config
    values = {name: given[name] for name in _NAMES if given[name] != ()}
    return with_gains(config, {**values, 'feedback.stiffness': 1.0})


def _is_better_known(config: ControllerConfig, given: Mapping[str, Value]) -> bool:
    """Whether a run with the parameters `given` had a better configuration than the first one.

    Softer gains do not count: an arm that nearly oscillates gets those.
    """
    if given['robot.coulomb'] != config.robot.coulomb:
        return True
    arm, _ = design_of(config)
    damping = np.asarray(given['feedback.joint_damping'], float)
    if arm.joints is None or not damping.size:
        return False
    return bool((damping >= arm.stiffness * arm.joints.damping).all())

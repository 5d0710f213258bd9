# SPDX-License-Identifier: Apache-2.0
"""An arm that is measured again, better known by then.

Of an arm of which only its URDF is known, motors are guessed, friction is unknown, and the
gains hold any arm, softly.  Joints that stick then show neither their inertia nor how late
torques are, and gains for the inertia that is guessed may be a tenth of what the arm bears.  So
its first posture is measured again, with half of the gains that it bears by the first run, and
with the friction that this shows compensated: the joints slide, and show more.

Gains that a configuration gives, or that follow from the stiffness of its gears, stay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.arms.joint_gains import JointGains
from blf_dsc_controller.commissioning.chosen import with_gains
from blf_dsc_controller.configuration.controller import ControllerConfig, design_of
from blf_dsc_controller.configuration.schema import Value, flatten

Floats = NDArray[np.float64]

TIMES = 2
"""Times that the first posture is measured anew, better known, at most."""

FAR = 5.0
"""Times the gains of a measurement: friction may act otherwise on gains beyond."""

WORTH = 2.5
"""Times the gains of a measurement, from which half of them are worth another one."""

_SHARE = 0.5  # of the gains that an arm bears, to measure it with
_OF_STUCK = 2.0  # times those of the measurement: friction damps what is measured
_NAMES = (
    'robot.coulomb',
    'robot.lag',
    'robot.rotor_inertia',
    'feedback.joint_stiffness',
    'feedback.joint_damping',
)


def is_unknown(config: ControllerConfig) -> bool:
    """Whether the gains are those of an arm of which only motors are guessed."""
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


def better_known(
    config: ControllerConfig,
    shown: dict[str, Value],
    start: JointGains,
    friction: Floats,
    sticks: NDArray[np.bool_],
) -> ControllerConfig:
    """Return a configuration to measure an arm with that runs with `config` have shown.

    `shown` are the parameters that follow from these runs, `start` the gains that they had,
    and `friction` (n,) [N m] is what they show.  Of the joints (n,) of which one `sticks`, gains
    at most double.
    """
    chosen = np.array([shown[f'feedback.joint_{each}'] for each in JointGains._fields])
    most = np.where(sticks, _OF_STUCK * np.array(start), np.inf)
    stiffer = np.maximum(np.minimum(_SHARE * chosen, most), np.array(start))
    gains = dict(zip(JointGains._fields, stiffer.tolist(), strict=True))
    values = {name: value for name, value in shown.items() if name in _NAMES}
    values |= {f'feedback.joint_{each}': tuple(gains[each]) for each in gains}
    values['feedback.stiffness'] = 1.0
    values['robot.coulomb'] = tuple(np.maximum(known_friction(config), friction))
    return with_gains(config, values)


def as_measured(
    config: ControllerConfig, configs: Sequence[ControllerConfig]
) -> ControllerConfig:
    """Return an unknown arm's configuration with what was known of it in the last of its runs.

    `configs` are those of the runs.
    """
    given = flatten(configs[-1])
    if not is_unknown(config) or not _is_better_known(config, given):
        return config
    values = {name: given[name] for name in _NAMES if given[name] != ()}
    return with_gains(config, {**values, 'feedback.stiffness': 1.0})


def _is_better_known(config: ControllerConfig, given: Mapping[str, Value]) -> bool:
    """Whether a run's parameters, all that are `given`, are of an arm that was better known.

    Its gains alone may also be softer, where an arm nearly oscillated with the first ones.
    """
    if given['robot.coulomb'] != config.robot.coulomb:
        return True
    arm, _ = design_of(config)
    damping = np.asarray(given['feedback.joint_damping'], float)
    if arm.joints is None or not damping.size:
        return False
    return bool((damping >= arm.stiffness * arm.joints.damping).all())

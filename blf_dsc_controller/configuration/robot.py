# SPDX-License-Identifier: Apache-2.0
"""The arm of a URDF: where it is, which joints, and what a URDF does not tell."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from blf_dsc_controller.arms.urdf import Chain, UrdfError, chain_joints, moving_joints, read_chain
from blf_dsc_controller.configuration.schema import build, counted, parameter
from blf_dsc_controller.configuration.share import read_text, resolve
from blf_dsc_controller.errors import BlfDscError, ConfigurationError

if TYPE_CHECKING:
    from blf_dsc_controller.arms.base_parameters import BaseParameters
    from blf_dsc_controller.arms.forms import LearnedParameters

_fixed = partial(parameter, read_only='the arm is built once, when the node starts')

TOPIC = 'topic://'
"""Start of a `robot.urdf` that is published: the node waits for it when it starts."""

_DRIVE_ACCELERATION = 400.0  # rad/s^2, of a drive alone at its rated torque


@dataclass(frozen=True)
class Robot:
    """Arm from a URDF, for the model `urdf`."""

    urdf: str = _fixed(
        '',
        'URDF: a file, package://name/path, a file of config/, topic://robot_description, or its '
        'text; empty: no URDF',
        kept=lambda given: given and read_urdf(given),
    )
    base: str = _fixed('', 'link that stands still; empty: the root')
    tip: str = _fixed(
        '', 'link at the end, where payloads are; empty: that of the last joint, if it is one chain'
    )
    gravity: Annotated[tuple[float, ...], '3'] = _fixed(
        (0.0, 0.0, -9.81), 'gravity in the base: (0, 0, 9.81) hangs from the ceiling', 'm/s^2', 'g'
    )
    lag: float = _fixed(
        0.005,
        'delay of measured velocities and applied torques, beside the sampling',
        's',
        at_least=0.0,
    )
    payload: float = _fixed(3.0, 'mass that the arm is rated to carry', 'kg', at_least=0.0)
    learn: Literal['base', 'payload', 'scale'] = _fixed(
        'base', 'what is learned: all that torques show, the load at the tip, or a factor a link'
    )
    rotor_inertia: Annotated[tuple[float, ...], 'joints'] = _fixed(
        (),
        'inertia of each drive, reflected to its joint; empty: from its effort',
        'kg m^2',
        at_least=0.0,
        omittable=True,
    )

    viscous: Annotated[tuple[float, ...], 'joints'] = _fixed(
        (),
        'viscous friction to start from; empty: damping of the URDF',
        'N m s/rad',
        at_least=0.0,
        omittable=True,
    )
    coulomb: Annotated[tuple[float, ...], 'joints'] = _fixed(
        (),
        'Coulomb friction to start from; empty: friction of the URDF',
        'N m',
        at_least=0.0,
        omittable=True,
    )

    def problems(self) -> list[str]:
        """Check that there may be something to be learned."""
        if self.learn == 'payload' and self.payload == 0.0:
            return ['payload: got 0 kg, but learn: payload needs the mass that it may have']
        return []

    @property
    def text(self) -> str:
        """URDF as text; raises BlfDscError if it cannot be read."""
        return read_urdf(self.urdf)

    def chain(self, joints: tuple[str, ...]) -> Chain:
        """Serial chain of the joints; raises BlfDscError if there is none."""
        return chain_of(self.text, self.base, self.tip, joints)

    def friction(self, chain: Chain) -> dict[str, tuple[float, ...]]:
        """Friction of each joint to start from, by the name of its column."""
        return {
            'viscous': self.viscous or tuple(joint.damping for joint in chain.joints),
            'coulomb': self.coulomb or tuple(joint.friction for joint in chain.joints),
        }

    def rotors(self, chain: Chain) -> np.ndarray:
        """Inertias of the drives (n,) [kg m^2]: as given, or rated torque / 400 rad/s^2."""
        if self.rotor_inertia:
            return np.array(self.rotor_inertia)
        efforts = [joint.effort for joint in chain.joints]
        return np.array([e / _DRIVE_ACCELERATION if math.isfinite(e) else 0.0 for e in efforts])


def read_urdf(given: str) -> str:
    """Text of a URDF given as a file, a resource or itself; BlfDscError if it cannot be read."""
    if given.lstrip().startswith('<'):
        return given
    if given.startswith(TOPIC):
        raise BlfDscError(
            f'{given!r} is a topic, for which only a node can wait: write what is on it into a '
            'file (`ros2 param get --hide-type robot_state_publisher robot_description > '
            'robot.urdf`) and give that'
        )
    try:
        return read_text(resolve(given))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or error
        raise BlfDscError(f'{given!r} cannot be read: {reason}') from error


@functools.lru_cache(maxsize=16)
def chain_of(text: str, base: str, tip: str, joints: tuple[str, ...]) -> Chain:
    """`read_chain`, where an empty base is the root and an empty tip what the last joint moves.

    Without tip and joints all that moves has to be one chain.
    """
    if tip or joints:
        return read_chain(text, *chain_joints(text, base, tip, joints))
    moving = moving_joints(text)
    for last in moving:
        with suppress(UrdfError):  # a joint that the base does not carry
            start, end, _ = chain_joints(text, base, '', (last,))
            found = chain_joints(text, start, end, ())[2]
            if len(found) == len(moving):
                return read_chain(text, start, end, found)
    raise UrdfError(
        'neither a tip nor joints were given, and what moves is not one chain: '
        f'{", ".join(moving) or "nothing"}. Set robot.tip to the last link of the arm'
    )


def parameters_of(robot: Robot, chain: Chain) -> BaseParameters:
    """Parameters of the arm that torques can show, with the rotors."""
    gravity = (robot.gravity[0], robot.gravity[1], robot.gravity[2])
    return _parameters_of(chain, gravity)


@functools.lru_cache(maxsize=16)
def _parameters_of(chain: Chain, gravity: tuple[float, float, float]) -> BaseParameters:
    from blf_dsc_controller.arms.base_parameters import base_parameters  # compiles

    return base_parameters(chain, gravity)


def learned_of(robot: Robot, chain: Chain) -> LearnedParameters:
    """Parameters of the arm that are learned, with the rotors."""
    base, rotors = parameters_of(robot, chain), tuple(robot.rotors(chain).tolist())
    return _learned_of(chain, base, robot.learn, robot.payload, rotors)


@functools.lru_cache(maxsize=16)
def _learned_of(
    chain: Chain, base: BaseParameters, form: str, payload: float, rotors: tuple[float, ...]
) -> LearnedParameters:
    from blf_dsc_controller.arms.forms import learned_parameters  # compiles

    return learned_parameters(chain, base, form, payload, np.array(rotors))


def given_robot(given: Mapping[str, Any], joints: object) -> tuple[Robot, Chain]:
    """Robot and chain of parameters by dotted name, of which only the robot's are validated.

    Raises ConfigurationError with what is wrong with them or with the URDF.
    """
    values = {name: given[f'robot.{name}'] for name in vars(Robot()) if f'robot.{name}' in given}
    try:
        robot = build(Robot, values)
    except ConfigurationError as error:
        raise ConfigurationError([f'robot.{problem}' for problem in error.problems]) from error
    wanted = tuple(joints) if isinstance(joints, (list, tuple)) else ()
    try:
        chain = robot.chain(wanted)
    except BlfDscError as error:
        raise ConfigurationError([f'robot.urdf: {error}']) from error
    rotors, n = len(robot.rotor_inertia), len(chain.joints)
    if rotors not in (0, n):
        entries = counted(rotors, 'entry', 'entries')
        raise ConfigurationError([f'robot.rotor_inertia: got {entries} for {n} joints'])
    return robot, chain

# SPDX-License-Identifier: Apache-2.0
"""The arm of a URDF: its source, its joints, and the properties that a URDF lacks."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from blf_dsc_controller.arms.inertia import inertia_of
from blf_dsc_controller.arms.prior import PAYLOAD_SIZE
from blf_dsc_controller.arms.urdf import Chain, UrdfError, chain_joints, moving_joints, read_chain
from blf_dsc_controller.configuration.files import read_text, resolve
from blf_dsc_controller.configuration.schema import build, counted, parameter
from blf_dsc_controller.errors import BlfDscError, ConfigurationError

if TYPE_CHECKING:
    from blf_dsc_controller.arms.base_parameters import BaseParameters
    from blf_dsc_controller.arms.forms import LearnedParameters

_fixed = partial(parameter, read_only='the arm is built once, when the node starts')

TOPIC = 'topic://'
"""Prefix of a `robot.urdf` that is published; the node waits for it when it starts."""

_MOMENTS = 4  # inertial parameters that gravity shows: mass and first moments
_GRAVITY = 9.81  # m/s^2, where robot.gravity is zero
_DRIVE_ACCELERATION = 400.0  # rad/s^2, of an unloaded drive at its rated torque
_PLACEHOLDER = 4.0  # times the weight of the arm at its full reach: the strongest drives have 1
_NEEDED = 0.5  # of that torque, where efforts are placeholders: no arm stretches every link
_MOST_FRICTION = 0.25  # of the effort


@dataclass(frozen=True)
class Robot:
    """Arm from a URDF, for the model `urdf`."""

    urdf: str = _fixed(
        '',
        'URDF: a file, package://name/path, a file of config/, topic://robot_description, or its '
        'text; empty: no URDF',
        kept=lambda given: given and read_urdf(given),
    )
    base: str = _fixed('', 'fixed link at the base; empty: the root')
    tip: str = _fixed(
        '', 'last link, which carries payloads; empty: link of the last joint of a single chain'
    )
    gravity: Annotated[tuple[float, ...], '3'] = _fixed(
        (0.0, 0.0, -9.81), 'gravity in the base frame; (0, 0, 9.81): ceiling mount', 'm/s^2', 'g'
    )
    lag: float = _fixed(
        0.005,
        'delay of measured velocities and applied torques, in addition to the sampling',
        's',
        at_least=0.0,
    )
    payload: float = _fixed(3.0, 'rated payload', 'kg', at_least=0.0)
    learn: Literal['base', 'payload'] = _fixed(
        'base', 'what is learned: all base parameters, or the load at the tip'
    )
    rotor_inertia: Annotated[tuple[float, ...], 'joints'] = _fixed(
        (),
        'inertia of each drive, reflected to its joint; empty: from its effort, then as measured',
        'kg m^2',
        at_least=0.0,
        omittable=True,
    )

    drive_compensates: Literal['none', 'gravity', 'gravity_and_friction'] = _fixed(
        'none', 'what the drives add to a commanded torque by themselves'
    )
    drive_payload: float = _fixed(
        0.0,
        'payload that the drives have been told of, as far as the URDF lacks it',
        'kg',
        at_least=0.0,
    )
    drive_payload_centre: Annotated[tuple[float, ...], '3'] = _fixed(
        (0.0, 0.0, 0.0), 'centre of mass of that payload, in the frame of the tip', 'm'
    )
    effort: Literal['unknown', 'whole', 'commanded', 'current'] = _fixed(
        'unknown',
        'what `effort` in joint states is: torques, whole or without what the drives add, or only '
        'proportional to the whole, as currents are',
    )
    viscous: Annotated[tuple[float, ...], 'joints'] = _fixed(
        (),
        'initial viscous friction; empty: damping of the URDF, or 0 if the drives compensate it',
        'N m s/rad',
        at_least=0.0,
        omittable=True,
    )
    coulomb: Annotated[tuple[float, ...], 'joints'] = _fixed(
        (),
        'initial Coulomb friction; empty: friction of the URDF, or 0 if the drives compensate it',
        'N m',
        at_least=0.0,
        omittable=True,
    )

    def problems(self) -> Iterator[str]:
        """Check that there is something to learn, and a model of what the drives add."""
        if self.learn == 'payload' and self.payload == 0.0:
            yield 'payload: got 0 kg, but learn: payload needs the mass that the arm may carry'
        if self.drive_compensates != 'none' and not self.urdf:
            yield f'drive_compensates: got {self.drive_compensates}, which needs robot.urdf'
        if self.drive_compensates == 'none' and self.drive_payload:
            yield (
                f'drive_payload: got {self.drive_payload:g} kg, but drive_compensates is none: the '
                'drives reckon with no payload'
            )

    @property
    def text(self) -> str:
        """URDF as text; raises BlfDscError if it cannot be read."""
        return read_urdf(self.urdf)

    def chain(self, joints: tuple[str, ...]) -> Chain:
        """Return the serial chain of the joints; raises BlfDscError if there is none."""
        return chain_of(self.text, self.base, self.tip, joints)

    def friction(self, chain: Chain) -> dict[str, tuple[float, ...]]:
        """Return the initial friction of each joint, by the name of its column."""
        compensated = self.drive_compensates == 'gravity_and_friction'
        share = 0.0 if compensated or implausible_friction(chain) else 1.0
        return {
            'viscous': self.viscous or tuple(share * joint.damping for joint in chain.joints),
            'coulomb': self.coulomb or tuple(share * joint.friction for joint in chain.joints),
        }

    def drive_inertias(self, chain: Chain, links: np.ndarray) -> np.ndarray:
        """Return the inertias (n, 10) of `links` with the payload that the drives know."""
        inertias: np.ndarray = links.copy()
        point = np.asarray(chain.tip_placement @ np.append(self.drive_payload_centre, 1.0))
        inertias[-1] += self.drive_payload * inertia_of(np.outer(point, point))
        return inertias

    def efforts(self, chain: Chain) -> np.ndarray:
        """Return the rated torques (n,) [N m], from the weight where the URDF has placeholders."""
        efforts = np.array([joint.effort for joint in chain.joints])
        needed = _NEEDED * self._weight_at_reach(chain)
        known = efforts if not self.placeholder_efforts(chain) else np.minimum(efforts, needed)
        return np.asarray(np.where(np.isfinite(known), known, needed))

    def placeholder_efforts(self, chain: Chain) -> tuple[str, ...]:
        """Return the joints whose effort no drive of such an arm has."""
        most = _PLACEHOLDER * float(self._weight_at_reach(chain).max())
        return tuple(joint.name for joint in chain.joints if most < joint.effort < math.inf)

    def _weight_at_reach(self, chain: Chain) -> np.ndarray:
        """Return the torque (n,) [N m] of the weight beyond each joint, if stretched out flat."""
        weight = float(np.linalg.norm(self.gravity)) or _GRAVITY
        force = self.payload * weight
        torque = force * (PAYLOAD_SIZE + float(np.linalg.norm(chain.tip_placement[:3, 3])))
        needed = []
        for joint in reversed(chain.joints):
            m, *first = joint.inertia[:4] * weight
            torque, force = torque + float(np.linalg.norm(first)), force + m
            needed.append(torque)
            torque += force * float(np.linalg.norm(joint.placement[:3, 3]))
        return np.array(needed[::-1])

    def rotors(self, chain: Chain) -> np.ndarray:
        """Return drive inertias (n,) [kg m^2]: as given, or rated torque / 400 rad/s^2."""
        if self.rotor_inertia:
            return np.array(self.rotor_inertia)
        rotors: np.ndarray = self.efforts(chain) / _DRIVE_ACCELERATION
        return rotors


def implausible_friction(chain: Chain) -> tuple[str, ...]:
    """Return the joints whose friction in the URDF takes a quarter of their effort or more.

    One is enough: then the friction of the URDF is a placeholder, and not known for any joint.
    """
    return tuple(
        joint.name
        for joint in chain.joints
        if joint.friction > _MOST_FRICTION * joint.effort
        or (math.isfinite(joint.velocity) and joint.damping * joint.velocity > joint.effort)
    )


def read_urdf(given: str) -> str:
    """Return the text of a URDF from a file, a resource or text; BlfDscError if unreadable."""
    if given.lstrip().startswith('<'):
        return given
    if given.startswith(TOPIC):
        raise BlfDscError(
            f'{given!r} is a topic, which only a node can read: save its message to a file '
            '(`ros2 param get --hide-type robot_state_publisher robot_description > '
            'robot.urdf`) and give that file'
        )
    try:
        text = read_text(resolve(given))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, 'strerror', None) or error
        raise BlfDscError(f'{given!r} cannot be read: {reason}') from error
    if not text.strip():
        raise BlfDscError(f'{given!r} is empty: did the xacro that wrote it fail?')
    return text


@functools.lru_cache(maxsize=16)
def chain_of(text: str, base: str, tip: str, joints: tuple[str, ...]) -> Chain:
    """Return the chain; an empty base is the root, an empty tip the link of the last joint.

    Without tip and joints, all moving joints must form one chain.
    """
    if tip or joints:
        return read_chain(text, *chain_joints(text, base, tip, joints))
    moving = moving_joints(text)
    for last in moving:
        with suppress(UrdfError):  # not a descendant of the base
            start, end, _ = chain_joints(text, base, '', (last,))
            found = chain_joints(text, start, end, ())[2]
            if len(found) == len(moving):
                return read_chain(text, start, end, found)
    raise UrdfError(
        'neither a tip nor joints were given, and the moving joints are not one chain: '
        f'{", ".join(moving) or "nothing"}. Set robot.tip to the last link of the arm'
    )


def parameters_of(robot: Robot, chain: Chain) -> BaseParameters:
    """Return the base parameters of the arm, with the rotors."""
    gravity = (robot.gravity[0], robot.gravity[1], robot.gravity[2])
    return _parameters_of(chain, gravity)


@functools.lru_cache(maxsize=16)
def _parameters_of(chain: Chain, gravity: tuple[float, float, float]) -> BaseParameters:
    from blf_dsc_controller.arms.base_parameters import base_parameters  # slow: compiles

    return base_parameters(chain, gravity)


def learned_of(robot: Robot, chain: Chain) -> LearnedParameters:
    """Return the learned parameters of the arm, with the rotors."""
    base, rotors = parameters_of(robot, chain), tuple(robot.rotors(chain).tolist())
    return _learned_of(chain, base, robot.learn, robot.payload, rotors)


@functools.lru_cache(maxsize=16)
def _learned_of(
    chain: Chain, base: BaseParameters, form: str, payload: float, rotors: tuple[float, ...]
) -> LearnedParameters:
    from blf_dsc_controller.arms.forms import learned_parameters  # slow: compiles

    return learned_parameters(chain, base, form, payload, np.array(rotors))


def drive_model(robot: Robot, joints: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the gravity that the drives add: a packed chain, and what its columns multiply.

    The columns are mass and first moments of each body, payload included; empty if they add none.
    """
    if robot.drive_compensates == 'none':
        return np.zeros(0), np.zeros(0)
    from blf_dsc_controller.arms.serial_chain import serial_chain  # slow: compiles

    chain = robot.chain(joints)
    columns = [(i, entry) for i in range(len(chain.joints)) for entry in range(_MOMENTS)]
    inertias = robot.drive_inertias(chain, chain.inertias)
    gravity = (robot.gravity[0], robot.gravity[1], robot.gravity[2])
    return serial_chain(chain, gravity, columns).vector, inertias[:, :_MOMENTS].ravel()


def given_robot(given: Mapping[str, Any], joints: object) -> tuple[Robot, Chain]:
    """Return robot and chain from parameters by dotted name; only the robot's are validated.

    Raises ConfigurationError with the problems of these parameters or of the URDF.
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

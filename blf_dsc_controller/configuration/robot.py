# SPDX-License-Identifier: Apache-2.0
"""What plant and controller share: joints, rate, and the arm of a URDF with what it lacks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from blf_dsc_controller.arms.base_parameters import PAYLOAD_SIZE, BaseParameters, base_parameters
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.arms.urdf import Chain, inertia_of, read_chain
from blf_dsc_controller.configuration.files import read_text, resolve
from blf_dsc_controller.configuration.schema import (
    PerJoint,
    Vector,
    non_negative,
    parameter,
)
from blf_dsc_controller.errors import BlfDscError, ConfigurationError

_BUILT = 'arm and law are built once, when the node starts'
_fixed = partial(parameter, read_only=_BUILT)
_magnitude = partial(non_negative, read_only=_BUILT)
_omitted = partial(non_negative, (), read_only=_BUILT, omittable=True)
_at_start = partial(parameter, read_only='the process requests it once, before the first sample')

TOPIC = 'topic://'
"""Prefix of a `robot.urdf` that is published; the node waits for it when it starts."""

_MOMENTS = 4  # inertial parameters that gravity shows: mass and first moments
_GRAVITY = 9.81  # m/s^2, where robot.gravity is zero
_DRIVE_ACCELERATION = 400.0  # rad/s^2, of an unloaded drive at its rated torque
_PLACEHOLDER = 4.0  # times the weight of the arm at its full reach: the strongest drives have 1
_NEEDED = 0.5  # of that torque, where efforts are placeholders: no arm stretches every link
_MOST_FRICTION = 0.25  # of the effort
_ROUNDING = 1e-12  # relative; the product of a decimal fraction and 1e9 is off by a few 1e-16


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
    tip: str = _fixed('', 'last link, which carries payloads; empty: that of the last joint')
    gravity: Vector = _fixed(
        (0.0, 0.0, -9.81), 'gravity in the base frame; (0, 0, 9.81): ceiling mount', 'm/s^2', 'g'
    )
    lag: float = _magnitude(0.005, 'delay of velocities and torques besides the sampling', 's')
    payload: float = _magnitude(3.0, 'rated payload', 'kg')
    rotor_inertia: PerJoint = _omitted(
        'inertia of each drive at its joint; empty: by its effort, then as measured', 'kg m^2'
    )
    drive_compensates: Literal['none', 'gravity', 'gravity_and_friction'] = _fixed(
        'none', 'what the drives add to a commanded torque by themselves'
    )
    drive_payload: float = _magnitude(0.0, 'payload told to the drives that the URDF lacks', 'kg')
    drive_payload_centre: Vector = _fixed(
        (0.0, 0.0, 0.0), 'centre of mass of drive_payload, in the frame of the tip', 'm'
    )
    effort: Literal['unknown', 'whole', 'commanded', 'current'] = _fixed(
        'unknown',
        'what `effort` in joint states is: torques, whole or without what the drives add, or only '
        'proportional to the whole, as currents are',
    )
    viscous: PerJoint = _omitted(
        'initial viscous friction; empty: that of the URDF, or 0 if compensated', 'N m s/rad'
    )
    coulomb: PerJoint = _omitted(
        'initial Coulomb friction; empty: that of the URDF, or 0 if compensated', 'N m'
    )

    def problems(self) -> Iterator[str]:
        """Check that there is a model of what the drives add."""
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
        return read_chain(self.text, self.base, self.tip, joints)

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
        if len(self.rotor_inertia) == len(chain.joints):
            return np.array(self.rotor_inertia)
        return self.efforts(chain) / _DRIVE_ACCELERATION


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
            '(`ros2 topic echo --once --field data`) and give that'
        )
    try:
        text = read_text(resolve(given))
    except (OSError, ValueError, RuntimeError) as error:  # no such file, no text, no path, no user
        reason = getattr(error, 'strerror', None) or error
        raise BlfDscError(f'{given!r} cannot be read: {reason}') from error
    if not text.strip():
        raise BlfDscError(f'{given!r} is empty: did the xacro that wrote it fail?')
    if not text.lstrip().startswith('<'):
        raise BlfDscError(f'{given!r} is not XML: give a URDF')
    return text


def parameters_of(robot: Robot, chain: Chain) -> BaseParameters:
    """Return the base parameters of the arm, with the rotors."""
    return base_parameters(chain, robot.gravity)


def drive_model(robot: Robot, joints: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the gravity that the drives add: a packed chain, and what its columns multiply.

    The columns are mass and first moments of each body, payload included; empty if they add none.
    """
    if robot.drive_compensates == 'none':
        return np.zeros(0), np.zeros(0)
    chain = robot.chain(joints)
    columns = [(i, entry) for i in range(len(chain.joints)) for entry in range(_MOMENTS)]
    inertias = robot.drive_inertias(chain, chain.inertias)
    return serial_chain(chain, robot.gravity, columns).vector, inertias[:, :_MOMENTS].ravel()


def given_robot(given: Mapping[str, Any]) -> tuple[Robot, Chain]:
    """Return robot and chain from valid parameters by dotted name.

    Raises ConfigurationError with the problems of the URDF.
    """
    values = {name: given[f'robot.{name}'] for name in vars(Robot()) if f'robot.{name}' in given}
    robot = Robot(**values)
    try:
        chain = robot.chain(given.get('joints', ()))
    except BlfDscError as error:
        raise ConfigurationError([f'robot.urdf: {error}']) from error
    return robot, chain


@dataclass(frozen=True)
class Realtime:
    """What the process requests from the operating system."""

    priority: int = _at_start(
        0,
        "SCHED_FIFO priority, below controller_manager's 50; 0: unchanged",
        at_least=0,
        at_most=99,
    )
    lock_memory: bool = _at_start(False, 'lock the memory of the process, to prevent swapping')


@dataclass(frozen=True)
class ArmConfig:
    """Parameters that plant and controller have in common.

    Create their configurations with `load` from a parameter file, or with `build` and `change` from
    values by dotted name; these validate them, the constructors do not.
    """

    joints: tuple[str, ...] = _fixed(('joint1', 'joint2'), 'names of the joints, from the base')
    sample_time: float = _fixed(
        0.001, 'period of joint states and torques', 's', 'T', at_least=1e-05, at_most=1.0
    )
    wait_for_subscribers: int = non_negative(
        0,
        'recorders (nodes with `record` in their names) of each topic to wait for at first',
        read_only='topics are created once, when the node starts',
    )
    autostart: bool = parameter(
        True,
        'configure and activate the node at once; false: wait for a lifecycle manager',
        read_only='it has no effect later',
    )
    robot: Robot = Robot()
    realtime: Realtime = Realtime()

    @property
    def sample_time_ns(self) -> int:
        """The sample time in nanoseconds, the unit of the stamps."""
        return round(self.sample_time * 1e9)

    def arm_problems(self, arm: str, needed: int | None) -> Iterator[str]:
        """Check the number of joints, their names, by which they are matched, and the rate."""
        for name in sorted({name for name in self.joints if self.joints.count(name) > 1}):
            yield f'joints: the name {name!r} is repeated'
        if needed not in (None, len(self.joints)):
            yield f'joints: got {len(self.joints)}, but {arm} has {needed} joints'
        yield from (f'robot.{problem}' for problem in self.robot.problems())
        # Stamps are whole nanoseconds, and would drift from the time in the law.
        if abs(self.sample_time * 1e9 - self.sample_time_ns) > _ROUNDING * self.sample_time_ns:
            got = f'got {self.sample_time!r} s, not a whole number of nanoseconds'
            yield f'sample_time: {got}: write {self.sample_time_ns * 1e-9:.9f}'

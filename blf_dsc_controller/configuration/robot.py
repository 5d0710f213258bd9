# SPDX-License-Identifier: Apache-2.0
"""What plant and controller share: joints, rate, and the arm of a URDF or MJCF file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np

from blf_dsc_controller.arms.base_parameters import (
    HEAVIER_DRIVE,
    PAYLOAD_SIZE,
    BaseParameters,
    base_parameters,
)
from blf_dsc_controller.arms.inertia import inertia_of
from blf_dsc_controller.arms.serial_chain import serial_chain
from blf_dsc_controller.arms.urdf import Chain, Joint, read_chain
from blf_dsc_controller.arms.xml_text import without_mark
from blf_dsc_controller.configuration import mjcf
from blf_dsc_controller.configuration.description import (
    check_supported,
    gravity_of,
    rotors_of,
)
from blf_dsc_controller.configuration.files import (
    places_of,
    read_text,
    resolve,
    share_folder,
)
from blf_dsc_controller.configuration.schema import (
    PerJoint,
    Vector,
    format_value,
    length_problems,
    non_negative,
    parameter,
    parameters,
    suggestion,
)
from blf_dsc_controller.errors import BlfDscError, ConfigurationError
from blf_dsc_controller.run import SLIDING, TURNING, JointUnits, joint_units

_BUILT = 'arm and law are built once, when the node starts'
_fixed = partial(parameter, read_only=_BUILT)
_magnitude = partial(non_negative, read_only=_BUILT)
_omitted = partial(non_negative, (), read_only=_BUILT, omittable=True)
_at_start = partial(
    parameter, read_only='the process requests it once, before the first sample'
)

TOPIC = 'topic://'
"""Prefix of a `robot.urdf` that is published; the node waits for it when it starts."""

_MOMENTS = 4  # inertial parameters that gravity shows: mass and first moments
_GRAVITY = 9.81  # m/s^2, where robot.gravity is zero
# rad/s^2 or m/s^2, of an unloaded drive at its rated torque
_DRIVE_ACCELERATION = {TURNING: 400.0, SLIDING: 100.0}
# times the torque of the weight at full reach, of which the strongest drives have 1; times the
# weight that slides, which linear motors accelerate by some g, and screws push far harder
_PLACEHOLDER = {TURNING: 4.0, SLIDING: 40.0}
# of what the weight takes, where efforts are placeholders: no arm stretches every link
_NEEDED = {TURNING: 0.5, SLIDING: 1.0}
_MOST_FRICTION = 0.25  # of the effort
UNKNOWN_FRICTION = 0.05
"""Friction to expect where none is known, over the rated torque: its standard deviation."""
_SLOWEST = {'revolute': 2.0, 'prismatic': 0.5}  # rad/s or m/s, of the drives of arms
# relative; the product of a decimal fraction and 1e9 is off by a few 1e-16
_ROUNDING = 1e-12
_TURN_ROUNDING = 1e-5  # of angles in a URDF, which may have six digits


@dataclass(frozen=True)
class Robot:
    """Arm from a URDF or MJCF, for the model `urdf`.

    MJCF is held as the URDF that it becomes.
    """

    urdf: str = _fixed(
        '',
        'URDF or MJCF: a file, package://name/path, a file of config/, or its text; for a URDF '
        'also topic://robot_description; empty: none',
        kept=lambda given: given and read_urdf(given),
    )
    base: str = _fixed('', 'fixed link at the base; empty: the root')
    tip: str = _fixed(
        '', 'last link, which carries payloads; empty: that of the last joint'
    )
    gravity: Vector = _fixed(
        (0.0, 0.0, -9.81),
        'gravity in the base frame (default: -9.81 along z of the root, for an MJCF its own); '
        '(0, 0, 9.81): '
        'ceiling mount',
        'm/s^2',
        'g',
    )
    lag: float = _magnitude(
        0.005,
        'delay of velocities and torques in addition to that of the sampling',
        's',
    )
    payload: float = _magnitude(3.0, 'rated payload', 'kg')
    rotor_inertia: PerJoint = _omitted(
        'inertia of each drive at its joint; empty: the armature of an MJCF, '
        'otherwise a guess from the effort, which is corrected in operation',
        'kg m^2',
    )
    joint_stiffness: PerJoint = _omitted(
        'stiffness of each gear between motor and link, from which gains follow; empty: '
        'unknown',
        'N m/rad',
    )
    torque_loop: bool = _fixed(
        False,
        'the drives close a loop at joint torque sensors, which efforts show; it hides '
        'the motors',
    )
    drive_compensates: Literal['none', 'gravity', 'gravity_and_friction'] = _fixed(
        'none', 'what the drives add to a commanded torque by themselves'
    )
    drive_gravity: Vector = _fixed(
        (),
        'gravity by which the drives compensate, in the base frame; (0, 0, -9.81) of drives '
        'that take the base for upright, however it is mounted; empty: robot.gravity, if it points '
        'down along z',
        'm/s^2',
        omittable=True,
    )
    drive_payload: float = _magnitude(
        0.0, 'payload configured in the drives that the URDF lacks', 'kg'
    )
    drive_payload_centre: Vector = _fixed(
        (0.0, 0.0, 0.0), 'centre of mass of drive_payload, in the frame of the tip', 'm'
    )
    effort: Literal['unknown', 'whole', 'commanded', 'current'] = _fixed(
        'unknown',
        'what `effort` in joint states is: the whole torque, only the commanded part'
        ' without what the drives add, or a current, proportional to the whole '
        'torque',
    )
    viscous: PerJoint = _omitted(
        'initial viscous friction; empty: that of the URDF, or 0 if the drives '
        'compensate it',
        'N m s/rad',
    )
    coulomb: PerJoint = _omitted(
        'initial Coulomb friction; empty: that of the URDF, or 0 if the drives '
        'compensate it',
        'N m',
    )

    def problems(self) -> Iterator[str]:
        """Check that there is a model of what the drives add."""
        if self.drive_compensates != 'none' and not self.urdf:
            yield f'drive_compensates: got {self.drive_compensates}, which needs robot.urdf'
        if self.drive_compensates == 'none' and self.drive_payload:
            yield (
                f'drive_payload: got {self.drive_payload:g} kg, but drive_compensates is none: the '
                'drives compensate no payload'
            )
        if self.drive_compensates == 'none' and self.drive_gravity:
            yield 'drive_gravity: got some, but drive_compensates is none: the drives add none'
        if self.drive_compensates != 'none' and not (
            self.drive_gravity or _points_down(self.gravity)
        ):
            yield (
                'drive_gravity: the base is tilted (robot.gravity '
                f'{format_value(self.gravity)}), and drives that take it for upright would drop '
                'the arm or throw it up: give robot.gravity once more if the drives know how the '
                'base is mounted, or [0.0, 0.0, -9.81] if they do not'
            )

    @property
    def known_drive_gravity(self) -> tuple[float, ...]:
        """Gravity (3,) [m/s^2] by which the drives compensate, in the base frame."""
        return self.drive_gravity or self.gravity

    @property
    def text(self) -> str:
        """URDF as text; raises BlfDscError if it cannot be read."""
        return read_urdf(self.urdf)

    def chain(self, joints: tuple[str, ...]) -> Chain:
        """Return the serial chain of the joints.

        Raises BlfDscError if there is none.
        """
        text = self.text
        chain = read_chain(text, self.base, self.tip, joints)
        check_supported(text, chain)
        return chain

    def kinds(self, joints: tuple[str, ...]) -> tuple[str, ...]:
        """Return the kind of each joint: revolute, continuous or prismatic.

        Without a URDF, they turn.
        """
        return _kinds(self, joints)

    def sliding(self, joints: tuple[str, ...]) -> tuple[str, ...]:
        """Return the joints that slide; none without a URDF."""
        kinds = zip(joints, self.kinds(joints), strict=True)
        return tuple(name for name, kind in kinds if kind == 'prismatic')

    def friction(self, chain: Chain) -> dict[str, tuple[float, ...]]:
        """Return the initial friction of each joint, by the name of its column."""
        compensated = self.drive_compensates == 'gravity_and_friction'
        share = 0.0 if compensated or implausible_friction(self, chain) else 1.0
        return {
            'viscous': self.viscous
            or tuple(share * joint.damping for joint in chain.joints),
            'coulomb': self.coulomb
            or tuple(share * joint.friction for joint in chain.joints),
        }

    def unknown_friction(self, chain: Chain) -> np.ndarray:
        """Return the dry friction (n,) [N m] to expect where none is known."""
        if self.drive_compensates == 'gravity_and_friction':
            return np.zeros(len(chain.joints))
        is_known = np.array(self.friction(chain)['coulomb']) > 0.0
        return np.where(is_known, 0.0, UNKNOWN_FRICTION * self.efforts(chain))

    def drive_inertias(self, chain: Chain, links: np.ndarray) -> np.ndarray:
        """Return the inertias (n, 10) of `links` with the declared payload."""
        inertias: np.ndarray = links.copy()
        point = np.asarray(
            chain.tip_placement @ np.append(self.drive_payload_centre, 1.0)
        )
        inertias[-1] += self.drive_payload * inertia_of(np.outer(point, point))
        return inertias

    def efforts(self, chain: Chain) -> np.ndarray:
        """Return the rated torques (n,) [N m].

        They follow from the weight where the URDF has placeholders.
        """
        efforts = np.array([joint.effort for joint in chain.joints])
        needed = _by_kind(_NEEDED, chain) * self._weight_at_reach(chain)
        known = (
            efforts
            if not self.placeholder_efforts(chain)
            else np.minimum(efforts, needed)
        )
        return np.asarray(np.where(np.isfinite(known), known, needed))

    def placeholder_efforts(self, chain: Chain) -> tuple[str, ...]:
        """Return the joints whose effort no drive of such an arm has."""
        return tuple(
            joint.name
            for joint, most in zip(
                chain.joints, self.largest_efforts(chain).tolist(), strict=True
            )
            if most < joint.effort < math.inf
        )

    def largest_efforts(self, chain: Chain) -> np.ndarray:
        """Return what no drive of an arm of this weight exceeds (n,) [N m or N]."""
        weight = self._weight_at_reach(chain)
        slides = np.array([joint.kind == 'prismatic' for joint in chain.joints])
        of_kind = [weight[slides == each].max(initial=0.0) for each in slides]
        return np.asarray(_by_kind(_PLACEHOLDER, chain) * of_kind)

    def carried(self, chain: Chain) -> float:
        """Return the mass [kg] that the strongest joint holds at full reach.

        It is 0 without a reach or an effort limit.
        """
        weight = float(np.linalg.norm(self.gravity)) or _GRAVITY
        held = [
            joint.effort / (weight * arm)
            for joint in chain.joints
            if (arm := 1.0 if joint.kind == 'prismatic' else chain.reach) > 0.0
        ]
        return max(filter(math.isfinite, held), default=0.0)

    def _weight_at_reach(self, chain: Chain) -> np.ndarray:
        """Return what the weight beyond each joint takes at full reach (n,) [N m or N]."""
        weight = float(np.linalg.norm(self.gravity)) or _GRAVITY
        force = self.payload * weight
        torque = force * (
            PAYLOAD_SIZE + float(np.linalg.norm(chain.tip_placement[:3, 3]))
        )
        needed = []
        for joint in reversed(chain.joints):
            m, *first = joint.inertia[:4] * weight
            torque = torque + float(np.linalg.norm(first))
            force = force + m
            needed.append(force if joint.kind == 'prismatic' else torque)
            torque += force * joint.length
        return np.array(needed[::-1])

    def known_rotors(self, chain: Chain) -> tuple[float, ...]:
        """Return drive inertias (n,) [kg m^2] as given or described, else empty."""
        return self.rotor_inertia or rotors_of(self.text, chain)

    def rotors(self, chain: Chain) -> np.ndarray:
        """Return drive inertias (n,) [kg m^2 or kg]: given, or guessed from rated torques."""
        known = self.known_rotors(chain)
        if len(known) == len(chain.joints):
            return np.array(known)
        return np.asarray(self.efforts(chain) / _by_kind(_DRIVE_ACCELERATION, chain))

    def unknown_rotors(self, chain: Chain) -> np.ndarray:
        """Return what drives may have beyond `rotors` (n,) [kg m^2] if these are guesses.

        A loop at joint torque sensors hides it.
        """
        counts = not (self.torque_loop or self.known_rotors(chain))
        return HEAVIER_DRIVE * self.rotors(chain) * counts


def _points_down(gravity: tuple[float, ...]) -> bool:
    """Whether gravity (3,) is along -z of the base, up to the rounding of its orientation."""
    x, y, z = gravity
    return z < 0.0 and math.hypot(x, y) <= _TURN_ROUNDING * -z


def _by_kind(values: Mapping[JointUnits, float], chain: Chain) -> np.ndarray:
    """Return the value (n,) of each joint, as it turns or slides."""
    return np.array([values[joint_units(joint.kind)] for joint in chain.joints])


@lru_cache(maxsize=16)
def _kinds(robot: Robot, joints: tuple[str, ...]) -> tuple[str, ...]:
    if not robot.urdf:
        return ('revolute',) * len(joints)
    return tuple(joint.kind for joint in robot.chain(joints).joints)


def implausible_friction(robot: Robot, chain: Chain) -> tuple[str, ...]:
    """Return the joints whose friction takes a quarter of their effort or more.

    One is enough: then the friction of the description is a placeholder, and not known
    for any joint.
    """
    strongest = float(robot.efforts(chain).max())
    return tuple(
        joint.name
        for joint in chain.joints
        if joint.friction > _MOST_FRICTION * joint.effort
        or joint.damping * _speed(joint) > min(joint.effort, strongest)
    )


def _speed(joint: Joint) -> float:
    """Return the velocity of a joint, or one that any drive reaches if it is unknown."""
    if math.isfinite(joint.velocity):
        return joint.velocity
    return _SLOWEST['prismatic' if joint.kind == 'prismatic' else 'revolute']


def read_urdf(given: str) -> str:
    """Return the text of a URDF from a file, resource or text; it may be MJCF.

    Raises BlfDscError if it cannot be read.
    """
    given = without_mark(given)
    if given.lstrip().startswith('<'):
        return mjcf.urdf_of_text(given) if mjcf.is_mjcf(given) else given
    if given.startswith(TOPIC):
        raise BlfDscError(
            f'{given!r} is a topic, which only a node can read: save its message by `ros2 topic '
            f'echo --once --field data {given.removeprefix(TOPIC)} > arm.urdf` and give this file'
        )
    try:
        path = resolve(given)
        text = read_text(path).removesuffix('\n---\n')  # which `ros2 topic echo` adds
    except FileNotFoundError as error:
        problem = f'{given!r} cannot be read: there is no {places_of(given)}'
        known = [each.name for each in (share_folder() / 'config').glob('*.urdf')]
        problem += suggestion(given, known) or '; give the path of a URDF or MJCF'
        raise BlfDscError(problem) from error
    # no text, no path, no user
    except (OSError, ValueError, RuntimeError) as error:
        reason = getattr(error, 'strerror', None) or error
        raise BlfDscError(f'{given!r} cannot be read: {reason}') from error
    if not text.strip():
        raise BlfDscError(f'{given!r} is empty: did the xacro that wrote it fail?')
    if not text.lstrip().startswith('<'):
        raise BlfDscError(f'{given!r} is not XML: give a URDF or MJCF')
    return mjcf.urdf_of_file(path) if mjcf.is_mjcf(text) else text


def parameters_of(robot: Robot, chain: Chain) -> BaseParameters:
    """Return the base parameters of the arm, with the rotors."""
    return base_parameters(chain, robot.gravity)


def drive_model(robot: Robot, joints: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the gravity that the drives add.

    It is a packed chain, and what its columns multiply.

    The columns are mass and first moments of each body, payload included; empty if they
    add none.
    """
    if robot.drive_compensates == 'none':
        return np.zeros(0), np.zeros(0)
    chain = robot.chain(joints)
    columns = [
        (i, entry) for i in range(len(chain.joints)) for entry in range(_MOMENTS)
    ]
    inertias = robot.drive_inertias(chain, chain.inertias)
    return serial_chain(chain, robot.known_drive_gravity, columns).vector, inertias[
        :, :_MOMENTS
    ].ravel()


def given_robot(given: Mapping[str, Any]) -> tuple[Robot, Chain]:
    """Return robot and chain from valid parameters by dotted name.

    Raises ConfigurationError with the problems of the URDF.
    """
    values = {
        name: given[f'robot.{name}']
        for name in vars(Robot())
        if f'robot.{name}' in given
    }
    robot = Robot(**values)
    try:
        chain = robot.chain(given.get('joints', ()))
    except BlfDscError as error:
        name = 'joints' if _has_chain(robot) else 'robot.urdf'
        raise ConfigurationError([f'{name}: {error}']) from error
    counted = {**values, 'joints': chain.joints}
    problems = [
        f'robot.{problem}'
        for param in parameters(Robot)
        if param.name in values and param.length == ('joints',)
        for problem in length_problems(param, counted)
    ]
    if problems:
        raise ConfigurationError(problems)
    if 'robot.gravity' not in given:
        gravity = gravity_of(robot.text, chain, robot.gravity)
        robot = replace(robot, gravity=gravity)
    return robot, chain


def described(robot: Robot, chain: Chain) -> dict[str, tuple[float, ...]]:
    """Return the parameters that a description can give, by dotted name."""
    return {
        'robot.gravity': robot.gravity,
        'robot.rotor_inertia': robot.known_rotors(chain),
    }


def _has_chain(robot: Robot) -> bool:
    """Whether there is a chain from base to tip, of whichever joints."""
    try:
        robot.chain(())
    except BlfDscError:
        return False
    return True


@dataclass(frozen=True)
class Realtime:
    """What the process requests from the operating system."""

    priority: int = _at_start(
        0,
        "SCHED_FIFO priority, below controller_manager's 50, with which memory is locked, too; "
        '0: unchanged',
        at_least=0,
        at_most=99,
    )


@dataclass(frozen=True)
class ArmConfig:
    """Parameters that plant and controller have in common.

    Create their configurations with `load` from a parameter file, or with `build` and
    `change` from values by dotted name; these validate them, the constructors do not.
    """

    joints: tuple[str, ...] = _fixed(
        ('joint1', 'joint2'), 'names of the joints, from the base'
    )
    sample_time: float = _fixed(
        0.001,
        'period of joint states and torques',
        's',
        'T',
        at_least=1e-05,
        at_most=1.0,
    )
    wait_for_subscribers: int = non_negative(
        0,
        'number of recorders (nodes with `record` in their names) to wait for on '
        'each topic',
        read_only='topics are created once, when the node starts',
    )
    autostart: bool = parameter(
        True,
        'configure and activate the node at once; false: wait for a lifecycle manager',
        read_only='it has no effect later',
    )
    insist: tuple[str, ...] = parameter(
        (),
        'parameters whose values are meant although no arm seems to have them, such as '
        'torque.limit: they are not refused',
        omittable=True,
    )
    robot: Robot = Robot()
    realtime: Realtime = Realtime()

    @property
    def sample_time_ns(self) -> int:
        """The sample time in nanoseconds, the unit of the stamps."""
        return round(self.sample_time * 1e9)

    def arm_problems(self, arm: str, needed: int | None) -> Iterator[str]:
        """Check number and names of the joints, and the rate."""
        for name in sorted(
            {name for name in self.joints if self.joints.count(name) > 1}
        ):
            yield f'joints: the name {name!r} is repeated'
        if needed not in (None, len(self.joints)):
            yield f'joints: got {len(self.joints)}, but {arm} has {needed} joints'
        yield from (f'robot.{problem}' for problem in self.robot.problems())
        # Stamps are whole nanoseconds, and would drift from the time in the law.
        if (
            abs(self.sample_time * 1e9 - self.sample_time_ns)
            > _ROUNDING * self.sample_time_ns
        ):
            got = f'got {self.sample_time!r} s, not a whole number of nanoseconds'
            yield f'sample_time: {got}: write {self.sample_time_ns * 1e-9:.9f}'

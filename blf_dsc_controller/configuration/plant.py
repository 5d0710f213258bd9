# SPDX-License-Identifier: Apache-2.0
"""Parameters of the simulated plant: arm, sensors, actuators, loads, events.

A load acts as long as it is set, an event from its time on. Vectors at the tip are in
the base frame: x to the right, z upwards. Deviations from the URDF are unknown to the
controller.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np

from blf_dsc_controller.configuration import plausibility
from blf_dsc_controller.configuration.robot import (
    ArmConfig,
    described,
    given_robot,
)
from blf_dsc_controller.configuration.rules import (
    Finding,
    Severity,
    When,
    findings,
)
from blf_dsc_controller.configuration.schema import (
    PerJoint,
    Value,
    Vector,
    non_negative,
    parameter,
    parameters,
    positive,
)

PerEvent = Annotated[tuple[float, ...], 'events.begin']
PerEventAndAxis = Annotated[tuple[float, ...], 'events.begin', '3']
PerEventAndJoint = Annotated[tuple[float, ...], 'events.begin', 'joints']

_BUILT = 'the plant is built once, when the node starts'
_fixed = partial(parameter, read_only=_BUILT)
_magnitude = partial(non_negative, read_only=_BUILT)
_LONGEST = 1e8  # s: the seconds of a stamp are an int32
_omitted = partial(non_negative, (), read_only=_BUILT, omittable=True)
_of_events = partial(parameter, (), omittable=True)


@dataclass(frozen=True)
class Load:
    """Loads that act on the arm besides its motors."""

    payload: float = non_negative(0.0, 'point mass at the tip', 'kg')
    torque: PerJoint = parameter((0.0, 0.0), 'external torque on each joint', 'N m')
    force: Vector = parameter((0.0, 0.0, 0.0), 'external force on the tip', 'N')


@dataclass(frozen=True)
class Events:
    """Events, which add to load, friction and encoder offsets for a time.

    Events begin and end at whole samples from the start; a ramp scales one by the
    elapsed fraction.
    """

    begin: tuple[float, ...] = _of_events(
        'time at which each event begins', 's', at_least=0.0
    )
    duration: PerEvent = _of_events(
        'duration of each event; 0: permanent', 's', at_least=0.0
    )
    ramp: PerEvent = _of_events('time to fade in, and to fade out', 's', at_least=0.0)
    payload: PerEvent = _of_events('point mass at the tip', 'kg', at_least=0.0)
    sloshing: PerEvent = _of_events(
        'point mass on a damped spring at the tip', 'kg', at_least=0.0
    )
    sloshing_frequency: float = positive(
        15.0, 'undamped frequency of this spring', 'rad/s'
    )
    sloshing_damping: float = non_negative(0.05, 'damping ratio of this spring')
    force: PerEventAndAxis = _of_events('external force on the tip', 'N')
    torque: PerEventAndJoint = _of_events('external torque on each joint', 'N m')
    viscous: PerEventAndJoint = _of_events('change in viscous friction', 'N m s/rad')
    coulomb: PerEventAndJoint = _of_events('change in Coulomb friction', 'N m')
    offset: PerEventAndJoint = _of_events('change in encoder offset', 'rad')


def pick_ups(times: Sequence[float], masses: Sequence[float]) -> dict[str, Value]:
    """Return the changes of a plant whose only events are loads [kg], from `times` [s] on."""
    lists = [name for name, value in vars(Events()).items() if value == ()]
    changes: dict[str, Value] = {f'events.{name}': () for name in lists}
    return changes | {
        'events.begin': tuple(times),
        'events.duration': (0.0,) * len(times),
        'events.payload': tuple(masses),
    }


@dataclass(frozen=True)
class Deviation:
    """Deviations of masses from those of the URDF.

    A changed body stays physically consistent: its mass distribution is only scaled and
    shifted.
    """

    mass_factor: float = _fixed(1.0, 'factor on all masses and inertias', above=0.0)
    mass_deviation: float = _magnitude(
        0.0, 'largest random deviation of each mass, as a fraction', below=1.0
    )
    centre_deviation: float = _magnitude(
        0.0, 'largest random deviation of a centre, per axis', 'm'
    )
    seed: int = _magnitude(0, 'seed of the random deviations')

    def changes(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return each body's factor on the mass (n,) and shift of mass (n, 3) [m]."""
        random = np.random.Generator(np.random.PCG64(np.random.SeedSequence(self.seed)))
        drawn = random.uniform(-1.0, 1.0, (n, 4))
        factors = self.mass_factor * (1.0 + self.mass_deviation * drawn[:, 0])
        return factors, self.centre_deviation * drawn[:, 1:]


@dataclass(frozen=True)
class Truth(Deviation):
    """Deviations of the true arm from its URDF."""

    rotor_factor: float = _magnitude(1.0, 'factor on the inertias of the drives')
    rotor_inertia: PerJoint = _omitted(
        'inertia of each drive at its joint; empty: rotor_factor times that of robot',
        'kg m^2',
    )


@dataclass(frozen=True)
class Joint:
    """Springs between motors and links."""

    stiffness: PerJoint = _omitted(
        'stiffness of each joint; empty or 0: rigid', 'N m/rad'
    )
    damping_ratio: float = _magnitude(
        0.03, 'damping of the springs, with motor and link free to swing'
    )
    backlash: PerJoint = _omitted('play of each gear; empty: none', 'rad')
    hysteresis: PerJoint = _omitted('dry friction in each spring; empty: none', 'N m')


@dataclass(frozen=True)
class PlantBase:
    """Base that gives way: two translations and two tilts."""

    mass: float = _magnitude(0.0, 'mass that moves with the base; 0: rigid', 'kg')
    frequency: float = _fixed(
        10.0,
        'natural frequency with the arm, its joints locked at the initial positions',
        'Hz',
        above=0.0,
    )
    damping_ratio: float = _magnitude(0.02, 'damping ratio at this frequency')


@dataclass(frozen=True)
class PlantArm:
    """Two links with point masses at their ends."""

    l1: float = _fixed(1.0, 'length of the first link', 'm', 'l1', above=0.0)
    l2: float = _fixed(0.8, 'length of the second link', 'm', 'l2', above=0.0)
    m1: float = _fixed(0.5, 'mass at the end of the first link', 'kg', 'm1', above=0.0)
    m2: float = _fixed(0.5, 'mass at the end of the second link', 'kg', 'm2', above=0.0)
    gravity: float = _fixed(9.8, 'gravity; 0 for a horizontal arm', 'm/s^2', 'g')


@dataclass(frozen=True)
class Initial:
    """Initial state of the arm."""

    position: PerJoint = _fixed(
        (2.293, 1.696), 'initial joint positions', 'rad', 'q(0)'
    )
    velocity: PerJoint = _fixed(
        (0.0, 0.0), 'initial joint velocities', 'rad/s', 'dq(0)'
    )


@dataclass(frozen=True)
class PlantDisturbance:
    """Torque that opposes each joint, `tau_dist` in the equation of motion.

    tau_dist = constant + amplitude*sin(frequency*t + phase) + viscous*dq
             + coulomb*(1 +
             stribeck*exp(-(dq/stribeck_velocity)^2))*tanh(dq/coulomb_velocity) + the
             ripple of the actuator
    """

    constant: PerJoint = parameter((0.1, 0.1), 'constant part', 'N m')
    amplitude: PerJoint = parameter((0.1, 0.1), 'amplitude of the sinusoid', 'N m')
    frequency: PerJoint = non_negative(
        (1.0, 1.0), 'angular frequency of the sinusoid', 'rad/s'
    )
    phase: PerJoint = parameter((0.0, 0.0), 'phase of the sinusoid', 'rad')
    viscous: PerJoint = non_negative((0.0, 0.0), 'viscous friction', 'N m s/rad')
    coulomb: PerJoint = non_negative((0.0, 0.0), 'Coulomb friction', 'N m')
    coulomb_velocity: float = positive(
        0.01, 'velocity scale of Coulomb friction', 'rad/s'
    )
    stribeck: float = non_negative(
        0.0, 'breakaway in excess of Coulomb friction, relative to it'
    )
    stribeck_velocity: float = positive(
        0.1, 'velocity scale over which this excess fades', 'rad/s'
    )
    load_share: float = non_negative(
        0.0, 'Coulomb friction that grows with the torque on the gear, relative to it'
    )
    load_asymmetry: float = parameter(
        0.0,
        'how much larger this share is where the motor drives the load, and smaller where the '
        'load drives the motor, relative to it',
        at_least=-1.0,
        at_most=1.0,
    )
    warm_factor: float = positive(
        1.0, 'friction of the warm arm, relative to that at the start'
    )
    warm_time: float = positive(600.0, 'time constant of warming up', 's')


@dataclass(frozen=True)
class Sensor:
    """Measurement of the true state."""

    side: Literal['link', 'motor', 'both'] = _fixed(
        'link',
        'side of the springs on which positions and velocities are measured; both: that '
        'of the links, and that of the motors on the topic motor_states',
    )
    position_noise: float = _magnitude(
        0.0, 'rms of the white noise on measured positions', 'rad'
    )
    velocity_noise: float = _magnitude(
        0.0, 'rms of the white noise on measured velocities', 'rad/s'
    )
    resolution: float = _magnitude(0.0, 'resolution of the encoders; 0: ideal', 'rad')
    velocity: Literal['measured', 'differenced'] = _fixed(
        'measured',
        'velocity from its own sensor, or the difference of two measured positions',
    )
    velocity_pole: float = _magnitude(
        0.0, 'pole of a low-pass on the velocity; 0: none', 'rad/s'
    )
    offset: PerJoint = parameter((0.0, 0.0), 'measured minus true position', 'rad')
    eccentricity: PerJoint = _omitted(
        'error of each encoder, once per turn; empty: none', 'rad'
    )
    torque_offset: PerJoint = _fixed(
        (),
        'what joint torque sensors, and the loop at them, see too much; empty: none',
        'N m',
        omittable=True,
    )
    torque_factor: PerJoint = _omitted(
        'what they show, relative to the torque; empty: 1'
    )
    torque_noise: PerJoint = _omitted(
        'rms of the white noise on their readings; empty: none', 'N m'
    )
    repeat_every: int = _magnitude(
        0, 'after so many samples, a reading is sent again with a new stamp; 0: never'
    )
    published_joints: tuple[str, ...] = _fixed(
        (),
        'names in the joint states, in this order; those not in `joints` stay at 0; '
        'empty: `joints`',
        omittable=True,
    )
    incomplete_states: int = _magnitude(
        0,
        'number of joint states without velocities and efforts (NaN) before the '
        'first complete one',
        at_most=100,
    )


@dataclass(frozen=True)
class Actuator:
    """Effects between the commanded and the applied torque."""

    torque_limit: PerJoint = _magnitude(
        (0.0, 0.0), 'rated joint torque; 0: no limit', 'N m'
    )
    delay: int = _magnitude(0, 'delay of the torque', 'samples', at_most=1000)
    time_constant: float = _magnitude(
        0.0, 'first-order lag from limited torque to joint', 's'
    )
    torque_noise: float = _magnitude(
        0.0, 'rms of the torque noise, as a fraction of the torque'
    )
    ripple: float = _magnitude(
        0.0, 'amplitude of the torque ripple, relative to the rated torque'
    )
    ripple_cycles: float = _fixed(
        20.0,
        'periods of the ripple per turn; where a joint slides, rad per metre',
        above=0.0,
    )
    command_timeout: float = positive(
        0.05, 'age after which a torque is no longer applied, in real time', 's'
    )
    without_command: Literal['zero', 'hold'] = parameter(
        'zero', 'without a command: zero torque, or the last command'
    )
    rate_limit: float = _magnitude(
        0.0, 'rate to which the driver limits commands; 0: no limit', 'N m/s'
    )
    reflex_rate: float = _magnitude(
        0.0,
        'rate of the torque above which the drives brake until a reset; 0: never',
        'N m/s',
    )
    loop_gain: float = _magnitude(
        0.0, 'gain of a loop at joint torque sensors; 0: no loop', '', 'k_T'
    )
    loop_damping: float = _magnitude(
        0.0, 'gain of this loop on the rate of the torque', 's', 'k_S'
    )
    loop_lag: float = _magnitude(0.0003, 'first-order lag of this loop', 's')
    loop_limit: float = _fixed(
        2.0, 'largest torque of this loop, relative to the rated torque', above=0.0
    )


@dataclass(frozen=True)
class Drive(Deviation):
    """Model by which the drives compensate `robot.drive_compensates`.

    With the deviations of `truth` it is the true arm, without any it is the URDF.
    """

    friction: float = _magnitude(
        0.8, 'share of friction that the drives compensate', at_most=1.0
    )


@dataclass(frozen=True)
class PlantConfig(ArmConfig):
    """Parameters of the node `sim_plant`."""

    mode: Literal['realtime', 'lockstep'] = _fixed(
        'realtime',
        'one step per sample time of the wall clock, or one per received torque',
    )
    duration: float = _magnitude(
        0.0, 'simulated time until the plant stops; 0: no limit', 's', at_most=_LONGEST
    )
    seed: int = _magnitude(
        0, 'seed of the noise; equal seeds give equal runs', at_most=2**63 - 1
    )
    publish_clock: bool = _fixed(False, 'publish the simulated time on /clock')
    physics: Literal['own', 'mujoco'] = _fixed(
        'own', 'mechanics of the arm: compiled equations, or MuJoCo (an extra)'
    )
    arm: PlantArm = PlantArm()
    truth: Truth = Truth()
    drive: Drive = Drive()
    joint: Joint = Joint()
    base: PlantBase = PlantBase()
    initial: Initial = Initial()
    disturbance: PlantDisturbance = PlantDisturbance()
    sensor: Sensor = Sensor()
    actuator: Actuator = Actuator()
    load: Load = Load()
    events: Events = Events()

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> dict[str, Value]:
        """Return joints, limits and friction from a URDF, and a start at rest."""
        if not given.get('robot.urdf'):
            return {}
        robot, chain = given_robot(given)
        joints = chain.joints
        middles = [(joint.lower + joint.upper) / 2.0 for joint in joints]
        zero = (0.0,) * len(joints)
        return {
            **{
                param.name: zero
                for param in parameters(cls)
                if param.length == ('joints',) and not param.omittable
            },
            **described(robot, chain),
            'joints': tuple(joint.name for joint in joints),
            'initial.position': tuple(q if math.isfinite(q) else 0.0 for q in middles),
            'disturbance.viscous': tuple(joint.damping for joint in joints),
            'disturbance.coulomb': tuple(joint.friction for joint in joints),
            'actuator.torque_limit': tuple(
                joint.effort if math.isfinite(joint.effort) else 0.0 for joint in joints
            ),
        }

    def problems(self) -> Iterator[Finding]:
        """Check the joints, the sample time and the duration."""
        yield from self.arm_problems(
            'the simulated arm', None if self.robot.urdf else 2
        )
        if self.truth != Truth() and not self.robot.urdf:
            yield 'truth: it applies only to a URDF: give robot.urdf, or change arm'
        yield from self._spring_problems()
        if self.drive != Drive() and self.robot.drive_compensates == 'none':
            yield 'drive: without robot.drive_compensates the drives need no model'
        published = self.sensor.published_joints
        if published and (
            lacking := [name for name in self.joints if name not in published]
        ):
            yield f'sensor.published_joints: {", ".join(lacking)} of `joints` is missing'
        if self.physics == 'mujoco' and any(self.events.sloshing):
            yield 'physics: got mujoco, which has no sloshing loads: use own, or payload'
        if self.actuator.ripple > 0.0 and not all(self.actuator.torque_limit):
            yield 'actuator.ripple: a fraction of the rated torque: give actuator.torque_limit'
        if 0.0 < self.duration < self.sample_time:
            yield (
                f'duration: got {self.duration:g} s, shorter than one sample of '
                f'{self.sample_time:g} s (0 runs until stopped)'
            )
        rules = (plausibility.INSISTED, *plausibility.OF_PLANT)
        yield from findings(rules, self, When.LOAD, Severity.REFUSE, self.insist)

    def _spring_problems(self) -> Iterator[str]:
        """Check what springs, their loop and a base need."""
        joint, actuator, truth = self.joint, self.actuator, self.truth
        if not self.robot.urdf and (any(joint.stiffness) or self.base.mass):
            yield 'joint.stiffness, base.mass: they apply only to a URDF: give robot.urdf'
        if truth.rotor_inertia and truth.rotor_factor != 1.0:
            yield (
                f'truth.rotor_factor: got {truth.rotor_factor:g}, but truth.rotor_inertia '
                'replaces the inertias that it scales: give one of them'
            )
        if actuator.loop_damping and not actuator.loop_gain:
            yield 'actuator.loop_damping: without actuator.loop_gain there is no loop'
        if actuator.loop_gain and not (joint.stiffness and all(joint.stiffness)):
            yield (
                'actuator.loop_gain: a loop around the springs: give joint.stiffness '
                'above 0 for every joint'
            )
        if not actuator.loop_gain:
            for name in ('torque_offset', 'torque_factor', 'torque_noise'):
                if getattr(self.sensor, name):
                    yield (
                        f'sensor.{name}: of the joint torque sensors of a loop: give '
                        'actuator.loop_gain'
                    )
        springs = joint.stiffness or (0.0,) * len(self.joints)
        for name in ('backlash', 'hysteresis'):
            of_joints = zip(self.joints, springs, getattr(joint, name), strict=False)
            rigid = [each for each, spring, value in of_joints if value and not spring]
            if rigid:
                yield (
                    f'joint.{name}: {", ".join(rigid)} without a spring: give '
                    'joint.stiffness'
                )

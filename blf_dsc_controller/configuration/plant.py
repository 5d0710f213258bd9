# SPDX-License-Identifier: Apache-2.0
"""What the simulated plant can be told: arm, disturbance, sensors, actuators, and its clock."""

from __future__ import annotations

from dataclasses import dataclass, field

from blf_dsc_controller.configuration.common import (
    Realtime,
    autostart,
    joint_problems,
    nanoseconds,
    sample_time_problems,
)
from blf_dsc_controller.configuration.schema import parameter

_BUILT = 'the plant is built once, when the node starts'
_PER_JOINT = ('joints',)


@dataclass(frozen=True)
class PlantArm:
    """Two links with point masses at their ends."""

    l1: float = parameter(
        1.0, 'length of the first link', unit='m', symbol='l1', above=0.0, read_only=_BUILT
    )
    l2: float = parameter(
        0.8, 'length of the second link', unit='m', symbol='l2', above=0.0, read_only=_BUILT
    )
    m1: float = parameter(
        0.5,
        'mass at the end of the first link',
        unit='kg',
        symbol='m1',
        above=0.0,
        read_only=_BUILT,
    )
    m2: float = parameter(
        0.5,
        'mass at the end of the second link',
        unit='kg',
        symbol='m2',
        above=0.0,
        read_only=_BUILT,
    )
    gravity: float = parameter(
        9.8, 'gravity; 0 for a horizontal arm', unit='m/s^2', symbol='g', read_only=_BUILT
    )


@dataclass(frozen=True)
class Initial:
    """The state the arm starts in."""

    position: tuple[float, ...] = parameter(
        (2.293, 1.696),
        'joint positions at the start',
        unit='rad',
        symbol='q(0)',
        length=_PER_JOINT,
        read_only=_BUILT,
    )
    velocity: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'joint velocities at the start',
        unit='rad/s',
        symbol='dq(0)',
        length=_PER_JOINT,
        read_only=_BUILT,
    )


@dataclass(frozen=True)
class PlantDisturbance:
    """The torque that works against each joint, `tau_dist` in the equation of motion.

    tau_dist = constant + amplitude*sin(frequency*t + phase)
             + viscous*dq + coulomb*tanh(dq/coulomb_velocity)
    """

    constant: tuple[float, ...] = parameter(
        (0.1, 0.1), 'constant part', unit='N m', length=_PER_JOINT, read_only=_BUILT
    )
    amplitude: tuple[float, ...] = parameter(
        (0.1, 0.1), 'amplitude of the sinusoid', unit='N m', length=_PER_JOINT, read_only=_BUILT
    )
    frequency: tuple[float, ...] = parameter(
        (1.0, 1.0),
        'angular frequency of the sinusoid',
        unit='rad/s',
        at_least=0.0,
        length=_PER_JOINT,
        read_only=_BUILT,
    )
    phase: tuple[float, ...] = parameter(
        (0.0, 0.0), 'phase of the sinusoid', unit='rad', length=_PER_JOINT, read_only=_BUILT
    )
    viscous: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'viscous friction',
        unit='N m s/rad',
        at_least=0.0,
        length=_PER_JOINT,
        read_only=_BUILT,
    )
    coulomb: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'Coulomb friction',
        unit='N m',
        at_least=0.0,
        length=_PER_JOINT,
        read_only=_BUILT,
    )
    coulomb_velocity: float = parameter(
        0.01,
        'velocity scale over which Coulomb friction changes sign',
        unit='rad/s',
        above=0.0,
        read_only=_BUILT,
    )


@dataclass(frozen=True)
class Sensor:
    """What is measured of the true state."""

    position_noise: float = parameter(
        0.0,
        'standard deviation of the white noise on each position',
        unit='rad',
        at_least=0.0,
        read_only=_BUILT,
    )
    velocity_noise: float = parameter(
        0.0,
        'standard deviation of the white noise on each measured velocity',
        unit='rad/s',
        at_least=0.0,
        read_only=_BUILT,
    )
    resolution: float = parameter(
        0.0, 'step of the encoders; 0: none', unit='rad', at_least=0.0, read_only=_BUILT
    )
    velocity: str = parameter(
        'measured',
        'velocity measured by itself, or as the difference of two measured positions',
        choices=('measured', 'differenced'),
        read_only=_BUILT,
    )


@dataclass(frozen=True)
class Actuator:
    """What becomes of a commanded torque."""

    torque_limit: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'largest torque of each motor; 0: no limit',
        unit='N m',
        at_least=0.0,
        length=_PER_JOINT,
        read_only=_BUILT,
    )
    delay: int = parameter(
        0,
        'samples by which the torque is late',
        unit='samples',
        at_least=0,
        at_most=1000,
        read_only=_BUILT,
    )
    command_timeout: float = parameter(
        0.05,
        'age from which on, in real time, a torque is not applied any more',
        unit='s',
        above=0.0,
    )
    without_command: str = parameter(
        'zero',
        'what the motors do then: no torque, or hold the joints with the brakes',
        choices=('zero', 'brake'),
    )


@dataclass(frozen=True)
class PlantConfig:
    """Parameters of `sim_plant`."""

    joints: tuple[str, ...] = parameter(
        ('joint1', 'joint2'), 'names of the joints, from the base on', read_only=_BUILT
    )
    sample_time: float = parameter(
        0.001,
        'time between two measured states, over which the torque is held',
        unit='s',
        symbol='T',
        at_least=1e-5,
        at_most=1.0,
        read_only=_BUILT,
    )
    mode: str = parameter(
        'realtime',
        'a step each sample time of the wall clock, or a step each torque received',
        choices=('realtime', 'lockstep'),
        read_only=_BUILT,
    )
    duration: float = parameter(
        0.0,
        'simulated time after which the plant ends; 0: until stopped',
        unit='s',
        at_least=0.0,
        read_only=_BUILT,
    )
    seed: int = parameter(
        0, 'seed of the noise: the same seed, the same run', at_least=0, read_only=_BUILT
    )
    publish_clock: bool = parameter(
        False,
        "publish the plant's time on /clock",
        read_only=_BUILT,
    )
    wait_for_subscribers: int = parameter(
        0,
        'observers each topic must have, beside the controller, before the first state is sent',
        at_least=0,
        read_only=_BUILT,
    )
    autostart: bool = autostart()
    integrator: str = parameter(
        'dopri5',
        'fixed-step method from one sample to the next: Dormand-Prince 5 or Runge-Kutta 4',
        choices=('dopri5', 'rk4'),
        read_only=_BUILT,
    )
    arm: PlantArm = PlantArm()
    initial: Initial = Initial()
    disturbance: PlantDisturbance = PlantDisturbance()
    sensor: Sensor = Sensor()
    actuator: Actuator = Actuator()
    realtime: Realtime = field(default_factory=Realtime)

    @property
    def sample_time_ns(self) -> int:
        """The sample time in nanoseconds."""
        return nanoseconds(self.sample_time)

    def problems(self) -> list[str]:
        """Return what is wrong beside the ranges of single parameters, in words."""
        problems = joint_problems(self.joints) + sample_time_problems(self.sample_time)
        if len(self.joints) != _JOINTS:
            problems.append(
                f'joints: got {len(self.joints)} {"name" if len(self.joints) == 1 else "names"}, '
                f'but the simulated arm has {_JOINTS} joints'
            )
        if 0.0 < self.duration < self.sample_time:
            problems.append(
                f'duration: got {self.duration:g} s, shorter than one sample of '
                f'{self.sample_time:g} s (0 runs until stopped)'
            )
        return problems


_JOINTS = 2

# SPDX-License-Identifier: Apache-2.0
"""What the controller can be told: the gains of the law (28), the reference, and the bound."""

from __future__ import annotations

from dataclasses import dataclass, field

from blf_dsc_controller.configuration.learning import Learning
from blf_dsc_controller.configuration.parameter import parameter
from blf_dsc_controller.configuration.sampling import (
    Realtime,
    joint_problems,
    nanoseconds,
    sample_time_problems,
)

_PER_JOINT = ('joints',)
_TONES = ('reference.frequency',)
_LAID_OUT = 'the state of the law is laid out for it at the start'
_JUMP = 'the reference would jump, out of the bound'
_MEASURED = 'what is already in the excitation window was measured with it'
_TOPICS = 'topics are created once, when the node starts'


@dataclass(frozen=True)
class Model:
    """Size of a model: how many joints and how many unknown parameters it has."""

    joints: int
    parameters: int


MODELS = {'two_link': Model(joints=2, parameters=3)}


@dataclass(frozen=True)
class Arm:
    """The geometry that the regressor needs; masses and the second link's length are unknown."""

    l1: float = parameter(
        1.0, 'length of the first link', unit='m', symbol='l1', above=0.0, read_only=_MEASURED
    )
    gravity: float = parameter(
        9.8, 'gravity; 0 for a horizontal arm', unit='m/s^2', symbol='g', read_only=_MEASURED
    )


@dataclass(frozen=True)
class Reference:
    """The trajectory to follow: qr_i = offset_i + sum_k amplitude_ik cos(frequency_k t + phase_k).

    `amplitude` holds a row for each joint, one row after the other.
    """

    offset: tuple[float, ...] = parameter(
        (1.9935, 1.3961), 'middle of the motion', unit='rad', length=_PER_JOINT, read_only=_JUMP
    )
    amplitude: tuple[float, ...] = parameter(
        (0.3, 0.3),
        'amplitude of each tone: a row for each joint, one after the other',
        unit='rad',
        length=('joints', 'reference.frequency'),
        read_only=_JUMP,
    )
    frequency: tuple[float, ...] = parameter(
        (1.0,), 'angular frequency of each tone', unit='rad/s', at_least=0.0, read_only=_JUMP
    )
    phase: tuple[float, ...] = parameter(
        (0.0,), 'phase of each tone', unit='rad', length=_TONES, read_only=_JUMP
    )


@dataclass(frozen=True)
class Barrier:
    """The bound on the tracking error and the torque that keeps it."""

    bound: tuple[float, ...] = parameter(
        (0.002, 0.002),
        'bound on the tracking error',
        unit='rad',
        symbol='k_c',
        above=0.0,
        length=_PER_JOINT,
    )
    weight: tuple[float, ...] = parameter(
        (1000.0, 1000.0),
        'stiffness of the barrier at no error; the paper has 1',
        unit='N m/rad',
        symbol='w',
        above=0.0,
        length=_PER_JOINT,
    )
    slope_limit: tuple[float, ...] = parameter(
        (2e4, 2e4),
        'stiffness from which on the barrier continues along a line',
        unit='N m/rad',
        symbol='S_lim',
        above=0.0,
        length=_PER_JOINT,
    )


@dataclass(frozen=True)
class Surface:
    """The virtual control (15), (18) and the filter (13) that it passes through."""

    gain: tuple[float, ...] = parameter(
        (150.0, 150.0),
        'gain of the virtual control on the tracking error',
        unit='1/s',
        symbol='K',
        at_least=0.0,
        length=_PER_JOINT,
    )
    mu: tuple[float, ...] = parameter(
        (20.0, 20.0),
        'the part of that gain which is left at the bound',
        unit='1/s',
        symbol='mu',
        at_least=0.0,
        length=_PER_JOINT,
    )
    time_constant: float = parameter(
        0.002, 'time constant of the surface filter', unit='s', symbol='lambda', above=0.0
    )


@dataclass(frozen=True)
class Feedback:
    """The feedback terms of the law (28)."""

    gain: tuple[float, ...] = parameter(
        (60.0, 20.0),
        'gain on the velocity error',
        unit='N m s/rad',
        symbol='K_p',
        at_least=0.0,
        length=_PER_JOINT,
    )
    damping: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'gain of the robust term d2 |xi1| sat(xi2/b)',
        unit='N m/rad',
        symbol='d2',
        at_least=0.0,
        length=_PER_JOINT,
    )
    boundary_layer: float = parameter(
        0.01,
        'velocity error at which the robust term saturates',
        unit='rad/s',
        symbol='b',
        above=0.0,
    )


@dataclass(frozen=True)
class Disturbance:
    """The disturbance estimate (30)."""

    gain: tuple[float, ...] = parameter(
        (1.0, 1.0),
        'adaptation gain of the disturbance estimate; 0: none',
        unit='N m/rad',
        symbol='gamma',
        at_least=0.0,
        length=_PER_JOINT,
    )
    leakage: float = parameter(
        0.0,
        'leakage that draws the disturbance estimate to zero',
        unit='rad/(N m s)',
        symbol='eta',
        at_least=0.0,
    )


@dataclass(frozen=True)
class Torque:
    """What the motors can give."""

    limit: tuple[float, ...] = parameter(
        (20.0, 20.0),
        'largest torque commanded; learning sees the limited torque',
        unit='N m',
        above=0.0,
        length=_PER_JOINT,
    )


@dataclass(frozen=True)
class Telemetry:
    """What the controller tells beside its commands."""

    enabled: bool = parameter(
        True,  # noqa: FBT003
        'publish reference, errors, estimates and monitors',
        read_only=_TOPICS,
    )


@dataclass(frozen=True)
class ControllerConfig:
    """Parameters of `blf_dsc_controller`; the defaults are the recommended set."""

    joints: tuple[str, ...] = parameter(
        ('joint1', 'joint2'), 'names of the joints, from the base on', read_only=_LAID_OUT
    )
    sample_time: float = parameter(
        0.001,
        'time between two joint states, over which the torque is held',
        unit='s',
        symbol='T',
        at_least=1e-5,
        at_most=1.0,
        read_only=_LAID_OUT,
    )
    law: str = parameter('blf_dsc', 'control law', choices=('blf_dsc',), read_only=_LAID_OUT)
    model: str = parameter(
        'two_link', 'model of the arm', choices=tuple(MODELS), read_only=_LAID_OUT
    )
    wait_for_subscribers: int = parameter(
        0,
        'observers each topic must have, beside the plant, before the first state is answered',
        at_least=0,
        read_only=_TOPICS,
    )
    arm: Arm = Arm()
    reference: Reference = Reference()
    barrier: Barrier = Barrier()
    surface: Surface = Surface()
    feedback: Feedback = Feedback()
    disturbance: Disturbance = Disturbance()
    torque: Torque = Torque()
    learning: Learning = field(default_factory=Learning)
    telemetry: Telemetry = Telemetry()
    realtime: Realtime = field(default_factory=Realtime)

    @property
    def sample_time_ns(self) -> int:
        """The sample time in nanoseconds."""
        return nanoseconds(self.sample_time)

    def problems(self) -> list[str]:
        """Return what is wrong beside the ranges of single parameters, in words."""
        model = MODELS[self.model]
        problems = joint_problems(self.joints) + sample_time_problems(self.sample_time)
        if len(self.joints) != model.joints:
            problems.append(
                f'joints: got {len(self.joints)} {"name" if len(self.joints) == 1 else "names"}, '
                f'but model {self.model} has {model.joints} joints'
            )
        problems += self._slope_problems()
        problems += self.learning.window_problems(self.sample_time)
        return problems + self.learning.estimate_problems(self.model, model.parameters)

    def _slope_problems(self) -> list[str]:
        barrier = self.barrier
        return [
            f'barrier.slope_limit: got {limit:g} N m/rad for {joint}, but it must be above '
            f'barrier.weight, {weight:g} N m/rad'
            for joint, weight, limit in zip(
                self.joints, barrier.weight, barrier.slope_limit, strict=True
            )
            if limit <= weight
        ]

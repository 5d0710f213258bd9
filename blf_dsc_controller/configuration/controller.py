# SPDX-License-Identifier: Apache-2.0
"""Parameters of the controller."""

from __future__ import annotations

from dataclasses import dataclass, field

from blf_dsc_controller.configuration.common import (
    Realtime,
    autostart,
    joint_problems,
    nanoseconds,
    sample_time_problems,
)
from blf_dsc_controller.configuration.gains import (
    Barrier,
    Comparison,
    Disturbance,
    Feedback,
    Surface,
    Torque,
    Truth,
)
from blf_dsc_controller.configuration.learning import Learning
from blf_dsc_controller.configuration.reference import Approach, MotionLimits, Reference
from blf_dsc_controller.configuration.schema import parameter

SAFE_TORQUES = ('zero', 'damping', 'hold_gravity')


WATCHDOGS = ('auto', 'on', 'off')


VELOCITIES = ('measured', 'estimated')


@dataclass(frozen=True)
class Safety:
    """MotionLimits past which the controller goes to its safe stop, and the torque it goes to."""

    state_timeout: float = parameter(
        0.04,
        'time by which a joint state may be late, on the steady clock and by its stamp',
        unit='s',
        above=0.0,
    )
    watchdog: str = parameter(
        'auto',
        'watch for silence on the steady clock; auto: if the stamps are of this time of day, '
        'which those of a lock-step plant are not',
        choices=WATCHDOGS,
    )
    repeated_states: int = parameter(
        3,
        'states with the stamp of the last one that are passed over in a row',
        unit='samples',
        at_least=0,
        at_most=1_000_000,
    )
    velocity: str = parameter(
        'measured',
        'velocity as measured, or estimated as the difference of two positions, from rest',
        choices=VELOCITIES,
        read_only='the filters hold what was measured with it',
    )
    velocity_limit: float = parameter(
        50.0,
        'velocity of a joint that is taken for a broken measurement',
        unit='rad/s',
        above=0.0,
    )
    error_ratio: float = parameter(
        1.0,
        'tracking error to stop at, as a multiple of the bound; only laws with a barrier are held '
        'to it; 0: never',
        at_least=0.0,
    )
    saturation_time: float = parameter(
        0.5, 'time for which a torque may be at its limit without a break', unit='s', above=0.0
    )
    overrun_fraction: float = parameter(
        0.4,
        'part of the states that may be missed, on average over overrun_window',
        above=0.0,
        at_most=1.0,
    )
    overrun_window: float = parameter(
        1.0, 'time over which missed states are averaged', unit='s', above=0.0
    )
    torque: str = parameter(
        'zero',
        'safe torque: none, damping -D dq, or the learned gravity with damping',
        choices=SAFE_TORQUES,
    )
    damping: tuple[float, ...] = parameter(
        (2.0, 1.0),
        'damping of the safe torques that have any',
        unit='N m s/rad',
        symbol='D',
        at_least=0.0,
        length=('joints',),
    )
    stop_ramp: float = parameter(
        0.0,
        'time from the last torque of the law to the safe one after a fault; 0: at once',
        unit='s',
        at_least=0.0,
    )
    deactivation_ramp: float = parameter(
        0.5, 'the same when the node is deactivated', unit='s', at_least=0.0
    )
    keep_estimates: bool = parameter(
        True,
        'go on from what was learned when the node is activated again; a reset forgets it',
    )


_LAID_OUT = 'the state of the law is laid out for it at the start'


_MEASURED = 'what is already in the excitation window was measured with it'


_TOPICS = 'topics are created once, when the node starts'


@dataclass(frozen=True)
class Model:
    """Size of a model: how many joints it has, None for any number."""

    joints: int | None

    def parameters(self, joints: int) -> int:
        """Number of unknown parameters: a planar arm has one for each pair of links."""
        return joints * (joints + 1) // 2


LAWS = ('blf_dsc', 'model_based', 'backstepping', 'slotine_li')


MODELS = {'two_link': Model(joints=2), 'planar_chain': Model(joints=None)}


@dataclass(frozen=True)
class ArmGeometry:
    """The geometry that the regressor needs; masses and the second link's length are unknown."""

    l1: float = parameter(
        1.0, 'length of the first link', unit='m', symbol='l1', above=0.0, read_only=_MEASURED
    )
    gravity: float = parameter(
        9.8, 'gravity; 0 for a horizontal arm', unit='m/s^2', symbol='g', read_only=_MEASURED
    )


@dataclass(frozen=True)
class Telemetry:
    """What the controller tells beside its commands."""

    enabled: bool = parameter(
        True,
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
    law: str = parameter('blf_dsc', 'control law', choices=LAWS, read_only=_LAID_OUT)
    model: str = parameter(
        'two_link', 'model of the arm', choices=tuple(MODELS), read_only=_LAID_OUT
    )
    wait_for_subscribers: int = parameter(
        0,
        'observers each topic must have, beside the plant, before the first state is answered',
        at_least=0,
        read_only=_TOPICS,
    )
    autostart: bool = autostart()
    arm: ArmGeometry = ArmGeometry()
    reference: Reference = field(default_factory=Reference)
    approach: Approach = field(default_factory=Approach)
    limits: MotionLimits = field(default_factory=MotionLimits)
    barrier: Barrier = field(default_factory=Barrier)
    surface: Surface = field(default_factory=Surface)
    feedback: Feedback = field(default_factory=Feedback)
    disturbance: Disturbance = field(default_factory=Disturbance)
    torque: Torque = field(default_factory=Torque)
    learning: Learning = field(default_factory=Learning)
    comparison: Comparison = field(default_factory=Comparison)
    truth: Truth = field(default_factory=Truth)
    safety: Safety = field(default_factory=Safety)
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
        count = model.parameters(model.joints or len(self.joints))
        if model.joints is not None and len(self.joints) != model.joints:
            problems.append(
                f'joints: got {len(self.joints)} {"name" if len(self.joints) == 1 else "names"}, '
                f'but model {self.model} has {model.joints} joints'
            )
        problems += self.reference.problems() + self.limits.problems(self.joints)
        problems += self.barrier.problems(self.joints)
        problems += self.learning.window_problems(self.sample_time)
        problems += self.truth.problems(self.law, self.model, count)
        return problems + self.learning.estimate_problems(self.model, count)

# SPDX-License-Identifier: Apache-2.0
"""The gains of the laws."""

from __future__ import annotations

from dataclasses import dataclass

from blf_dsc_controller.configuration.schema import parameter

_PER_JOINT = ('joints',)


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
    initial_bound: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'bound at the start, that narrows to `bound`; 0: the bound stands still',
        unit='rad',
        symbol='k_0',
        at_least=0.0,
        length=_PER_JOINT,
    )
    funnel_rate: float = parameter(
        0.0, 'rate at which the bound narrows', unit='1/s', symbol='a', at_least=0.0
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

    @property
    def widest(self) -> tuple[float, ...]:
        """Bound of each joint at the start [rad]."""
        return tuple(
            initial or bound for initial, bound in zip(self.initial_bound, self.bound, strict=True)
        )

    def problems(self, joints: tuple[str, ...]) -> list[str]:
        """Where weight and slope limit, or the bounds of the funnel, contradict each other."""
        slopes = [
            f'barrier.slope_limit: got {limit:g} N m/rad for {joint}, but it must be above '
            f'barrier.weight, {weight:g} N m/rad'
            for joint, weight, limit in zip(joints, self.weight, self.slope_limit, strict=True)
            if limit <= weight
        ]
        bounds = [
            f'barrier.initial_bound: got {initial:g} rad for {joint}, but it must be 0 (none) or '
            f'at least barrier.bound, {bound:g} rad'
            for joint, initial, bound in zip(joints, self.initial_bound, self.bound, strict=True)
            if 0.0 < initial < bound
        ]
        if self.funnel_rate == 0.0 and self.widest != self.bound:
            bounds.append(
                'barrier.funnel_rate: got 0 1/s, but barrier.initial_bound is to narrow to '
                'barrier.bound: give the rate at which it does'
            )
        return slopes + bounds


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
        'what is left of that gain at the bound',
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
        (100.0, 100.0),
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
    rate_limit: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'largest change of the torque commanded; 0: none',
        unit='N m/s',
        at_least=0.0,
        length=_PER_JOINT,
    )


_PER_JOINT = ('joints',)


_GIVEN = 'it is what is given, not what is tuned'


@dataclass(frozen=True)
class Comparison:
    """Gains of the laws `backstepping` (35) and `slotine_li`, beside feedback and learning."""

    surface_gain: tuple[float, ...] = parameter(
        (70.0, 70.0),
        'gain of the linear surface alpha2 = dqr - lambda_s z1',
        unit='1/s',
        symbol='lambda_s',
        above=0.0,
        length=_PER_JOINT,
    )
    position_gain: tuple[float, ...] = parameter(
        (1.0, 1.0),
        'gain on the tracking error z1; slotine_li has none',
        unit='N m/rad',
        symbol='w',
        at_least=0.0,
        length=_PER_JOINT,
    )
    robust_gain: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'amplitude of the robust term; slotine_li has none',
        unit='N m',
        symbol='mu_bar',
        at_least=0.0,
        length=_PER_JOINT,
    )
    leakage: float = parameter(
        0.001,
        'leakage of the parameter estimate; slotine_li has none',
        symbol='W_c',
        at_least=0.0,
    )


@dataclass(frozen=True)
class Truth:
    """What is known of the arm: the law `model_based` needs it, the monitors show it.

    The known disturbance is constant + amplitude*sin(frequency*t + phase) on each joint.
    """

    parameters: tuple[float, ...] = parameter(
        (),
        'true parameters; none: not known',
        unit='kg m^2',
        symbol='P',
        may_be_empty=True,
        read_only=_GIVEN,
    )
    constant: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'constant part of the disturbance',
        unit='N m',
        length=_PER_JOINT,
        read_only=_GIVEN,
    )
    amplitude: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'amplitude of its sinusoid',
        unit='N m',
        length=_PER_JOINT,
        read_only=_GIVEN,
    )
    frequency: tuple[float, ...] = parameter(
        (1.0, 1.0),
        'angular frequency of its sinusoid',
        unit='rad/s',
        at_least=0.0,
        length=_PER_JOINT,
        read_only=_GIVEN,
    )
    phase: tuple[float, ...] = parameter(
        (0.0, 0.0),
        'phase of its sinusoid',
        unit='rad',
        length=_PER_JOINT,
        read_only=_GIVEN,
    )
    feed_forward: bool = parameter(
        False,
        'compensate the known disturbance; model_based always does',
        read_only=_GIVEN,
    )

    def problems(self, law: str, model: str, count: int) -> list[str]:
        """Whether the true parameters fit the model, and are there where the law needs them."""
        given = len(self.parameters)
        if law == 'model_based' and given == 0:
            return ['truth.parameters: got none, but the law model_based needs them']
        if given not in (0, count):
            entries = 'entry' if given == 1 else 'entries'
            return [
                f'truth.parameters: got {given} {entries}, but model {model} has {count} parameters'
            ]
        return []

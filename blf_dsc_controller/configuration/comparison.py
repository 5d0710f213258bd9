# SPDX-License-Identifier: Apache-2.0
"""What only the other laws use: the comparison controller (35), and the truth where it is known."""

from __future__ import annotations

from dataclasses import dataclass

from blf_dsc_controller.configuration.parameter import parameter

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

# SPDX-License-Identifier: Apache-2.0
"""Known data of the arm: a group of the controller only if some of it is given.

The law `model_based` needs it; of other laws, the terms of (29) follow from it. Nobody
knows it of a real arm.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from blf_dsc_controller.configuration.controller_groups import misfits
from blf_dsc_controller.configuration.schema import PerJoint, parameter, parameters

_known = partial(parameter, read_only='it is known data, not a gain')
GROUP = 'truth'
"""Group of the known data."""


@dataclass(frozen=True)
class KnownArm:
    """Known data of the arm: required by the law `model_based`, shown by the monitors.

    The known disturbance is constant + amplitude*sin(frequency*t + phase) on each
    joint.
    """

    parameters: tuple[float, ...] = _known(
        (), 'true parameters; empty: unknown', 'kg m^2', 'P', omittable=True
    )
    constant: PerJoint = _known(
        (0.0, 0.0), 'constant part of the known disturbance', 'N m'
    )
    amplitude: PerJoint = _known((0.0, 0.0), 'amplitude of the sinusoid', 'N m')
    frequency: PerJoint = _known(
        (1.0, 1.0), 'frequency of the sinusoid', 'rad/s', at_least=0.0
    )
    phase: PerJoint = _known((0.0, 0.0), 'phase of the sinusoid', 'rad')

    def problems(self, law: str, model: str, count: int) -> Iterator[str]:
        """Check that the parameters fit the model, and are given if required."""
        if law == 'model_based' and not self.parameters:
            yield 'truth.parameters: got none, but the law model_based needs them'
        if self.parameters:
            yield from misfits('truth.parameters', self.parameters, model, count)


NAMES = frozenset(f'{GROUP}.{param.name}' for param in parameters(KnownArm))
"""Names of the known data."""


def is_asked_for(given: Mapping[str, Any]) -> bool:
    """Return whether given parameters of the controller have known data, or need it."""
    return given.get('law') == 'model_based' or not NAMES.isdisjoint(given)


def known_arm(config: object) -> KnownArm | None:
    """Return the known data of a configuration of the controller; None: it has none."""
    known: KnownArm | None = getattr(config, GROUP, None)
    return known

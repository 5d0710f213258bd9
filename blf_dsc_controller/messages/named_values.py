# SPDX-License-Identifier: Apache-2.0
"""Names of the values in vectors, and a load that is one of them as text.

Vectors of named values are sent as JointState with the values in `position`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.messages import topics


def monitored(
    config: ControllerConfig, estimates: Sequence[str]
) -> dict[str, Sequence[str]]:
    """Return the parts of a `Sample` that `~/monitor` has, each with the names of its values.

    `estimates` are those of theta^, as returned by `factory.estimate.estimate_names`.
    """
    names: dict[str, Sequence[str]] = {
        'estimate': estimates,
        'disturbance': disturbance_names(config.joints),
        'lambda_min': (topics.LAMBDA_MIN,),
        'latched': (topics.LATCHED,),
        'changes': (topics.MODEL_CHANGES,),
    }
    if config.weighs:
        names['load'] = topics.LOAD
    if config.contact.enabled:
        names['contact'] = topics.CONTACT
    return names


def disturbance_names(joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the disturbance torques, estimated or true."""
    return tuple(topics.DISTURBANCE + joint for joint in joints)


def external_names(joints: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the torques from outside, and of half of their 95 % intervals."""
    return *joints, *(joint + topics.INTERVAL for joint in joints)


def load_text(load: Sequence[float]) -> str:
    """Return what the tip holds as text, from the values (8,) of LOAD."""
    mass, *centre = load[:4]
    interval, *spread = load[4:]
    if not math.isfinite(mass):
        return 'unknown'
    text = f'{mass:.3f} +- {interval:.2g} kg'
    if mass < -interval:
        return f'{text}: lighter than at the start, so something was held then'
    if not math.isfinite(centre[0]):
        return text
    each = (
        f'{1e3 * c:.1f} +- {1e3 * s:.2g}' for c, s in zip(centre, spread, strict=True)
    )
    return f'{text}, its centre at {", ".join(each)} mm'

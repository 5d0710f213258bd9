# SPDX-License-Identifier: Apache-2.0
"""The configuration of the controller: its parameters, those of its law, and what follows."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from typing import Any

from blf_dsc_controller.arms import tuning
from blf_dsc_controller.arms.known_gears import Gears
from blf_dsc_controller.configuration import controller_rules, law_file, two_link
from blf_dsc_controller.configuration.arm_defaults import (
    followed_by,
    stated_design,
    used_design,
)
from blf_dsc_controller.configuration.controller_parameters import (
    ControllerParameters,
)
from blf_dsc_controller.configuration.law_traits import OWN, gains_of
from blf_dsc_controller.configuration.robot import parameters_of
from blf_dsc_controller.configuration.rules import Finding
from blf_dsc_controller.configuration.schema import (
    Value,
    build,
    flatten,
)


class ControllerConfig(ControllerParameters):
    """Parameters of the node `blf_dsc_controller`; the defaults are the recommended set."""

    @classmethod
    def variant(cls, given: Mapping[str, Any]) -> type[ControllerConfig]:
        """Return the configuration with the gains that only the given law has.

        Raises BlfDscError if there is no such law.
        """
        law = given.get('law', OWN)
        gains = gains_of(law) if isinstance(law, str) else None
        return _with_groups(gains, planar=not given.get('robot.urdf'))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by values.

        The class with the gains of a law is made when they are read.
        """
        return build, (ControllerConfig, flatten(self))

    @classmethod
    def defaults(cls, given: Mapping[str, Any]) -> Mapping[str, Value]:
        """Return gains and limits for the arm of a URDF; the defaults suit the two-link arm."""
        return followed_by(given)

    def problems(self) -> Iterator[Finding]:
        """Check the parameters against each other and against the model."""
        return controller_rules.problems(self)


def used_design_of(config: ControllerConfig) -> tuning.Design:
    """Return what the gains of an arm from a URDF follow from: its gears, if nothing is given."""
    chain = config.robot.chain(config.joints)
    base = parameters_of(config.robot, chain)
    return used_design(flatten(config), config.robot, chain, base)


def design_of(config: ControllerConfig) -> tuple[tuning.Design, Gears | None]:
    """Return what the gains of an arm from a URDF follow from, and its gears, if known."""
    chain = config.robot.chain(config.joints)
    base = parameters_of(config.robot, chain)
    return stated_design(flatten(config), config.robot, chain, base)


@functools.cache
def _with_groups(gains: type | None, *, planar: bool) -> type[ControllerConfig]:
    """Return the configuration with the gains of a law, and those of two links."""
    groups: dict[str, type] = {}
    if planar:
        groups[two_link.GROUP] = two_link.TwoLink
    if gains:
        groups[law_file.GROUP] = gains
    if not groups:
        return ControllerConfig
    return dataclasses.make_dataclass(
        'ControllerConfig',
        [
            (name, group, dataclasses.field(default=group()))
            for name, group in groups.items()
        ],
        bases=(ControllerConfig,),
        frozen=True,
    )

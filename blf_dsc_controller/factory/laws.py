# SPDX-License-Identifier: Apache-2.0
"""The law of a configuration: `blf_dsc` (28), or that of a file."""

from __future__ import annotations

import dataclasses

from blf_dsc_controller.compiled.layout import size_of
from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.factory.inertia import least_inertias
from blf_dsc_controller.law.blf_dsc import BlfDsc
from blf_dsc_controller.law.interface import Law
from blf_dsc_controller.law.state import Settings


def law_of(config: ControllerConfig) -> Law:
    """Return the law of a configuration, with its own gains."""
    if not law_file.has_file(config.law):
        return BlfDsc()
    gains = getattr(config, law_file.GROUP)
    law: Law = law_file.load_law(config.law)(**dataclasses.asdict(gains))
    return law


def with_memory(config: ControllerConfig, settings: Settings) -> Settings:
    """Return the settings with the memory of a law of a file, and inertias to scale gains by."""
    if not law_file.has_file(config.law):
        return settings
    memory = law_file.memory_of(law_file.load_law(config.law))
    return settings._replace(
        joint_inertia=least_inertias(config),
        memory=size_of(memory)(settings) if memory else 0,
    )

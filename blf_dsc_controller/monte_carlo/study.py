# SPDX-License-Identifier: Apache-2.0
"""A study: a closed loop, what of it varies, and the run that each index stands for."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.monte_carlo.configuration import MonteCarloConfig
from blf_dsc_controller.monte_carlo.distribution import Value
from blf_dsc_controller.monte_carlo.variations import Spread, slots

NODE = 'monte_carlo'
"""Name of the section that tells what varies."""


@dataclass(frozen=True)
class Study:
    """All that determines the results."""

    controller: ControllerConfig
    plant: PlantConfig
    settings: MonteCarloConfig
    spreads: tuple[Spread, ...]

    def flat(self) -> dict[str, object]:
        """Every value by its node and name, with the distributions as they are written."""
        nodes = {PLANT: self.plant, CONTROLLER: self.controller, NODE: self.settings}
        told: dict[str, object] = {
            f'{node}.{name}': value
            for node, config in nodes.items()
            for name, value in flatten(config).items()
        }
        return told | {f'{NODE}.vary.{name}': text for name, text in self.varied().items()}

    def varied(self) -> dict[str, str | tuple[str, ...]]:
        """Distributions as they are written: a list for a parameter of each joint."""
        written: dict[str, str | tuple[str, ...]] = {}
        for one in self.spreads:
            text = str(one.distribution)
            if one.entry < 0:
                written[one.name] = text
            else:
                written[one.name] = (*written.get(one.name, ()), text)
        return written


class Origin(NamedTuple):
    """Where the reference and the bound begin, which a start is told relative to."""

    qr: np.ndarray  # (n,) rad
    dqr: np.ndarray  # (n,) rad/s
    bound: np.ndarray  # (n,) rad


@dataclass(frozen=True)
class Draw:
    """What run `index` has for its own.

    Attributes:
        index: of the run.
        seed: of the sensor noise.
        values: of the spreads, in their order.
    """

    index: int
    seed: int
    values: tuple[Value, ...]


def draw(study: Study, index: int) -> Draw:
    """Draw run `index`: nothing but the seed of the study and the index goes into it.

    Each spread has a random number of its own, which it keeps whatever else varies: two studies of
    one seed that differ in one distribution meet the same arms.
    """
    sequence = np.random.SeedSequence(study.settings.seed, spawn_key=(index,))
    rng = np.random.Generator(np.random.PCG64(sequence))
    seed = int(rng.integers(2**62))
    numbers = rng.random(slots(len(study.plant.joints))).tolist()
    values = tuple(one.distribution.at(numbers[one.slot]) for one in study.spreads)
    return Draw(index, seed, values)


def origin_of(controller: Controller) -> Origin:
    """Origin of a controller that has not begun."""
    qr, dqr, _ = controller.reference_at(0.0)
    return Origin(qr, dqr, controller.bound_at(0.0))


def plant_of_draw(study: Study, drawn: Draw, origin: Origin) -> PlantConfig:
    """Configuration of the plant of a run.

    Args:
        study: that it is a run of.
        drawn: the run.
        origin: of the controller of the study.
    """
    changes: dict[str, dict[str, Any]] = {}
    for one, value in zip(study.spreads, drawn.values, strict=True):
        group, _, field = one.name.partition('.')
        section = changes.setdefault(group, {})
        if one.entry < 0:
            section[field] = value
        else:
            before = section.get(field, getattr(getattr(study.plant, group), field, None))
            entries = list(before or [0.0] * len(study.plant.joints))
            entries[one.entry] = value
            section[field] = tuple(entries)
    changes['initial'] = _start(changes.get('initial', {}), origin)
    groups = {
        group: dataclasses.replace(getattr(study.plant, group), **section)
        for group, section in changes.items()
    }
    return dataclasses.replace(study.plant, seed=drawn.seed, **groups)


def _start(relative: Mapping[str, tuple[float, ...]], origin: Origin) -> dict[str, Any]:
    """Position and velocity of a start that is told relative to the reference."""
    start: dict[str, Any] = {}
    if 'error' in relative:
        start['position'] = tuple((origin.qr + origin.bound * relative['error']).tolist())
    if 'velocity_error' in relative:
        start['velocity'] = tuple((origin.dqr + relative['velocity_error']).tolist())
    return start

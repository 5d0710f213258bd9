# SPDX-License-Identifier: Apache-2.0
"""Commissioning of a simulated arm: the runs that a real arm makes, and the proof."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from blf_dsc_controller.commissioning.commissioning import Planned
from blf_dsc_controller.commissioning.own_loop import (
    REPEATS,
    Commissioning,
    Measured,
)
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.simulation.loop import simulate

_PROOF = 30.0  # s, at most


class Proof(NamedTuple):
    """What a simulated arm does with its new gains, along its own reference."""

    duration: float  # s
    error: float  # rad, the largest
    stop: str  # empty: none


def measured(planned: Planned, plant: PlantConfig, payload: float = 0.0) -> Measured:
    """Return a run of a motion, of an arm with a payload [kg] that its law does not know.

    Raises BlfDscError if the arm stopped.
    """
    loaded = [payload] if payload else []
    arm = {
        'duration': planned.duration,
        'initial.position': planned.posture.tolist(),
        'events.begin': [0.0] * len(loaded),
        'events.duration': [0.0] * len(loaded),
        'events.payload': loaded,
    }
    run = simulate(planned.config, change(plant, arm)).run()
    for stop in run.stops:
        raise BlfDscError(f'the simulated arm stopped: {stop.text}')
    return run, planned.config


def proof(loop: LoopConfig) -> Proof:
    """Return what an arm does along its own reference."""
    plant = loop.plant
    duration = min(plant.duration or _PROOF, _PROOF)
    run = simulate(loop.controller, change(plant, {'duration': duration})).run()
    stop = next((each.text for each in run.stops), '')
    error = np.zeros(1) if run.error is None else run.error
    return Proof(duration, float(np.nanmax(np.abs(error))), stop)


def runs_of(
    commissioning: Commissioning, loop: LoopConfig
) -> Iterator[tuple[str, Measured | BlfDscError]]:
    """Yield the runs of all motions, then one with the rated payload, with their names.

    Where noise or friction hide much, it is the run of another motion.  The last one may be beyond
    what soft gains hold: then it is the error.
    """
    strongest: list[Planned] = []
    planned = commissioning.motions_from(loop.plant.initial.position)
    for k, each in enumerate(planned, 1):
        shaken = commissioning.motion(each.posture)
        run = measured(shaken, loop.plant)
        for _ in range(REPEATS):
            again = commissioning.stronger(shaken, run[0])
            if again is None:
                break
            shaken, run = again, measured(again, loop.plant)
        strongest.append(shaken)
        yield f'posture {k}', run
    payload = loop.controller.robot.payload
    name = f'posture 1 with {payload:g} kg'
    try:
        yield name, measured(strongest[0], loop.plant, payload)
    except BlfDscError as error:
        yield name, error

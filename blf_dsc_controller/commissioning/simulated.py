# SPDX-License-Identifier: Apache-2.0
"""Commissioning of a simulated arm: the runs that a real arm makes, and the proof."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from blf_dsc_controller.commissioning.commissioning import REPEATS, Commissioning
from blf_dsc_controller.commissioning.measurement import Measured, oscillation_in
from blf_dsc_controller.commissioning.planned import Planned
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.configuration.plant import PlantConfig, pick_ups
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.simulation.loop import simulate

Floats = NDArray[np.float64]

_PROOF = 30.0  # s, at most


class Proof(NamedTuple):
    """What a simulated arm does with its new gains, along its own reference."""

    duration: float  # s
    error: Floats  # (n,) rad, the largest of each joint
    stop: str  # empty: none


def measured(
    planned: Planned,
    plant: PlantConfig,
    payload: float = 0.0,
    *,
    oscillates: bool = False,
) -> Measured:
    """Return a run of a motion, of an arm with a payload [kg] that its law does not know.

    Raises BlfDscError if the arm stopped, unless it may oscillate, and did.
    """
    return _run(
        planned.config,
        plant,
        planned.duration,
        planned.posture,
        payload,
        oscillates=oscillates,
    )


def _run(
    config: ControllerConfig,
    plant: PlantConfig,
    duration: float,
    begin: Floats,
    payload: float = 0.0,
    *,
    oscillates: bool = False,
) -> Measured:
    """Return a run from `begin` (n,) [rad]; events of the plant are left out.

    Raises BlfDscError if the arm stopped, unless it may oscillate, and did.
    """
    loaded = [payload] if payload else []
    arm = {
        'duration': duration,
        'initial.position': begin.tolist(),
    } | pick_ups([0.0] * len(loaded), loaded)
    run = simulate(config, change(plant, arm)).run()
    for stop in run.stops:
        if not (oscillates and oscillation_in(run)):
            raise BlfDscError(f'the simulated arm stopped: {stop.text}')
    return Measured(run, config)


def proof(loop: LoopConfig) -> Proof:
    """Return what an arm does along its own reference."""
    plant = loop.plant
    duration = min(plant.duration or _PROOF, _PROOF)
    run = simulate(loop.controller, change(plant, {'duration': duration})).run()
    stop = next((each.text for each in run.stops), '')
    largest = np.zeros(len(run.joints))
    if run.error is not None:
        largest = np.nanmax(np.abs(run.error), axis=0)
    return Proof(duration, largest, stop)


def runs_of(
    commissioning: Commissioning, loop: LoopConfig
) -> Iterator[tuple[str, Measured | BlfDscError]]:
    """Yield names and runs: one in each posture, then the first motion with the rated payload.

    A posture in which noise or friction hide much is measured again, and its last run counts.  Soft
    gains may not hold the payload: then the error is yielded in the place of the run.
    """
    plant = loop.plant
    postures = [
        each.posture for each in commissioning.motions_from(plant.initial.position)
    ]
    motions = []
    for k, posture in enumerate(postures, 1):
        planned, seen = _measure(commissioning, posture, plant)
        while k == 1 and (better := commissioning.better_known(planned, seen.run)):
            commissioning = better
            planned, seen = _measure(commissioning, posture, plant)
        motions.append(planned)
        yield f'posture {k}', seen
    payload = loop.controller.robot.payload
    name = f'posture 1 with {payload:g} kg'
    try:
        yield name, measured(motions[0], plant, payload)
    except BlfDscError as error:
        yield name, error


def _measure(
    commissioning: Commissioning, posture: Floats, plant: PlantConfig
) -> tuple[Planned, Measured]:
    """Measure around a posture (n,) [rad], again if need be; return the last motion and its run."""
    planned = commissioning.motion(posture)
    repeats = 0
    while True:
        seen = measured(planned, plant, oscillates=True)
        if not oscillation_in(seen.run):
            repeats += 1
        if repeats > REPEATS:
            return planned, seen
        again = commissioning.plan_repeat(planned, seen.run)
        if again is None:
            return planned, seen
        planned = again

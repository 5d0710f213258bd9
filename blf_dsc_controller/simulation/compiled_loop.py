# SPDX-License-Identifier: Apache-2.0
"""The closed loop of the kernels that the nodes run, compiled: a span of samples in one call.

The loop calls the kernels by their addresses, so that it is compiled once for each kind
of law and arm, in seconds, and never compiles the law or the arm again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.entry import invoke, loop
from blf_dsc_controller.compiled.jit import direct, inner
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law.check_state import (
    INVALID,
    NOT_SENSORS,
    OSCILLATES,
    SUSPECT,
    are_on,
)
from blf_dsc_controller.law.laws import for_law
from sim_plant.kernels import OBSERVE, STEP, TRUTH

if TYPE_CHECKING:  # else the loop would be compiled again whenever one of these changes
    from collections.abc import Callable

    from blf_dsc_controller.arms.model import ArmModel
    from blf_dsc_controller.compiled.entry import Entry
    from blf_dsc_controller.law.called_law import CalledLaw
    from blf_dsc_controller.law.controller import Controller, LawKernels
    from blf_dsc_controller.law.interface import Law
    from sim_plant.arm import Arm
    from sim_plant.sampled_plant import Plant


class Span(NamedTuple):
    """Samples that follow each other, and what is done with them."""

    first: int
    last: int
    is_end: bool  # the torque of the last one is not applied
    # also compute what no torque depends on: (29), load, external torque
    observed: bool


class Rows(NamedTuple):
    """Matrices with a row for each sample of a span."""

    measurements: np.ndarray
    samples: np.ndarray
    truths: np.ndarray


class PlantArguments(NamedTuple):
    """The kernel of a plant, and its arguments."""

    run: Entry
    arm: Arm
    settings: np.ndarray
    state: np.ndarray
    noise: np.ndarray  # a row for each sample
    period_ns: int


class LawArguments(NamedTuple):
    """The kernels of a controller, and their arguments."""

    kernels: LawKernels
    law: Law | CalledLaw
    model: ArmModel
    settings: np.ndarray
    state: np.ndarray
    signals: np.ndarray
    checks: np.ndarray
    reference: np.ndarray
    torque_at: int  # entry of a sample at which its torque begins
    perceives: bool  # find the load and contacts
    ends_at_contact: bool


@inner
def run_plant(
    plant: PlantArguments, tasks: int, torque: np.ndarray, row: int, rows: Rows
) -> None:
    """Do the tasks, which read a torque and write to a row."""
    invoke(
        plant.run,
        plant.arm,
        plant.settings,
        plant.state,
        plant.noise[row],
        tasks,
        torque,
        rows.measurements[row],
        rows.truths[row],
    )


@inner
def run_law(
    law: LawArguments, t: float, dt: float, observed: bool, row: int, rows: Rows
) -> int:
    """Run the law on the measurement of a row; return its flags."""
    flags: int = invoke(
        law.kernels.update,
        law.law,
        law.model,
        law.settings,
        law.state,
        law.signals,
        rows.samples[row],
        law.checks,
        rows.measurements[row],
        law.reference,
        t,
        dt,
        observed,
    )
    return flags


@inner
def perceive(law: LawArguments, dt: float, sample: np.ndarray) -> bool:
    """Weigh the load and find the external torque; return whether a contact begins."""
    vectors = law.settings, law.state, law.signals
    invoke(law.kernels.weigh, law.model, *vectors, dt)
    begins: bool = invoke(law.kernels.sense, law.model, *vectors, sample, dt)
    return begins


@loop
def run_loop(span: Span, plant: PlantArguments, law: LawArguments, rows: Rows) -> bool:
    """Implement `CompiledLoop.run`."""
    dt = plant.period_ns * 1e-9
    n = rows.measurements.shape[1] // 3
    torque = part(rows.samples[0], law.torque_at, (n,))
    run_plant(plant, OBSERVE | TRUTH, torque, 0, rows)
    for k in range(span.first, span.last + 1):
        row = k - span.first
        t = (k * plant.period_ns) * 1e-9
        if row > 0:
            run_plant(plant, STEP | OBSERVE | TRUTH, torque, row, rows)
        flags = run_law(law, t, dt, span.observed, row, rows)
        if flags & (INVALID | SUSPECT | OSCILLATES | NOT_SENSORS):
            return False
        sample = rows.samples[row]
        if law.perceives and perceive(law, dt, sample) and law.ends_at_contact:
            return False
        torque = part(sample, law.torque_at, (n,))
    if not span.is_end:
        run_plant(plant, STEP, torque, span.last - span.first, rows)
    return True


class CompiledLoop:
    """A controller and a plant, which `run_loop` runs."""

    def __init__(self, controller: Controller, plant: Plant) -> None:
        self._controller, self._plant = controller, plant
        self._run: Callable[..., bool] | None = None

    def run(self, span: Span, rows: Rows) -> bool:
        """Run a span of samples; return False where a check stops it, in mid-sample.

        With checks (`law.checks`), that is the first invalid or suspect sample, or one in which
        a contact begins, or an oscillation or efforts that are no sensors' are reported.
        """
        law = self._of_law(span)
        arguments = span, self._of_plant(span), law, rows
        if self._run is None:
            self._run = direct(for_law(run_loop, law.law), *arguments)
        return self._run(*arguments)

    def _of_plant(self, span: Span) -> PlantArguments:
        plant = self._plant
        return PlantArguments(
            plant.kernel,
            plant.arm,
            plant.settings,
            plant.state,
            plant.noise_of(span.last - span.first + 1),
            plant.period_ns,
        )

    def _of_law(self, span: Span) -> LawArguments:
        controller = self._controller
        settings = controller.settings
        return LawArguments(
            controller.kernels,
            controller.given_law,
            settings.model,
            controller.settings_vector,
            controller.state_vector,
            controller.signals_vector,
            controller.checks_vector,
            controller.reference_vector,
            controller.torque_at,
            perceives=span.observed or settings.contact.freezes == 1,
            ends_at_contact=are_on(controller.checks),
        )

# SPDX-License-Identifier: Apache-2.0
"""The closed loop of the kernels that the nodes run, compiled: a span of samples in one call.

The loop calls the kernels by their addresses, so that it is compiled once for each kind
of law and arm, in seconds, and never compiles the law or the arm again.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from blf_dsc_controller.compiled.entry import invoke, loop
from blf_dsc_controller.compiled.views import part
from blf_dsc_controller.law.check_state import INVALID, SUSPECT
from blf_dsc_controller.law.laws import for_law
from sim_plant.kernels import OBSERVE, STEP, TRUTH

if TYPE_CHECKING:  # else the loop would be compiled again whenever one of these changes
    from blf_dsc_controller.arms.model import ArmModel
    from blf_dsc_controller.compiled.entry import Entry
    from blf_dsc_controller.law.controller import Controller, LawKernels
    from blf_dsc_controller.law.interface import Law
    from sim_plant.arm import Arm
    from sim_plant.plant import Plant


class Span(NamedTuple):
    """Samples that follow each other, and what is done with them."""

    first: int
    last: int
    is_end: bool  # the torque of the last one is not applied
    observed: (
        bool  # also compute what no torque depends on: (29), load, external torque
    )


@loop
def run_loop(
    first: int,
    last: int,
    is_end: bool,
    observed: bool,
    perceives: bool,
    ends_at_contact: bool,
    run_plant: Entry,
    arm: Arm,
    plant_settings: np.ndarray,
    plant_state: np.ndarray,
    rng: np.random.Generator,
    period_ns: int,
    of_law: LawKernels,
    law: Law,
    model: ArmModel,
    settings: np.ndarray,
    state: np.ndarray,
    signals: np.ndarray,
    checks: np.ndarray,
    reference: np.ndarray,
    torque_at: int,
    measurements: np.ndarray,
    samples: np.ndarray,
    truths: np.ndarray,
) -> bool:
    """Implement `run_span`; the torque begins at entry `torque_at` of a sample."""
    dt = period_ns * 1e-9
    n = measurements.shape[1] // 3
    torque = part(samples[0], torque_at, (n,))
    tasks = OBSERVE | TRUTH
    for k in range(first, last + 1):
        row = k - first
        t = (k * period_ns) * 1e-9
        measurement = measurements[row]
        sample = samples[row]
        invoke(
            run_plant,
            arm,
            plant_settings,
            plant_state,
            rng,
            tasks,
            torque,
            measurement,
            truths[row],
        )
        flags = invoke(
            of_law.update,
            law,
            model,
            settings,
            state,
            signals,
            sample,
            checks,
            measurement,
            reference,
            t,
            dt,
            observed,
        )
        if flags & (INVALID | SUSPECT):
            return False
        if perceives:
            invoke(of_law.weigh, model, settings, state, signals, dt)
            begins = invoke(of_law.sense, model, settings, state, signals, sample, dt)
            if begins and ends_at_contact:
                return False
        torque = part(sample, torque_at, (n,))
        tasks = STEP | OBSERVE | TRUTH
    if not is_end:
        row = last - first
        invoke(
            run_plant,
            arm,
            plant_settings,
            plant_state,
            rng,
            STEP,
            torque,
            measurements[row],
            truths[row],
        )
    return True


class Rows(NamedTuple):
    """Matrices with a row for each sample of a span."""

    measurements: np.ndarray
    samples: np.ndarray
    truths: np.ndarray


def run_span(controller: Controller, plant: Plant, span: Span, rows: Rows) -> bool:
    """Run a span of samples; return False where a check stops it, in mid-sample.

    With checks (`law.checks`), that is the first invalid or suspect sample, or one in which
    a contact begins.
    """
    settings = controller.settings
    perceives = span.observed or settings.freezes == 1
    run = for_law(run_loop, controller.law)
    kept: bool = run(
        span.first,
        span.last,
        span.is_end,
        span.observed,
        perceives,
        bool(controller.checks.velocity_limit[0] > 0.0),
        plant.kernel,
        plant.arm,
        plant.settings,
        plant.state,
        plant.rng,
        plant.period_ns,
        controller.kernels,
        controller.law,
        settings.model,
        controller.settings_vector,
        controller.state_vector,
        controller.signals_vector,
        controller.checks_vector,
        controller.reference_vector,
        controller.torque_at,
        *rows,
    )
    return kept

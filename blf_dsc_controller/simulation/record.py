# SPDX-License-Identifier: Apache-2.0
"""All samples of a run without ROS."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.state import Sample, sample_of
from blf_dsc_controller.messages.journal import EventType, Journal
from blf_dsc_controller.messages.samples import run_of
from blf_dsc_controller.messages.telemetry import disturbance_names
from blf_dsc_controller.run import Run, Series, Stop
from sim_plant.plant import Plant

START = 1_000_000_000
"""Stamp of the first sample [ns], as in lock-step."""


@dataclass(frozen=True)
class Record:
    """All samples of a run, one row each."""

    stamps: np.ndarray  # (k,) ns, since the start
    measurements: np.ndarray  # (k, 3 n) [q, dq, applied torque of the last interval]
    samples: np.ndarray  # (k, s) rows of `law.state.Sample`; after a stop NaN except bound, torque
    truths: np.ndarray  # (k, p + 3 n) [P, tau_dist, q, dq]
    parameters: tuple[str, ...]  # names of the entries of P
    config: ControllerConfig
    controller: Controller  # after the run
    journal: Journal  # events of the run, their stamps from `START` on

    def sample(self, row: int) -> Sample:
        """Return one row of `samples` with named fields."""
        return sample_of(self.samples[row], self.controller.settings)

    def run(self) -> Run:
        """Return all samples as a `Run`, with the truth and the terms of (29) that the law has."""
        config = self.config
        run = run_of(config, self.controller, self.stamps, self.measurements, self.samples)
        true = (*self.parameters, *disturbance_names(config.joints))
        return replace(
            run,
            truth=Series(true, self.stamps, self.truths[:, : len(true)]),
            stops=tuple(
                Stop(event.stamp - START, f'{event.content["reason"]}', event.content['text'])
                for event in self.journal.pending
                if event.type is EventType.STOP
            ),
        )


def new_record(
    config: ControllerConfig,
    controller: Controller,
    plant: Plant,
    parameters: tuple[str, ...],
    rows: int,
    journal: Journal,
) -> Record:
    """Return a record of `rows` samples to fill; `parameters` are the names of the plant's."""
    return Record(
        stamps=np.arange(rows, dtype=np.int64) * plant.period_ns,
        measurements=np.zeros((rows, 3 * plant.joints)),
        samples=np.zeros((rows, controller.sample_vector.size)),
        truths=np.zeros((rows, plant.truth().size)),
        parameters=parameters,
        config=config,
        controller=controller,
        journal=journal,
    )

# SPDX-License-Identifier: Apache-2.0
"""The closed loop without ROS: the kernels that the nodes run, in one compiled loop.

A lock-step run over ROS and an offline run of the same configuration agree bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.compiled.views import borrowed
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.law.controller import Controller, answer
from blf_dsc_controller.law.factory import begin, controller_of, estimate_names
from blf_dsc_controller.law.rejected_columns import refusals
from blf_dsc_controller.law.sample import Sample, sample_of
from blf_dsc_controller.law.settings import settings_of
from blf_dsc_controller.law.state import signals_of, state_of
from blf_dsc_controller.messages.monitor import LYAPUNOV_TERMS
from blf_dsc_controller.messages.names import LAMBDA_MIN, LATCHED
from blf_dsc_controller.messages.telemetry import disturbance_names
from blf_dsc_controller.run import Run, Series
from sim_plant import plant as plants
from sim_plant.factory import plant_of, steps_of
from sim_plant.sampled import Plant

_CHUNK = 1000  # samples between two reports of progress


@dataclass(frozen=True)
class Record:
    """All samples of a run, a row each.

    Attributes:
        stamps: time since the start (k,) [ns].
        measurements: [q, dq, applied torque of the last interval] (k, 3 n).
        samples: rows of `core.sample` (k, s).
        truths: [P, tau_dist, q, dq] (k, p + 3 n).
        joints: number of joints n.
        estimates: number of estimates m.
        controller: the law as the run has left it.
    """

    stamps: np.ndarray
    measurements: np.ndarray
    samples: np.ndarray
    truths: np.ndarray
    joints: int
    estimates: int
    controller: Controller

    def sample(self, row: int) -> Sample:
        """Names for one row of `samples`."""
        return sample_of(self.samples[row], self.controller.settings)

    def run(self, config: ControllerConfig) -> Run:
        """All samples as a `Run`, with the truth and the terms of (29) at each of them."""
        settings, names = self.controller.settings, estimate_names(config)
        columns = sample_of(np.arange(self.samples.shape[1], dtype=np.float64), settings)
        part = {
            name: self.samples[:, getattr(columns, name).astype(int)] for name in columns._fields
        }
        disturbances = disturbance_names(config.joints)
        learned = [part[name] for name in ('estimate', 'disturbance', 'lambda_min', 'latched')]
        position, velocity, _ = np.split(self.measurements, 3, axis=1)
        true = (*names[: settings.p], *disturbances)
        return Run(
            joints=config.joints,
            stamp=self.stamps,
            received=self.stamps,
            position=position,
            velocity=velocity,
            torque=part['torque'],
            reference=part['qr'],
            error=part['xi1'],
            bound=part['bound'],
            torque_limit=np.broadcast_to(config.torque.limit, position.shape),
            learning=Series(
                (*names, *disturbances, LAMBDA_MIN, LATCHED), self.stamps, np.hstack(learned)
            ),
            truth=Series(true, self.stamps, self.truths[:, : len(true)]),
            monitor=Series(LYAPUNOV_TERMS, self.stamps, part['lyapunov']),
            rejected={one.column: f'{one}' for one in refusals(self.controller, names)},
        )


@kernel
def loop(
    plant_settings: np.ndarray,
    plant_state: np.ndarray,
    rng: np.random.Generator,
    model: ArmModel,
    settings: np.ndarray,
    reference: np.ndarray,
    state: np.ndarray,
    signals: np.ndarray,
    stamps: np.ndarray,
    measurements: np.ndarray,
    samples: np.ndarray,
    truths: np.ndarray,
    is_last: bool,
) -> None:
    """Run as many samples as there are rows; the torque of the last row of all is not applied."""
    law = settings_of(settings, model)
    law_state = state_of(state, law)
    law_signals = signals_of(signals, law)
    arm, now = plants.plant_of(plant_settings, plant_state)
    wanted, seen = borrowed(reference), borrowed(measurements)
    told, true = borrowed(samples), borrowed(truths)
    period = arm.period_ns * 1e-9
    rows = stamps.size
    for k in range(rows):
        sample = sample_of(told[k], law)
        plants.draw_next(arm, now, rng)
        plants.read(arm, now, seen[k])
        plants.reveal(arm, now, true[k])
        t = stamps[k] * 1e-9
        answer(law, wanted, law_state, law_signals, t, period, seen[k], sample)
        if not (is_last and k == rows - 1):
            plants.move(arm, now, sample.torque)


def simulate(
    controller_config: ControllerConfig,
    plant_config: PlantConfig,
    progress: Callable[[Record, int], None] | None = None,
) -> Record:
    """Run both configurations against each other for `duration` and return every sample.

    Args:
        controller_config: of the law.
        plant_config: of the arm; its duration must not be 0.
        progress: called now and then with the record and the number of rows that are filled.

    Raises:
        OutsideBarrierError: the arm starts outside the bound, and there is to be no approach.
        MotionError: there is no approach within the limits.
    """
    controller = controller_of(controller_config)
    plant = plant_of(plant_config)
    n = controller.settings.n
    measurement = plant.measure()
    begin(controller, controller_config, measurement[:n], measurement[n : 2 * n])
    record = _empty_record(controller, plant, steps_of(plant_config) + 1)
    rows = record.stamps.size
    for first in range(0, rows, _CHUNK):
        part = slice(first, min(first + _CHUNK, rows))
        loop(
            plant.settings,
            plant.state,
            plant.rng,
            controller.settings.model,
            controller.settings_vector,
            controller.reference_vector,
            controller.state_vector,
            controller.signals_vector,
            record.stamps[part],
            record.measurements[part],
            record.samples[part],
            record.truths[part],
            part.stop == rows,
        )
        if progress is not None:
            progress(record, part.stop)
    return record


def _empty_record(controller: Controller, plant: Plant, rows: int) -> Record:
    n = controller.settings.n
    return Record(
        stamps=np.arange(rows, dtype=np.int64) * plant.period_ns,
        measurements=np.zeros((rows, 3 * n)),
        samples=np.zeros((rows, controller.sample_vector.size)),
        truths=np.zeros((rows, plant.truth().size)),
        joints=n,
        estimates=controller.settings.m,
        controller=controller,
    )

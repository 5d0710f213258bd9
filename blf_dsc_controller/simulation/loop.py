# SPDX-License-Identifier: Apache-2.0
"""The closed loop without ROS: the kernels that the nodes run, in one compiled loop.

A lock-step run over ROS and an offline run of the same configuration agree bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.arms.two_link import PARAMETER_NAMES
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.compiled.layout import pack
from blf_dsc_controller.compiled.views import part, view
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.factory import begin, controller_of, estimate_names
from blf_dsc_controller.law.lyapunov import fill_energies
from blf_dsc_controller.law.rejected_columns import rejected_columns
from blf_dsc_controller.law.settings import settings_of
from blf_dsc_controller.law.state import Sample, sample_of, signals_of, state_of
from blf_dsc_controller.law.step import step
from blf_dsc_controller.messages.telemetry import disturbance_names
from blf_dsc_controller.messages.topics import LAMBDA_MIN, LATCHED, LYAPUNOV_TERMS, MODEL_CHANGES
from blf_dsc_controller.run import Run, Series
from blf_dsc_controller.simulation.metrics import (
    LoopMetrics,
    MetricsSettings,
    metrics_of,
    metrics_settings_of,
    new_metrics,
    update_metrics,
)
from sim_plant import kernels as plants
from sim_plant.plant import Plant, plant_of, steps_of

_CHUNK = 1000  # samples between two reports of progress
_NO_METRICS = MetricsSettings(0, 0, 0, 0, 0, *np.zeros((3, 0)))


@dataclass(frozen=True)
class Record:
    """All samples of a run, a row each."""

    stamps: np.ndarray  # (k,) ns, since the start
    measurements: np.ndarray  # (k, 3 n) [q, dq, applied torque of the last interval]
    samples: np.ndarray  # (k, s) rows of `law.state.Sample`
    truths: np.ndarray  # (k, p + 3 n) [P, tau_dist, q, dq]
    config: ControllerConfig
    controller: Controller  # after the run

    def sample(self, row: int) -> Sample:
        """Names for one row of `samples`."""
        return sample_of(self.samples[row], self.controller.settings)

    def run(self) -> Run:
        """All samples as a `Run`, with the truth and, where the law knows it, the terms of (29)."""
        config = self.config
        settings, names = self.controller.settings, estimate_names(config)
        columns = sample_of(np.arange(self.samples.shape[1], dtype=np.float64), settings)
        values = {
            name: self.samples[:, getattr(columns, name).astype(int)] for name in columns._fields
        }
        disturbances = disturbance_names(config.joints)
        figures = ('estimate', 'disturbance', 'lambda_min', 'latched', 'changes')
        learned = [values[name] for name in figures]
        position, velocity, _ = np.split(self.measurements, 3, axis=1)
        true = (*PARAMETER_NAMES, *disturbances)
        monitor = Series(LYAPUNOV_TERMS, self.stamps, values['lyapunov'])
        return Run(
            joints=config.joints,
            stamp=self.stamps,
            received=self.stamps,
            position=position,
            velocity=velocity,
            torque=values['torque'],
            reference=values['qr'],
            error=values['xi1'],
            bound=values['bound'],
            torque_limit=np.broadcast_to(config.torque.limit, position.shape),
            learning=Series(
                (*names, *disturbances, LAMBDA_MIN, LATCHED, MODEL_CHANGES),
                self.stamps,
                np.hstack(learned),
            ),
            truth=Series(true, self.stamps, self.truths[:, : len(true)]),
            monitor=monitor if settings.truth_known else None,
            learns=config.law == 'blf_dsc' and config.learning.weight > 0.0,
            rejected={one.column: f'{one}' for one in rejected_columns(self.controller, names)},
        )


@kernel
def run_loop(
    plant_settings: np.ndarray,
    plant_state: np.ndarray,
    rng: np.random.Generator,
    model: ArmModel,
    settings: np.ndarray,
    reference: np.ndarray,
    state: np.ndarray,
    signals: np.ndarray,
    first: int,
    last: int,
    is_end: bool,
    measurements: np.ndarray,
    samples: np.ndarray,
    truths: np.ndarray | None,
    metrics_settings: np.ndarray,
    metrics: np.ndarray,
) -> None:
    """Run the samples from number `first` to `last`; at the end, the torque is not applied.

    Without `truths`, `measurements` and `samples` have one row, which each sample overwrites, there
    are no energies, and a number that is not finite ends the run; numba compiles this apart.
    Metrics are updated if their settings have joints.
    """
    law = settings_of(settings, model)
    law_state = state_of(state, law)
    law_signals = signals_of(signals, law)
    plant, now = plants.plant_views(plant_settings, plant_state)
    reference_view, measured = view(reference), view(measurements)
    rows = view(samples)
    chosen = metrics_settings_of(view(metrics_settings))
    found = metrics_of(view(metrics), chosen)
    dt = plant.period_ns * 1e-9
    for k in range(first, last + 1):
        row = 0 if truths is None else k - first
        measurement, sample = measured[row], sample_of(rows[row], law)
        t = (k * plant.period_ns) * 1e-9
        plants.draw_noise(plant, now, rng)
        plants.observe(plant, now, measurement)
        step(law, reference_view, law_state, law_signals, t, dt, measurement, sample)
        if truths is not None:
            plants.truth(plant, now, view(truths)[row])
            fill_energies(law, law_state, law_signals, part(measurement, 0, (law.n,)), sample)
        if chosen.n > 0:
            if found.finite[0] == 1.0:
                plants.true_parameters(plant, now, found.P)
                update_metrics(chosen, found, t, measurement, sample)
            elif truths is None:
                return
        if not (is_end and k == last):
            plants.step(plant, now, sample.torque)


def simulate(
    controller_config: ControllerConfig,
    plant_config: PlantConfig,
    progress: Callable[[Record, int], None] | None = None,
    metrics: tuple[np.ndarray, np.ndarray] | None = None,
) -> Record:
    """Run both configurations against each other for `duration` and return every sample.

    The plant's duration must not be 0.  `progress` is called now and then with the record and the
    number of rows that are filled.  `metrics` are packed `MetricsSettings` and the vector of
    `new_metrics`, which is updated.

    Raises StartError if the law cannot take over and approach.enabled is false, and MotionError if
    there is no approach within the limits.
    """
    controller = controller_of(controller_config)
    plant = plant_of(plant_config)
    n = controller.settings.n
    measurement = plant.measure()
    begin(controller, controller_config, measurement[:n], measurement[n : 2 * n])
    rows = steps_of(plant_config) + 1
    record = Record(
        stamps=np.arange(rows, dtype=np.int64) * plant.period_ns,
        measurements=np.zeros((rows, 3 * n)),
        samples=np.zeros((rows, controller.sample_vector.size)),
        truths=np.zeros((rows, plant.truth().size)),
        config=controller_config,
        controller=controller,
    )
    metrics = metrics or (pack(_NO_METRICS), new_metrics(_NO_METRICS))
    for first in range(0, rows, _CHUNK):
        chunk = slice(first, min(first + _CHUNK, rows))
        arrays = (record.measurements[chunk], record.samples[chunk], record.truths[chunk])
        _run(controller, plant, (first, chunk.stop - 1, chunk.stop == rows), arrays, metrics)
        if progress is not None:
            progress(record, chunk.stop)
    return record


def run_metrics(
    controller: Controller, plant: Plant, samples: int, settings: MetricsSettings
) -> LoopMetrics:
    """Run so many samples, with a controller that has begun, and return the metrics alone."""
    metrics = new_metrics(settings)
    arrays = (np.zeros((1, 3 * plant.joints)), controller.sample_vector.reshape(1, -1), None)
    _run(controller, plant, (0, samples - 1, True), arrays, (pack(settings), metrics))
    return metrics_of(metrics, settings)


def _run(
    controller: Controller,
    plant: Plant,
    samples: tuple[int, int, bool],
    arrays: tuple[np.ndarray, np.ndarray, np.ndarray | None],
    metrics: tuple[np.ndarray, np.ndarray],
) -> None:
    run_loop(
        plant.settings,
        plant.state,
        plant.rng,
        controller.settings.model,
        controller.settings_vector,
        controller.reference_vector,
        controller.state_vector,
        controller.signals_vector,
        *samples,
        *arrays,
        *metrics,
    )

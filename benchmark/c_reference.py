# SPDX-License-Identifier: Apache-2.0
"""The C reference, compiled on demand and called through ctypes."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.law.factory import settings_of_config
from sim_plant.sensors import generator

SOURCE = Path(__file__).with_name('reference.c')
# The package's kernels are compiled for the native processor too; contraction would change the
# numbers that are compared.
FLAGS = ('-O3', '-march=native', '-ffp-contract=off')
COLUMNS = 9
"""Columns of a row: xi1 (2), torque (2), theta (5)."""

_N, _P = 2, 3


class Reference:
    """The compiled reference.

    Raises:
        FileNotFoundError: there is no C compiler named cc.
        subprocess.CalledProcessError: compilation fails.
    """

    def __init__(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder, 'reference.so')
            command = ['cc', *FLAGS, '-shared', '-fPIC', '-o', str(library), str(SOURCE), '-lm']
            subprocess.run(command, check=True)
            self._run = ctypes.CDLL(str(library)).run
        vectors = [ctypes.c_void_p] * 3
        self._run.argtypes = (ctypes.c_void_p, ctypes.c_long, ctypes.c_long, *vectors)

    def rows(self, controller: ControllerConfig, plant: PlantConfig) -> np.ndarray:
        """Return rows (samples, COLUMNS) of a noise-free run, without the sample at `duration`."""
        settings = _settings(controller, plant)
        rows = np.zeros((round(plant.duration / plant.sample_time), COLUMNS))
        self._call(settings, len(rows), 0, None, rows, None)
        return rows

    def study(
        self, controller: ControllerConfig, plants: Sequence[PlantConfig], settled_after: float
    ) -> Callable[[], np.ndarray]:
        """Return a function that runs many plants for `duration` and returns figures (plants, 4).

        These are the largest abs(xi1)/k_c and the rms of xi1 [rad] from `settled_after` [s] on, of
        both joints. The settings are laid out here; a call draws the noise with numpy and runs.
        """
        laid_out = [(_settings(controller, plant), plant) for plant in plants]

        def run_all() -> np.ndarray:
            figures = np.zeros((len(laid_out), 2 * _N))
            for (settings, plant), row in zip(laid_out, figures, strict=True):
                samples = round(plant.duration / plant.sample_time) + 1
                noise = None
                if plant.sensor.position_noise > 0.0 or plant.sensor.velocity_noise > 0.0:
                    noise = generator(plant.seed).standard_normal((samples, 2 * _N))
                settled = round(settled_after / plant.sample_time)
                self._call(settings, samples, settled, noise, None, row)
            return figures

        return run_all

    def _call(
        self, settings: ctypes.Structure, samples: int, settled: int, *vectors: np.ndarray | None
    ) -> None:
        addresses = (None if vector is None else vector.ctypes.data for vector in vectors)
        if self._run(ctypes.byref(settings), samples, settled, *addresses) != 0:
            raise MemoryError


def _settings(controller: ControllerConfig, plant: PlantConfig) -> ctypes.Structure:
    """Lay out `struct settings` of the C file: the same fields in order, integers as long."""
    law = settings_of_config(controller)
    arm, torque, reference = plant.arm, plant.disturbance, controller.reference
    values: dict[str, Any] = {
        **{name: getattr(arm, name) for name in ('l1', 'l2', 'm1', 'm2', 'gravity')},
        **{name: getattr(torque, name) for name in ('constant', 'amplitude', 'frequency', 'phase')},
        **{name: getattr(torque, name) for name in ('viscous', 'coulomb', 'coulomb_velocity')},
        'q0': plant.initial.position,
        'dq0': plant.initial.velocity,
        'position_noise': plant.sensor.position_noise,
        'velocity_noise': plant.sensor.velocity_noise,
        'offset': reference.offset,
        'swing': reference.amplitude,
        'tone': reference.frequency[0],
        **{name: getattr(law, name) for name in ('bound', 'weight', 'slope_limit', 'knee')},
        **{name: getattr(law, name) for name in ('K', 'mu', 'time_constant', 'Kp', 'gamma')},
        'limit': law.torque_limit,
        'P0': law.initial_estimate[:_P],
        **{name: getattr(law, name) for name in ('Gamma', 'kappa', 'rho', 'sigma')},
        **{name: getattr(law, name) for name in ('learning_start', 'pole', 'radius')},
        'T': plant.sample_time,
        'window': law.window,
        'interval': law.interval,
        'differenced': int(plant.sensor.velocity == 'differenced'),
        'delay': plant.actuator.delay,
    }
    fields = {
        name: ctypes.c_long if isinstance(value, int) else ctypes.c_double
        for name, value in values.items()
    }
    sizes = {name: len(value) for name, value in values.items() if np.ndim(value)}
    kinds = [(name, kind * sizes[name] if name in sizes else kind) for name, kind in fields.items()]
    settings: ctypes.Structure = type('Settings', (ctypes.Structure,), {'_fields_': kinds})(
        *(tuple(value) if np.ndim(value) else value for value in values.values())
    )
    return settings

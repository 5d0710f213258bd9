# SPDX-License-Identifier: Apache-2.0
"""The C reference, compiled on the spot and called through ctypes."""

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
# The package's kernels are compiled for this very processor too; contraction would change the
# numbers, which are compared.
FLAGS = ('-O3', '-march=native', '-ffp-contract=off')
COLUMNS = 9
"""Of a row: xi1 (2), torque (2), theta (5)."""

_N, _P, _M = 2, 3, 5
_Joint = ctypes.c_double * _N


class _Settings(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_double) for name in ('l1', 'l2', 'm1', 'm2', 'g')),
        *((name, _Joint) for name in ('constant', 'amplitude', 'frequency', 'phase')),
        *((name, _Joint) for name in ('viscous', 'coulomb')),
        ('coulomb_velocity', ctypes.c_double),
        *((name, _Joint) for name in ('q0', 'dq0')),
        *((name, ctypes.c_double) for name in ('position_noise', 'velocity_noise')),
        ('offset', _Joint),
        ('swing', _Joint),
        ('tone', ctypes.c_double),
        *((name, _Joint) for name in ('bound', 'weight', 'slope_limit', 'knee', 'K', 'mu')),
        ('lambda', ctypes.c_double),
        *((name, _Joint) for name in ('Kp', 'gamma', 'limit')),
        ('P0', ctypes.c_double * _P),
        ('Gamma', ctypes.c_double * _M),
        *((name, ctypes.c_double) for name in ('kappa', 'rho', 'sigma', 'start', 'pole')),
        ('radius', ctypes.c_double),
        ('T', ctypes.c_double),
        ('window', ctypes.c_long),
        ('interval', ctypes.c_long),
        ('differenced', ctypes.c_long),
        ('delay', ctypes.c_long),
    )


class Reference:
    """The reference, compiled.

    Raises:
        FileNotFoundError: there is no C compiler called cc.
        subprocess.CalledProcessError: it does not compile.
    """

    def __init__(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder, 'reference.so')
            command = ['cc', *FLAGS, '-shared', '-fPIC', '-o', str(library), str(SOURCE), '-lm']
            subprocess.run(command, check=True)
            self._run = ctypes.CDLL(str(library)).run
        vectors = [ctypes.c_void_p] * 3
        self._run.argtypes = (ctypes.POINTER(_Settings), ctypes.c_long, ctypes.c_long, *vectors)

    def rows(self, controller: ControllerConfig, plant: PlantConfig) -> np.ndarray:
        """Rows (samples, COLUMNS) of a run without noise; the sample at `duration` is left out."""
        settings = _settings(controller, plant)
        rows = np.zeros((round(plant.duration / plant.sample_time), COLUMNS))
        self._call(settings, len(rows), 0, None, rows, None)
        return rows

    def study(
        self, controller: ControllerConfig, plants: Sequence[PlantConfig], settled_after: float
    ) -> Callable[[], np.ndarray]:
        """Runs of `duration` of many plants, to be called; it returns their figures (plants, 4).

        These are the largest abs(xi1)/k_c and the rms of xi1 [rad] from `settled_after` [s] on, of
        both joints.  The settings are laid out here; a call draws the noise, by numpy, and runs.
        """
        laid_out = [(_settings(controller, plant), plant) for plant in plants]

        def run_all() -> np.ndarray:
            figures = np.zeros((len(laid_out), 2 * _N))
            for (settings, plant), row in zip(laid_out, figures, strict=True):
                samples = round(plant.duration / plant.sample_time) + 1
                noise = None
                if settings.position_noise > 0.0 or settings.velocity_noise > 0.0:
                    noise = generator(plant.seed).standard_normal((samples, 2 * _N))
                settled = round(settled_after / plant.sample_time)
                self._call(settings, samples, settled, noise, None, row)
            return figures

        return run_all

    def _call(
        self, settings: _Settings, samples: int, settled: int, *vectors: np.ndarray | None
    ) -> None:
        addresses = (None if vector is None else vector.ctypes.data for vector in vectors)
        if self._run(ctypes.byref(settings), samples, settled, *addresses) != 0:
            raise MemoryError


def _settings(controller: ControllerConfig, plant: PlantConfig) -> _Settings:
    law = settings_of_config(controller)
    disturbance = plant.disturbance
    values: dict[str, Any] = {
        'l1': plant.arm.l1,
        'l2': plant.arm.l2,
        'm1': plant.arm.m1,
        'm2': plant.arm.m2,
        'g': plant.arm.gravity,
        'constant': disturbance.constant,
        'amplitude': disturbance.amplitude,
        'frequency': disturbance.frequency,
        'phase': disturbance.phase,
        'viscous': disturbance.viscous,
        'coulomb': disturbance.coulomb,
        'coulomb_velocity': disturbance.coulomb_velocity,
        'q0': plant.initial.position,
        'dq0': plant.initial.velocity,
        'position_noise': plant.sensor.position_noise,
        'velocity_noise': plant.sensor.velocity_noise,
        'differenced': plant.sensor.velocity == 'differenced',
        'delay': plant.actuator.delay,
        'offset': controller.reference.offset,
        'swing': controller.reference.amplitude,
        'tone': controller.reference.frequency[0],
        'bound': law.bound,
        'weight': law.weight,
        'slope_limit': law.slope_limit,
        'knee': law.knee,
        'K': law.K,
        'mu': law.mu,
        'lambda': law.time_constant,
        'Kp': law.Kp,
        'gamma': law.gamma,
        'limit': law.torque_limit,
        'P0': law.initial_estimate[:_P],
        'Gamma': law.Gamma,
        'kappa': law.kappa,
        'rho': law.rho,
        'sigma': law.sigma,
        'start': law.learning_start,
        'pole': law.pole,
        'radius': law.radius,
        'T': plant.sample_time,
        'window': law.window,
        'interval': law.interval,
    }
    settings = _Settings()
    for name, *_ in _Settings._fields_:
        value = values[name]
        setattr(settings, name, value if np.ndim(value) == 0 else tuple(value))
    return settings

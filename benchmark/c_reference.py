# SPDX-License-Identifier: Apache-2.0
"""The C reference, compiled on the spot and called through ctypes."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.assembly import settings_of_config
from blf_dsc_controller.configuration.controller import ControllerConfig
from sim_plant.configuration import PlantConfig

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
        *((name, _Joint) for name in ('constant', 'amplitude', 'frequency', 'phase', 'q0')),
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
    )


def compiled() -> Callable[[ControllerConfig, PlantConfig], np.ndarray]:
    """Compile the reference and return it as a function of both configurations.

    The function runs `duration` and returns the rows (samples, COLUMNS).

    Raises:
        FileNotFoundError: there is no C compiler called cc.
        subprocess.CalledProcessError: it does not compile.
    """
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder, 'reference.so')
        command = ['cc', *FLAGS, '-shared', '-fPIC', '-o', str(library), str(SOURCE), '-lm']
        subprocess.run(command, check=True)
        run = ctypes.CDLL(str(library)).run
    run.argtypes = (ctypes.POINTER(_Settings), ctypes.c_long, ctypes.c_void_p)

    def call(controller: ControllerConfig, plant: PlantConfig) -> np.ndarray:
        settings = _settings(controller, plant)
        rows = np.zeros((round(plant.duration / plant.sample_time), COLUMNS))
        if run(ctypes.byref(settings), len(rows), rows.ctypes.data) != 0:
            raise MemoryError
        return rows

    return call


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
        'q0': plant.initial.position,
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

# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc precompile`: compile the kernels of a configuration before its nodes need them."""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.params_file import load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.supervision.guard import Guard
from sim_plant.plant import plant_of


def precompile(options: argparse.Namespace) -> None:
    """Compile the kernels of a configuration's controller and plant, in two parallel processes."""
    config = load_loop(options.config)
    with ProcessPoolExecutor(2, get_context('spawn')) as pool:
        jobs = [
            pool.submit(_compile_law, config.controller),
            pool.submit(_compile_plant, config.plant),
        ]
        for job in jobs:
            job.result()
    print(f'{options.config}: the kernels are compiled; the nodes of this user now start at once')


def _compile_law(config: ControllerConfig) -> None:
    Guard(config)


def _compile_plant(config: PlantConfig) -> None:
    plant_of(config).compile()

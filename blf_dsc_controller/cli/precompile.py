# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc precompile`: the machine code of a configuration's kernels, before its nodes need it."""

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
    """Compile what the controller and the simulated plant of a configuration call.

    Both compile at the same time, each in its process.
    """
    config = load_loop(options.config)
    with ProcessPoolExecutor(2, get_context('spawn')) as pool:
        jobs = [
            pool.submit(_compile_law, config.controller),
            pool.submit(_compile_plant, config.plant),
        ]
        for job in jobs:
            job.result()
    print(f'{options.config}: the kernels are compiled, and nodes of this user start at once')


def _compile_law(config: ControllerConfig) -> None:
    Guard(config)


def _compile_plant(config: PlantConfig) -> None:
    plant_of(config).compile()

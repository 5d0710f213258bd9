# SPDX-License-Identifier: Apache-2.0
"""Output-constrained tracking of robot arms with unknown dynamics.

The names below are the public interface. Each is imported on first use, so that a node
does not load modules that only an analysis needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from blf_dsc_controller.analysis.figures import draw as draw
    from blf_dsc_controller.analysis.metrics import measure as measure
    from blf_dsc_controller.bags.reader import read_run as read_run
    from blf_dsc_controller.commissioning.own_loop import Commissioning as Commissioning
    from blf_dsc_controller.configuration.controller import (
        ControllerConfig as ControllerConfig,
    )
    from blf_dsc_controller.configuration.files import share_folder as share_folder
    from blf_dsc_controller.configuration.nodes import load_loop as load_loop
    from blf_dsc_controller.configuration.plant import PlantConfig as PlantConfig
    from blf_dsc_controller.configuration.schema import change as change
    from blf_dsc_controller.control.arm_controller import ArmController as ArmController
    from blf_dsc_controller.drive.drive import Drive as Drive
    from blf_dsc_controller.factory.controller import controller_of as controller_of
    from blf_dsc_controller.reference.trajectory import (
        TrajectoryPoint as TrajectoryPoint,
    )
    from blf_dsc_controller.replay.verify import verify as verify
    from blf_dsc_controller.run import Run as Run
    from blf_dsc_controller.simulation.loop import simulate as simulate
    from blf_dsc_controller.studies.monte_carlo import load_study as load_study
    from blf_dsc_controller.studies.runs import run_chunk as run_chunk

__version__ = '0.1.0'

_PUBLIC = {
    'ArmController': 'control.arm_controller',
    'Commissioning': 'commissioning.own_loop',
    'ControllerConfig': 'configuration.controller',
    'PlantConfig': 'configuration.plant',
    'Run': 'run',
    'change': 'configuration.schema',
    'controller_of': 'factory.controller',
    'Drive': 'drive.drive',
    'draw': 'analysis.figures',
    'load_loop': 'configuration.nodes',
    'load_study': 'studies.monte_carlo',
    'measure': 'analysis.metrics',
    'read_run': 'bags.reader',
    'run_chunk': 'studies.runs',
    'share_folder': 'configuration.files',
    'simulate': 'simulation.loop',
    'TrajectoryPoint': 'reference.trajectory',
    'verify': 'replay.verify',
}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_PUBLIC[name]}'), name)

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
    from blf_dsc_controller.analysis.recorded import read_run as read_run
    from blf_dsc_controller.bags.sources import BagError as BagError
    from blf_dsc_controller.commissioning.commissioning import (
        Commissioning as Commissioning,
    )
    from blf_dsc_controller.configuration.controller import (
        ControllerConfig as ControllerConfig,
    )
    from blf_dsc_controller.configuration.files import share_folder as share_folder
    from blf_dsc_controller.configuration.nodes import load_loop as load_loop
    from blf_dsc_controller.configuration.plant import PlantConfig as PlantConfig
    from blf_dsc_controller.configuration.schema import change as change
    from blf_dsc_controller.control.arm_controller import ArmController as ArmController
    from blf_dsc_controller.control.arm_controller import StateError as StateError
    from blf_dsc_controller.drive.drive import Drive as Drive
    from blf_dsc_controller.errors import ArgumentTypeError as ArgumentTypeError
    from blf_dsc_controller.errors import BlfDscError as BlfDscError
    from blf_dsc_controller.errors import ConfigurationError as ConfigurationError
    from blf_dsc_controller.errors import DriveError as DriveError
    from blf_dsc_controller.errors import LoopEndedError as LoopEndedError
    from blf_dsc_controller.errors import MissingExtraError as MissingExtraError
    from blf_dsc_controller.errors import MotionFailedError as MotionFailedError
    from blf_dsc_controller.errors import NotInTimeError as NotInTimeError
    from blf_dsc_controller.errors import StartError as StartError
    from blf_dsc_controller.errors import TareError as TareError
    from blf_dsc_controller.factory.controller import controller_of as controller_of
    from blf_dsc_controller.reference.approach import MotionError as MotionError
    from blf_dsc_controller.reference.retargeting import (
        TrajectoryError as TrajectoryError,
    )
    from blf_dsc_controller.reference.trajectory import (
        TrajectoryPoint as TrajectoryPoint,
    )
    from blf_dsc_controller.replay.verify import verify as verify
    from blf_dsc_controller.run import Run as Run
    from blf_dsc_controller.simulation.loop import simulate as simulate
    from blf_dsc_controller.studies.monte_carlo import load_study as load_study
    from blf_dsc_controller.studies.runs import run_chunk as run_chunk
    from blf_dsc_controller.supervision.supervisor import Phase as Phase

__version__ = '0.1.0'

_PUBLIC = {
    'ArgumentTypeError': 'errors',
    'ArmController': 'control.arm_controller',
    'BagError': 'bags.sources',
    'BlfDscError': 'errors',
    'change': 'configuration.schema',
    'Commissioning': 'commissioning.commissioning',
    'ConfigurationError': 'errors',
    'controller_of': 'factory.controller',
    'ControllerConfig': 'configuration.controller',
    'draw': 'analysis.figures',
    'Drive': 'drive.drive',
    'DriveError': 'errors',
    'load_loop': 'configuration.nodes',
    'load_study': 'studies.monte_carlo',
    'LoopEndedError': 'errors',
    'measure': 'analysis.metrics',
    'MissingExtraError': 'errors',
    'MotionError': 'reference.approach',
    'MotionFailedError': 'errors',
    'NotInTimeError': 'errors',
    'Phase': 'supervision.supervisor',
    'PlantConfig': 'configuration.plant',
    'read_run': 'analysis.recorded',
    'Run': 'run',
    'run_chunk': 'studies.runs',
    'share_folder': 'configuration.files',
    'simulate': 'simulation.loop',
    'StartError': 'errors',
    'StateError': 'control.arm_controller',
    'TareError': 'errors',
    'TrajectoryError': 'reference.retargeting',
    'TrajectoryPoint': 'reference.trajectory',
    'verify': 'replay.verify',
}
__all__ = list(_PUBLIC)


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_PUBLIC[name]}'), name)

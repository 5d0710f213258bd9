# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc export-c`: the law of a configuration in a folder, to be called from C."""

from __future__ import annotations

from argparse import Namespace

from blf_dsc_controller.c_export.folder import export
from blf_dsc_controller.cli.result_folder import refuse_existing
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.drive import DriveConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, DRIVE, dump, load, locate
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.writing import writing


def export_c(options: Namespace) -> None:
    """Write the folder."""
    refuse_existing(options.out)  # before what takes seconds
    path = locate(options.config)
    if load(path, DRIVE, DriveConfig).feedback == 'motor':
        raise BlfDscError(
            'drive.feedback is motor: only blf_dsc drive splits torques between host and motors'
        )
    with announced_compilation(print_notice):
        config = load(path, CONTROLLER, ControllerConfig)
        with writing(options.out) as folder:
            folder.mkdir(parents=True)
            export(config, folder)
            dump(folder / 'config.yaml', {CONTROLLER: config})
    print(
        f'wrote {options.out}: the law without its safe stop and envelope, which the caller needs '
        'to have; README.md says more'
    )

# SPDX-License-Identifier: Apache-2.0
"""One run of a study again, with its bag, and bit for bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, dump
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.simulation.loop import simulate, write_bag
from blf_dsc_controller.studies.monte_carlo import (
    NOISE,
    WITHOUT,
    draw,
    plant_with,
)
from blf_dsc_controller.studies.runs import Store, differences, figures_of

_FOLDERS = {'': '', WITHOUT: 'without_learning', NOISE: 'other_noise'}


def reproduce(store: Store, run: str, out: Path) -> None:
    """Repeat the run of this number: write its config.yaml and bag to `out`.

    Those without learning, of a study of pairs, go to `without_learning` and `other_noise` in it.

    Raises BlfDscError if the run has no results, or if they are not reproduced bit for
    bit; StartError if the controller rejects its start.
    """
    study, results = store.study, store.results()
    rows = np.flatnonzero(results['run'].astype(str) == run)
    if not rows.size:
        raise BlfDscError(
            f'{store.folder} has no run {run}: it has {results["run"].size} runs'
        )
    for prefix, law in study.laws().items():
        plant = plant_with(study, draw(study, int(run)), prefix)
        folder = out / _FOLDERS[prefix]
        folder.mkdir(exist_ok=True)
        dump(folder / 'config.yaml', {PLANT: plant, CONTROLLER: law})
        record = simulate(law, plant, supervised=False)
        write_bag(folder / 'bag', record)
        here = figures_of(study, record, plant)
        different = differences(
            {name: results[f'{prefix}{name}'][rows[0]] for name in here}, here
        )
        if different:
            raise BlfDscError(
                f'run {run} differs from the stored one: was it computed on another kind of '
                f'machine, or by another version?{different}'
            )

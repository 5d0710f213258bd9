# SPDX-License-Identifier: Apache-2.0
"""Many runs, on all the cores there are."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from blf_dsc_controller.configuration.nodes import LoopConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.paper.cases import Case
from blf_dsc_controller.paper.metrics import Courses, Metrics, measure
from blf_dsc_controller.simulation.loop import simulate


@dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        metrics: its numbers; None if it could not be run.
        courses: over time, where they were asked for.
        failure: why it could not be run; empty if it was.
    """

    metrics: Metrics | None
    courses: Courses | None = None
    failure: str = ''


def run(loop: LoopConfig, keep: bool) -> Outcome:  # noqa: FBT001
    """Run a configuration offline; `keep` also returns the courses."""
    try:
        record = simulate(loop.controller, loop.plant)
    except BlfDscError as error:
        return Outcome(None, failure=str(error))
    courses = Courses.of(record)
    with np.errstate(all='ignore'):  # a run that has diverged is a result too
        metrics = measure(courses, np.array(loop.controller.barrier.bound))
    return Outcome(metrics, courses if keep else None)


def run_all(kept: Sequence[Case], others: Sequence[Case]) -> Mapping[str, Outcome]:
    """Outcomes by the names of the cases, with the courses of those that are `kept`.

    The first run is this process's own: it compiles the kernels, which the workers then load.
    """
    first, *rest = [(case, True) for case in kept] + [(case, False) for case in others]
    with tqdm(total=1 + len(rest), desc='runs', unit='run') as bar:
        outcomes = {first[0].name: run(first[0].loop(), keep=True)}
        bar.update()
        with ProcessPoolExecutor(os.cpu_count()) as pool:
            pending = {pool.submit(run, case.loop(), keep): case.name for case, keep in rest}
            for future in as_completed(pending):
                outcomes[pending[future]] = future.result()
                bar.update()
    return outcomes

# SPDX-License-Identifier: Apache-2.0
"""Simulation of the cases on all cores, and the metrics of their runs."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from blf_dsc_controller.analysis.metrics import Metrics, measure
from blf_dsc_controller.paper.cases import CASES, SWEEPS, Case, case_name
from blf_dsc_controller.run import Run
from blf_dsc_controller.simulation.loop import simulate_law


class Results(NamedTuple):
    """Results by name of the case; the runs of sweeps are not kept."""

    metrics: dict[str, Metrics]
    runs: dict[str, Run]

    def held(self, sweep: str, law: str) -> list[float]:
        """Return the values of a sweep at which the law keeps its bound."""
        (values,) = (one.values for one in SWEEPS if one.name == sweep)
        return [value for value in values if self.metrics[case_name(sweep, law, value)].held]


def run_case(case: Case) -> tuple[Metrics, Run | None]:
    """Simulate a case; return its metrics and, if the case keeps it, the run."""
    loop = case.loop()
    with np.errstate(all='ignore'):  # a run that diverges has metrics too
        run = simulate_law(loop.controller, loop.plant).run()
        return measure(run), run if case.keep_run else None


def run_all() -> Results:
    """Simulate every case on all cores.

    The first one runs in this process: it compiles the kernels, which the workers then load.
    """
    results = Results({}, {})
    with ProcessPoolExecutor() as pool, tqdm(total=len(CASES), desc='runs', unit='run') as bar:
        for case, (metrics, run) in zip(CASES, _computed(pool), strict=True):
            results.metrics[case.name] = metrics
            if run is not None:
                results.runs[case.name] = run
            bar.update()
    return results


def _computed(pool: ProcessPoolExecutor) -> Iterator[tuple[Metrics, Run | None]]:
    yield run_case(CASES[0])
    yield from pool.map(run_case, CASES[1:])

# SPDX-License-Identifier: Apache-2.0
"""A Monte Carlo study: throughput of a core against C, and of two processes against one.

Both sides run the same drawn plants, with friction, noise and delay, and keep the largest and the
rms error of each run. The package also draws the plants and keeps the other figures of a study;
the reference gets its settings already laid out. Neither writes anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import ExitStack, nullcontext
from dataclasses import replace

import numpy as np
from c_reference import Reference
from harness import Ratio, interleaved, ratio

from blf_dsc_controller.configuration.nodes import locate
from blf_dsc_controller.law.factory import controller_of
from blf_dsc_controller.studies import runs
from blf_dsc_controller.studies.monte_carlo import (
    Study,
    draw,
    load_study,
    origin_of,
    plant_of_draw,
)
from blf_dsc_controller.studies.runs import Span, run_chunk, warm_up

_DURATION = 10.0  # s
_RUNS = 50  # per round against C
_CHUNKS = 100  # per round of the engine
_CHUNK = 4  # runs; few, so that the first to finish waits for at most one chunk
_ROUNDS = 9
_C = 'C -O3, in a loop'
_PACKAGE = 'run_chunk'
_ERRORS = ('max_error_ratio', 'rms_error_rad')


def measure() -> Iterator[Ratio]:
    """Measure runs per second relative to C, and to one process."""
    study = preset()
    warm_up(study)
    yield from _beside_c(study)
    yield from _processes(study)


def preset() -> Study:
    """Return the preset with this benchmark's duration, settled in its last fifth."""
    study = load_study(locate('monte_carlo'))
    plant = replace(study.plant, duration=_DURATION)
    settings = replace(study.settings, settled_after=0.8 * _DURATION, moments=())
    learning = replace(study.controller.learning, change_detection=False)  # the reference has none
    controller = replace(study.controller, learning=learning)
    return replace(study, controller=controller, plant=plant, settings=settings)


def disagreement(study: Study) -> float:
    """Return the largest relative difference in largest and rms errors between package and C."""
    theirs = _reference(study)()
    columns = run_chunk(study, 0, _RUNS)
    names = [f'{of}.{joint}' for of in _ERRORS for joint in study.plant.joints]
    mine = np.transpose([columns[name] for name in names])
    return float(np.abs(mine / theirs - 1.0).max())


def _reference(study: Study) -> Callable[[], np.ndarray]:
    origin = origin_of(controller_of(study.controller))
    plants = [plant_of_draw(study, draw(study, run), origin) for run in range(_RUNS)]
    return Reference().study(study.controller, plants, study.settings.settled_after)


def _beside_c(study: Study) -> Iterator[Ratio]:
    reference = _reference(study)
    contestants = {
        _PACKAGE: lambda: run_chunk(study, 0, _RUNS)['run'].size,
        _C: lambda: len(reference()),
    }
    rates = {name: 1.0 / times for name, times in interleaved(contestants, _ROUNDS).items()}
    note = (
        f'{np.median(rates[_PACKAGE]):.0f} runs of {_DURATION:g} s a second here; '
        f'errors differ by at most {disagreement(study):.0e} of themselves'
    )
    what = f'{_PACKAGE}: runs a second, of a core'
    yield ratio('monte carlo', what, _C, rates[_PACKAGE], rates[_C], note)


def _processes(study: Study) -> Iterator[Ratio]:
    with ExitStack() as stack:
        pools = [_pool(study, stack, workers) for workers in (1, 2)]
        one, two = interleaved(dict(zip(('one', 'two'), pools, strict=True)), _ROUNDS).values()
    note = f'{np.median(1.0 / two):.0f} runs a second here; the pools were started before'
    what = 'two processes: runs a second'
    yield ratio('monte carlo', what, 'one process', 1.0 / two, 1.0 / one, note)


def _pool(study: Study, stack: ExitStack, workers: int) -> Callable[[], int]:
    """Return the engine's work on this many workers, which stay alive between rounds."""
    engine = runs.processes(workers)
    executor: Executor = stack.enter_context(engine.open())
    engine = engine._replace(open=lambda: nullcontext(executor))
    spans = [Span(k * _CHUNK, _CHUNK) for k in range(_CHUNKS)]

    def work() -> int:
        done: list[Span] = []
        runs.compute(study, spans, engine, lambda span, _: done.append(span), print)
        return sum(span.runs for span in done)

    return work

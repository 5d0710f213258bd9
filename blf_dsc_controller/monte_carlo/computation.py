# SPDX-License-Identifier: Apache-2.0
"""All that is missing of a study, computed by the workers of an engine.

The chunks are handed out one after the other, a few ahead of the workers, and kept as they come;
the memory that is needed does not grow with the number of runs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait

from blf_dsc_controller.monte_carlo.chunk import Columns, run_chunk
from blf_dsc_controller.monte_carlo.errors import WorkersLostError
from blf_dsc_controller.monte_carlo.executors import Engine
from blf_dsc_controller.monte_carlo.store import Span
from blf_dsc_controller.monte_carlo.study import Study

AHEAD = 3
"""Chunks handed out for each worker."""

PATIENCE = 3
"""Times in a row that all workers may be lost with nothing done in between."""

_CHUNKS_EACH = 20
_MOST_PARTS = 1000
_LARGEST = (100, 1000)  # runs in a chunk: in a study of up to 100 000, and in any


def chunk_size(runs: int, workers: int) -> int:
    """Runs in a chunk: few files, yet enough chunks for the workers to end together."""
    usual, ever = _LARGEST
    largest = min(ever, max(usual, runs // _MOST_PARTS))
    return max(1, min(largest, runs // (_CHUNKS_EACH * workers)))


def compute(
    study: Study,
    spans: Iterable[Span],
    engine: Engine,
    keep: Callable[[Span, Columns], None],
    tell: Callable[[str], None],
) -> None:
    """Compute all `spans`; a lost worker costs the time of its chunk and nothing else.

    Args:
        study: whose runs they are.
        spans: what is to be computed.
        engine: that has the workers.
        keep: called with each span and its results, in the order that they are done.
        tell: called with a sentence when workers were lost.

    Raises:
        WorkersLostError: they were lost again and again.
    """
    waiting = deque(spans)
    in_a_row = 0
    while waiting:
        before = len(waiting)
        try:
            with engine.open() as executor:
                _hand_out(study, waiting, executor, engine.workers * AHEAD, keep)
        except engine.lost as error:
            in_a_row = in_a_row + 1 if len(waiting) == before else 1
            if in_a_row > PATIENCE:
                raise WorkersLostError(in_a_row, len(waiting), str(error)) from error
            tell(f'a worker was lost: {len(waiting)} chunks are left, and go to new workers')


def _hand_out(
    study: Study,
    waiting: deque[Span],
    executor: Executor,
    most: int,
    keep: Callable[[Span, Columns], None],
) -> None:
    """Empty `waiting`; what is not kept is there again if anything goes wrong."""
    handed: dict[Future[Columns], Span] = {}
    try:
        while waiting or handed:
            while waiting and len(handed) < most:
                span = waiting[0]
                handed[executor.submit(run_chunk, study, *span)] = span
                waiting.popleft()
            for future in wait(handed, return_when=FIRST_COMPLETED).done:
                keep(handed[future], future.result())
                del handed[future]
    finally:
        for future in handed:
            future.cancel()
        waiting.extendleft(sorted(handed.values(), reverse=True))

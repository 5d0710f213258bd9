# SPDX-License-Identifier: Apache-2.0
"""`monte_carlo`: thousands of closed loops with random plants, and what they say."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

from blf_dsc_controller.analysis.table import format_table
from blf_dsc_controller.cli.run import make_folder
from blf_dsc_controller.compiled import COMPILATION_NOTICE
from blf_dsc_controller.compiled.jit import is_compiled
from blf_dsc_controller.configuration.params_file import locate
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.monte_carlo import executors as engines
from blf_dsc_controller.monte_carlo.chunk import Columns, warm_up
from blf_dsc_controller.monte_carlo.computation import chunk_size, compute
from blf_dsc_controller.monte_carlo.executors import Engine
from blf_dsc_controller.monte_carlo.measure import KEPT
from blf_dsc_controller.monte_carlo.page import command, headline
from blf_dsc_controller.monte_carlo.report import write_report
from blf_dsc_controller.monte_carlo.reproduction import reproduce
from blf_dsc_controller.monte_carlo.store import Span, Store
from blf_dsc_controller.monte_carlo.study_file import load_study
from blf_dsc_controller.monte_carlo.table import require_pyarrow
from blf_dsc_controller.simulation.figures_loop import run

_PAUSE_IN_A_LOG = 10.0  # s between two states of the bar


def monte_carlo(options: argparse.Namespace) -> int:
    """Run the command."""
    if options.reproduce:
        return reproduce_run(Path(options.reproduce[0]), options.reproduce[1], options.out)
    if options.report:
        return _report(Store(options.report))
    return run_study(options)


def run_study(options: argparse.Namespace) -> int:
    """Compute what is missing of a study, and report it."""
    told = {name: getattr(options, name) for name in ('runs', 'seed')}
    study = load_study(
        locate(options.config), {name: value for name, value in told.items() if value is not None}
    )
    require_pyarrow()
    engine = _engine(options)
    store = Store.create_or_open(options.out or Path('monte_carlo'), study)
    with store.locked():
        size = options.chunk or chunk_size(study.settings.runs, engine.workers)
        spans = store.missing(size)
        if spans:
            _announce()
            warm_up(study)
            _compute(store, spans, engine)
        return _report(store)


def _compute(store: Store, spans: list[Span], engine: Engine) -> None:
    runs = store.study.settings.runs
    done = runs - sum(span.runs for span in spans)
    if done:
        print(f'{done} of {runs} runs are done already', file=sys.stderr)
    lost = 0
    pause = 0.5 if sys.stderr.isatty() else _PAUSE_IN_A_LOG
    with tqdm(total=runs, initial=done, unit='run', desc='monte carlo', mininterval=pause) as bar:

        def keep(span: Span, columns: Columns) -> None:
            nonlocal lost
            store.keep(span, columns)
            lost += int(np.count_nonzero(columns['outcome'] != KEPT))
            bar.set_postfix_str(f'{lost} did not keep the bound', refresh=False)
            bar.update(span.runs)

        compute(store.study, spans, engine, keep, bar.write)


def _report(store: Store) -> int:
    summary, written = write_report(store)
    print(headline(summary))
    print(f'the worst   {command(store.folder, summary["worst"][0]["run"])}')
    print(f'wrote       {store.folder}: {", ".join(path.name for path in written)}')
    return 0


def reproduce_run(folder: Path, index: str, out: Path | None) -> int:
    """Run one of a study once more."""
    store = Store(folder)
    if not index.isdecimal():
        raise BlfDscError(f'--reproduce: got run {index!r}, but its number is expected')
    chosen = make_folder(out or Path(f'{folder.name}-run-{index}'))
    summary = reproduce(store, int(index), chosen)
    print(format_table(summary))
    print(f'the same figures as in {folder}, bit for bit')
    print(f'wrote       {chosen}: config.yaml, bag, summary.json and pictures')
    return 0


def _engine(options: argparse.Namespace) -> Engine:
    workers = options.workers or engines.cores()
    if options.engine == 'dask':
        return engines.dask(workers, options.address)
    by_name = {'processes': engines.processes, 'threads': engines.threads, 'mpi': engines.mpi}
    return by_name[options.engine](workers)


def _announce() -> None:
    if not is_compiled(run):
        print(COMPILATION_NOTICE, file=sys.stderr, flush=True)

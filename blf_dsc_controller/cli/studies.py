# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc arms`: laws side by side; `blf_dsc monte-carlo`: random plants."""

from __future__ import annotations

import sys
import time
from argparse import Namespace
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
from tqdm import tqdm

from blf_dsc_controller.analysis.output import write_json
from blf_dsc_controller.cli.result_folder import make_folder
from blf_dsc_controller.cli.run import notes_on_ideal_arm
from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.studies import laws, report, runs
from blf_dsc_controller.studies.monte_carlo import load_study
from blf_dsc_controller.studies.reproduction import reproduce
from blf_dsc_controller.studies.summary import summarize

_PAUSE_IN_A_LOG = 10.0  # s between two lines


def arms(options: Namespace) -> None:
    """Tune and run every law on URDF arms, write figures.json and print the table."""
    laws.chosen_laws(options.laws)  # before there is a folder
    for config in options.config:
        loop = laws.trial(config, 0)
        for note in notes_on_ideal_arm(loop):
            print_notice(f'note: {config}: {note}')
    folder = make_folder(options.out)
    with announced_compilation(print_notice):
        found = laws.compare(folder, options.config, options.laws)
    for arm, results in found.items():
        load = laws.load_of(laws.trial(arm, 0))
        print(
            f'{arm}: {laws.TRUTHS} runs of each law, {load:g} kg picked up at {laws.PICK_UP:g} s; '
            'errors in mrad, of the model in %'
        )
        print(laws.format_results(results))
    print(f'wrote {options.out}: figures.json')


def monte_carlo(options: Namespace) -> None:
    """Compute and report a study, compare studies, or repeat one run."""
    if options.reproduce:
        folder, run = options.reproduce
        store = runs.Store(Path(folder))
        chosen = make_folder(options.out or Path(f'{store.folder.name}-run-{run}'))
        reproduce(store, run, chosen)
        print(f'the same figures as in {folder}, bit for bit')
        print(f'wrote       {chosen}: config.yaml and bag, which blf_dsc report draws')
    elif options.report:
        folder = options.out or Path('changes')
        folder.mkdir(parents=True, exist_ok=True)
        stores = [runs.Store(each, runs_law=False) for each in options.report]
        print(report.write_comparison(stores, folder), end='')
    else:
        _run_study(options)


def _run_study(options: Namespace) -> None:
    given = {} if options.runs is None else {'runs': options.runs}
    study = load_study(options.config, given)
    runs.require_pyarrow()
    store = runs.Store.create_or_open(options.out or Path('monte_carlo'), study)
    if chunks := store.missing():
        with announced_compilation(print_notice):
            runs.warm_up(study)
        workers = options.workers or runs.cores()
        with (
            runs.dask(options.dask)
            if options.dask
            else runs.processes(workers) as executor
        ):
            _compute(store, chunks, executor)
    summary = summarize(study, store.results())
    write_json(summary, store.folder / 'summary.json')
    print(report.format_report(summary, store.folder))
    print(f'wrote       {store.folder}: summary.json')


def _compute(store: runs.Store, chunks: list[range], executor: Executor) -> None:
    total = store.study.settings.runs
    done = total - sum(map(len, chunks))
    if done:
        print(f'{done} of {total} runs are done already', file=sys.stderr)
    lost = 0
    print_notice(f'simulating {total - done} runs: the slower, the more joints')
    told = time.monotonic()
    with tqdm(total=total, initial=done, unit='run', disable=None) as bar:
        for chunk, columns in runs.compute(store.study, chunks, executor):
            store.keep(chunk, columns)
            lost += int(np.count_nonzero(columns['outcome'] != runs.KEPT))
            bar.set_postfix_str(f'{lost} did not keep the bound', refresh=False)
            bar.update(len(chunk))
            done += len(chunk)
            if bar.disable and time.monotonic() - told > _PAUSE_IN_A_LOG:
                told = time.monotonic()
                print_notice(f'{done} of {total} runs, {lost} did not keep the bound')

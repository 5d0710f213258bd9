# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc report`, `export`, `recover`, `replay`: what is made from bags."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from blf_dsc_controller.analysis.recorded import recorded_run
from blf_dsc_controller.bags import recovery, table
from blf_dsc_controller.bags.content import Content, NameMap, read_content
from blf_dsc_controller.cli.main import make_room
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.progress import announce_reading
from blf_dsc_controller.run import Run

if TYPE_CHECKING:
    from blf_dsc_controller.replay.verify import Verification

DIFFERENT = 3
"""Exit code if the replay differs from the bag."""

PARTIAL = 4
"""Exit code if all compared outputs are equal, but others could not be compared."""

_PAGES = {'', '.html', '.htm'}


def report(options: Namespace) -> None:
    """Write the HTML page of one or several bags, or the pictures of one."""
    if options.png:
        _draw(options)
        return
    from blf_dsc_controller.analysis.report import read_bag, write_report
    from blf_dsc_controller.cli.softer_gains import print_softer_gains_of

    if options.out.suffix not in _PAGES:
        raise BlfDscError(f'{options.out}: the report is a page: give a name in .html')
    make_room(options.out, force=options.force)
    names = NameMap.parse(options.map)
    announce_reading(options.bags, 'drawn')
    bags = [read_bag(path, options.namespace, names) for path in options.bags]
    write_report(bags, options.out)
    for bag in bags:
        print_softer_gains_of(bag.run, bag.content)
    print(f'wrote {options.out} ({options.out.stat().st_size / 1e6:.1f} MB)')


def _draw(options: Namespace) -> None:
    """Draw the pictures of a bag and summarise it."""
    from blf_dsc_controller.analysis import figures
    from blf_dsc_controller.analysis.metrics import measure
    from blf_dsc_controller.analysis.metrics_table import format_table
    from blf_dsc_controller.analysis.output import write_json
    from blf_dsc_controller.cli.softer_gains import print_softer_gains_of

    if len(options.bags) > 1:
        raise BlfDscError('--png draws one bag: give one, or leave out --png')
    folder = options.png
    paths = [folder / name for name in ('summary.json', *figures.NAMES)]
    make_room(*paths, force=options.force, try_out=False)
    announce_reading(options.bags, 'drawn')
    run, content = _run(options, options.bags[0])
    metrics = measure(run)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(metrics, paths[0])
    written = [paths[0], *figures.draw(run, folder, metrics)]
    print(format_table(metrics))
    print_softer_gains_of(run, content)
    print('wrote', ', '.join(str(path) for path in written))


def _run(options: Namespace, bag: Path) -> tuple[Run, Content]:
    """Read a bag and the run in it, and print what is left out."""
    content = read_content(bag, options.namespace, NameMap.parse(options.map))
    run = recorded_run(content)
    for note in run.notes:
        print(f'note: {note}')
    return run, content


def export(options: Namespace) -> None:
    """Write a bag as a table."""
    table.check_format(options.out)  # before a large bag is read
    make_room(options.out, force=options.force)
    announce_reading([options.bag], 'written as a table')
    run, _ = _run(options, options.bag)
    columns = table.export(run, options.out)
    print(f'wrote {options.out}: {run.stamp.size} rows of {columns} columns')


def recover(options: Namespace) -> int:
    """Make a clean bag from a damaged one and list the losses.

    Return 1 if nothing is left.
    """
    bag = options.bag.resolve()
    out = options.out or bag.with_name(f'{bag.stem}_recovered')
    announce_reading([options.bag], 'read and written again')
    messages, losses = recovery.recover(options.bag, out)
    for topic, count in messages.items():
        print(f'{topic}: {count} messages')
    for loss in losses:
        print(f'LOST {loss}')
    all_lost = bool(losses) and not any(messages.values())
    if all_lost:
        print('ALL LOST: no message could be recovered')
    elif not losses:
        print('none of the recorded messages was lost')
    print(f'wrote {out}')
    return int(all_lost)


def replay(options: Namespace) -> int:
    """Replay a bag and print what is equal."""
    from blf_dsc_controller.replay.verify import verify

    announce_reading([options.bag], 'run through the controller again')
    begin = time.perf_counter()
    names = NameMap.parse(options.map)
    result = verify(options.bag, options.namespace, names, options.law)
    seconds = result.duration
    took = time.perf_counter() - begin
    speed = f'{seconds:.3f} s in {took:.2f} s: {speed_text(seconds / took)}'
    print(f'{result.samples} samples, {speed}')
    print('\n'.join(_verification(result)))
    if result.difference is not None:
        return DIFFERENT
    return PARTIAL if result.is_partial else 0


def speed_text(times: float) -> str:
    """Return how many times as fast as real time, with two digits below 10."""
    return f'{times:.0f}x real time' if times >= 9.5 else f'{times:.2g}x real time'


def _verification(result: Verification) -> Iterator[str]:
    for found in result.comparisons:
        verdict = 'bit-equal'
        if found.difference is not None:
            verdict = f'DIFFERENT by at most {found.largest:.3g}'
        left_out = f' (not compared: {found.left_out})' if found.left_out else ''
        yield f'{found.topic}: {found.values} values {verdict}{left_out}'
    for topic in result.not_compared:
        yield f'{topic}: not compared, as it holds text'
    yield from _events(result)
    if result.difference is not None:
        yield f'DIFFERENT, first at {result.difference}'
    elif result.compared < 1.0:
        percent = min(round(100.0 * result.compared, 2), 99.99)
        yield (
            f'PARTLY COMPARED: {percent:g} % of the numbers in the bag, which are bit-equal; the '
            'others could not be compared'
        )
    elif result.is_partial:
        yield 'INCOMPLETE: what the bag holds of the controller is bit-equal, the rest is missing'
    else:
        yield 'bit-equal: all numbers of the controller in the bag'


def _events(result: Verification) -> Iterator[str]:
    """Yield what happened in the run, and what limits the result."""
    if len(result.transitions) > 1:
        yield f'replayed in order: {", ".join(result.transitions)}'
    if result.skipped:
        yield f'{result.skipped} states skipped: the controller did not use them'
    for remark in result.remarks:
        yield f'note: {remark}'
    for lacking in result.incomplete:
        yield f'MISSING in the bag: {lacking}'

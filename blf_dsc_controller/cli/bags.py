# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc report`, `recover`, `export` and `plot`: outputs made from bags."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator

from blf_dsc_controller.analysis import figures, summary
from blf_dsc_controller.analysis.report import write_report
from blf_dsc_controller.analysis.reported_bag import read_bags
from blf_dsc_controller.bags import recover as recovering
from blf_dsc_controller.bags.content import NameMap, read_content
from blf_dsc_controller.bags.reader import RecordedRun, recorded_run
from blf_dsc_controller.bags.table import described
from blf_dsc_controller.bags.table import export as export_run
from blf_dsc_controller.cli.output import make_room


def report(options: Namespace) -> None:
    """Write the HTML page of one or several bags."""
    make_room(options.out, force=options.force)
    bags = read_bags(options.bags, options.namespace, NameMap.parse(options.map))
    write_report(bags, options.out)
    print(f'wrote {options.out} ({options.out.stat().st_size / 1e6:.1f} MB)')


def _run(options: Namespace) -> RecordedRun:
    """Read the run of a bag, and print what is left out."""
    names = NameMap.parse(options.map)
    run = recorded_run(
        read_content(options.bag, options.namespace, names), names, options.namespace
    )
    for note in run.notes:
        print(f'note: {note}')
    return run


def export(options: Namespace) -> None:
    """Write a bag as a table."""
    out = options.out
    make_room(out, *([described(out)] if out.suffix == '.csv' else ()), force=options.force)
    run = _run(options)
    columns = export_run(run, options.out)
    print(f'wrote {options.out}: {run.stamp.size} rows of {columns} columns')
    if options.out.suffix == '.csv':
        print(f'wrote {described(options.out)}: their units')


def plot(options: Namespace) -> None:
    """Plot and summarise a bag."""
    names = ('summary.json', *figures.NAMES)
    make_room(*(options.out / name for name in names), force=options.force)
    run = _run(options)
    metrics = summary.summarize(run)
    options.out.mkdir(parents=True, exist_ok=True)
    summary.write_summary(metrics, options.out / 'summary.json')
    written = [options.out / 'summary.json', *figures.draw(run, options.out)]
    print(summary.format_table(metrics))
    print('wrote', ', '.join(str(path) for path in written))


def recover(options: Namespace) -> int:
    """Make a clean bag from a damaged one and list the losses; return 1 if nothing is left."""
    bag = options.bag.resolve()
    out = options.out or bag.with_name(f'{bag.stem}_recovered')
    recovery = recovering.recover(options.bag, out)
    print('\n'.join(_losses(recovery)))
    return int(recovery.is_empty)


def _losses(recovery: recovering.Recovery) -> Iterator[str]:
    for topic, count in recovery.messages.items():
        missing = recovery.missing[topic]
        gaps = f', {missing.missed} numbers missing in between' if missing.missed else ''
        begun = f', {missing.before} numbers missing before the first' if missing.before else ''
        yield f'{topic}: {count} messages{gaps}{begun}'
    for loss in recovery.losses:
        yield f'LOST {loss}'
    for name, last in recovery.unfinished:
        after = (
            'nothing in it could be read'
            if last is None
            else f'it ends at {recovering.format_time(last)}'
        )
        yield (
            f'{name}: the recording was not closed; {after}. Later messages are lost: usually the '
            'last 0.1 s before a kill, more if the computer was overloaded or lost power'
        )
    if recovery.unknown:
        yield f'LOST {recovery.unknown} messages of topics whose name or type is unknown'
    if recovery.is_empty:
        yield 'ALL LOST: no message could be recovered'
    if recovery.is_whole:
        yield 'none of the recorded messages was lost'
    yield f'wrote {recovery.path}'

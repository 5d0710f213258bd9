# SPDX-License-Identifier: Apache-2.0
"""`bag_recover`: a clean bag of a damaged one, and what was lost."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from blf_dsc_controller.bags.damage import clock
from blf_dsc_controller.bags.recover import Recovery, recover
from blf_dsc_controller.errors import BlfDscError


def parser() -> argparse.ArgumentParser:
    """Command-line options."""
    options = argparse.ArgumentParser(
        prog='bag_recover',
        description='Make a clean bag of one that was cut off or damaged, and tell what was lost. '
        'The damaged one is not touched.',
    )
    options.add_argument('bag', type=Path, help='folder of the bag, or its .mcap file')
    options.add_argument('--out', type=Path, help='new folder (BAG_recovered)')
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parser().parse_args(arguments)
    bag = options.bag.resolve()
    out = options.out or bag.with_name(f'{bag.stem}_recovered')
    try:
        recovery = recover(options.bag, out)
    except BlfDscError as error:
        print(f'bag_recover: {error}', file=sys.stderr)
        return 1
    print('\n'.join(_lines(recovery)))
    return 0


def _lines(recovery: Recovery) -> Iterator[str]:
    for topic, count in recovery.messages.items():
        missed = recovery.missed[topic]
        gaps = f', {missed} numbers missing in between' if missed else ''
        before = recovery.before[topic]
        begun = f', {before} numbers missing before the first' if before else ''
        yield f'{topic}: {count} messages{gaps}{begun}'
    for loss in recovery.losses:
        yield f'LOST {loss}'
    for name, last in recovery.unfinished:
        after = 'nothing in it could be read' if last is None else f'it ends at {clock(last)}'
        yield (
            f'{name}: the recording was not ended; {after}. What came later is not in the file: '
            'at most 0.1 s if the recorder was killed'
        )
    if recovery.unknown:
        yield f'LOST {recovery.unknown} messages of topics whose name or type is not told'
    if recovery.is_whole:
        yield 'nothing was lost of what had been recorded'
    yield f'wrote {recovery.path}'


if __name__ == '__main__':
    sys.exit(main())

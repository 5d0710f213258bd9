# SPDX-License-Identifier: Apache-2.0
"""`bag_plot`: pictures and a summary of any bag with the topics of this package."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from blf_dsc_controller.analysis.figures import draw
from blf_dsc_controller.analysis.summary import summarize, write_summary
from blf_dsc_controller.analysis.table import format_table
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.errors import BlfDscError


def parser() -> argparse.ArgumentParser:
    """Command-line options."""
    options = argparse.ArgumentParser(
        prog='bag_plot',
        description='Draw tracking.png and parameters.png of a bag and write summary.json.',
    )
    options.add_argument('bag', type=Path, help='folder of the bag, or its .mcap or .db3 file')
    options.add_argument(
        '--out', type=Path, default=Path(), help='folder to write into (the current one)'
    )
    options.add_argument(
        '--namespace', default='', help='of the robot to look at, if the bag holds several'
    )
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parser().parse_args(arguments)
    try:
        run = read_run(options.bag, options.namespace)
    except BlfDscError as error:
        print(f'bag_plot: {error}', file=sys.stderr)
        return 1
    summary = summarize(run)
    options.out.mkdir(parents=True, exist_ok=True)
    write_summary(summary, options.out / 'summary.json')
    written = [options.out / 'summary.json', *draw(run, options.out)]
    print(format_table(summary))
    print('wrote', ', '.join(str(path) for path in written))
    return 0


if __name__ == '__main__':
    sys.exit(main())

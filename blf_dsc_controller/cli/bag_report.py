# SPDX-License-Identifier: Apache-2.0
"""`bag_report`: one HTML page of a bag, or of several over each other."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from blf_dsc_controller.analysis.report import write_report
from blf_dsc_controller.analysis.subject import read_subjects
from blf_dsc_controller.errors import BlfDscError


def parser() -> argparse.ArgumentParser:
    """Command-line options."""
    options = argparse.ArgumentParser(
        prog='bag_report',
        description='Write one HTML page that shows a bag, or several over each other: plots to '
        'zoom into, events, configuration and the moving arm. It needs no network.',
    )
    options.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='folder of a bag')
    options.add_argument('--out', type=Path, default=Path('report.html'), help='file (report.html)')
    options.add_argument(
        '--namespace', default='', help='of the robot to look at, if a bag holds several'
    )
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parser().parse_args(arguments)
    try:
        write_report(read_subjects(options.bags, options.namespace), options.out)
    except (BlfDscError, OSError) as error:
        print(f'bag_report: {error}', file=sys.stderr)
        return 1
    print(f'wrote {options.out} ({options.out.stat().st_size / 1e6:.1f} MB)')
    return 0


if __name__ == '__main__':
    sys.exit(main())

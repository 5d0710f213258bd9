# SPDX-License-Identifier: Apache-2.0
"""`bag_export`: the series of a bag as one table, in CSV or Parquet."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from blf_dsc_controller.bags.export import export
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.errors import BlfDscError


def parser() -> argparse.ArgumentParser:
    """Command-line options."""
    options = argparse.ArgumentParser(
        prog='bag_export',
        description='Write the series of a bag as one table, a row for each joint state.',
    )
    options.add_argument('bag', type=Path, help='folder of the bag, or its .mcap or .db3 file')
    options.add_argument('--out', type=Path, required=True, help='FILE.csv or FILE.parquet')
    options.add_argument(
        '--namespace', default='', help='of the robot to look at, if the bag holds several'
    )
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parser().parse_args(arguments)
    try:
        run = read_run(options.bag, options.namespace)
        columns = export(run, options.out)
    except (BlfDscError, OSError) as error:
        print(f'bag_export: {error}', file=sys.stderr)
        return 1
    print(f'wrote {options.out}: {run.stamp.size} rows of {columns} columns')
    return 0


if __name__ == '__main__':
    sys.exit(main())

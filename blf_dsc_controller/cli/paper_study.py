# SPDX-License-Identifier: Apache-2.0
"""`paper_study`: the paper's Section IV, its claims, and where each law breaks, as a report."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from blf_dsc_controller.cli.output_folder import make_folder
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.paper.report import study

_INTERRUPTED = 130


def parser() -> argparse.ArgumentParser:
    """Command-line options."""
    options = argparse.ArgumentParser(
        prog='paper_study',
        description="Run the paper's simulation with every law, hold its claims against it, and "
        'see where each law breaks; offline, on all cores.',
    )
    options.add_argument(
        '--out', type=Path, default=Path('paper_study'), help='new folder for the report'
    )
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    out = parser().parse_args(arguments).out
    try:
        found = study(make_folder(out))
    except BlfDscError as error:
        print(f'paper_study: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return _INTERRUPTED
    for claim in found:
        print(f'{claim.where:<18} {claim.says}\n{"":<18} {claim.judgement}')
    print(f'wrote {out / "index.html"}')
    return 0


if __name__ == '__main__':
    sys.exit(main())

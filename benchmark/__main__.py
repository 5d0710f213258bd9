# SPDX-License-Identifier: Apache-2.0
"""`python -m benchmark`: list the tables; `python -m benchmark NAME ...`: make one."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from benchmark.tables import BENCH, GROUPS, TABLES, module_of
from blf_dsc_controller.cli.main import end_at_signals, keep_to_one_thread
from blf_dsc_controller.cli.start import INTERRUPTED
from blf_dsc_controller.errors import BlfDscError


def main(words: Sequence[str] | None = None) -> int:
    """Make a table, or list all; return the exit code."""
    name, *rest = (sys.argv[1:] if words is None else words) or ['']
    if name in ('', '-h', '--help'):
        print(listing())
        return 0
    if name not in TABLES:
        print(f'benchmark: no table {name}\n{listing()}', file=sys.stderr)
        return 2
    end_at_signals(f'benchmark {name}')
    if name != BENCH:
        keep_to_one_thread()
    try:
        module = importlib.import_module(module_of(name))
        module.main(parser_of(name).parse_args(rest))
    except (BlfDscError, OSError) as error:
        print(f'benchmark {name}: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f'benchmark {name}: interrupted', file=sys.stderr)
        return INTERRUPTED
    return 0


def listing() -> str:
    """Return a line for each table, by group."""
    width = max(map(len, TABLES))
    lines = ['python -m benchmark TABLE [--help]']
    for group, tables in GROUPS.items():
        lines += ['', f'{group}:']
        lines += [f'  {name:<{width}}  {about}' for name, about in tables.items()]
    return '\n'.join(lines)


def parser_of(name: str) -> argparse.ArgumentParser:
    """Return the parser of a table's options; this imports its module."""
    module = importlib.import_module(module_of(name))
    parser = argparse.ArgumentParser(
        prog=f'python -m benchmark {name}',
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    getattr(module, 'arguments', lambda _: None)(parser)
    return parser


if __name__ == '__main__':
    sys.exit(main())

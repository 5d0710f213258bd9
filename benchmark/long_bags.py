# SPDX-License-Identifier: Apache-2.0
"""CPU time and memory of each tool on bags of a Panda at 1 kHz: long_bags.py MINUTES...

Each bag is recorded offline with all telemetry first. Prints a table for doc/performance.md.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from harness import print_table

_COMMAND = [sys.executable, '-m', 'blf_dsc_controller']
_RECORD = ('run', '--config', 'panda', '--offline', '--duration')
_TOOLS = {
    'plot': ('--out', 'plots'),
    'report': ('--out', 'page.html'),
    'replay': (),
    'export': ('--out', 'table.parquet'),
}


def measured(folder: Path, *words: str) -> tuple[float, float]:
    """Run a command in a folder; return its CPU time [s] and largest memory [MB]."""
    process = subprocess.Popen([*_COMMAND, *words], cwd=folder, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f'{" ".join(words)} failed with exit code {process.returncode}')
    return used.ru_utime + used.ru_stime, used.ru_maxrss * 1024e-6


def main() -> None:
    """Print a row for each bag."""
    print_table(('bag', 'size', *_TOOLS), map(_row, sys.argv[1:]))


def _row(minutes: str) -> tuple[str, ...]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        measured(folder, *_RECORD, f'{60.0 * float(minutes)}', '--out', 'run')
        size = sum(file.stat().st_size for file in (folder / 'run/bag').iterdir())
        used = [measured(folder, tool, 'run/bag', *words) for tool, words in _TOOLS.items()]
    figures = (f'{cpu:.1f} s, {memory:.0f} MB' for cpu, memory in used)
    return f'{minutes} min', f'{1e-9 * size:.2f} GB', *figures


if __name__ == '__main__':
    main()

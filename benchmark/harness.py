# SPDX-License-Identifier: Apache-2.0
"""Run all benchmarks and write a table: python benchmark/harness.py [GROUP ...] [--out FOLDER].

Each figure is the ratio of interleaved measurements: on a shared machine only they can be compared.
Contestants may be processes.
"""

from __future__ import annotations

import argparse
import datetime as dt
import gc
import importlib.metadata
import itertools
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from blf_dsc_controller import __version__
from blf_dsc_controller.errors import BlfDscError

_GROUPS = {  # module and function of each
    'offline': ('offline', 'measure'),
    'montecarlo': ('offline', 'measure_study'),
    'growth': ('offline', 'measure_growth'),
    'replay': ('offline', 'measure_replay'),
    'node': ('nodes', 'measure'),
    'startup': ('nodes', 'measure_start'),
}
_HERE = Path(__file__).parent
_PACKAGES = ('numpy', 'numba', 'scipy', 'mujoco', 'pin', 'ros-jazzy-rclpy')
_START_UP = 120.0  # s, including compilation of kernels
_ENDING = 20.0  # s from SIGINT to the end
_TAIL = 2000  # characters of stderr quoted in an error
_CPUCLOCK_SCHED = 2  # as clock_getcpuclockid(3) does: in ns, where /proc has 10 ms


class Ratio(NamedTuple):
    """Ratio of a contestant's measurement to the baseline of its group."""

    group: str
    what: str  # the contestant
    median: float  # of the ratios of all rounds; a round measures both within seconds
    low: float
    high: float
    baseline: str
    note: str = ''


def ratio(
    group: str, what: str, baseline: str, mine: np.ndarray, theirs: np.ndarray, note: str = ''
) -> Ratio:
    """Return the ratio of two interleaved series (rounds,)."""
    low, median, high = np.quantile(mine / theirs, (0.0, 0.5, 1.0)).tolist()
    return Ratio(group, what, median, low, high, baseline, note)


def interleaved(contestants: Mapping[str, Callable[[], int]], rounds: int) -> dict[str, np.ndarray]:
    """Return seconds per unit of work (rounds,) of each contestant, all run in each round.

    A contestant does its work and returns the number of units. The first round is a warm-up.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for counted in range(-1, rounds):
        for name, work in contestants.items():
            gc.collect()
            begin = time.perf_counter()
            units = work()
            elapsed = time.perf_counter() - begin
            if counted >= 0:
                seconds[name].append(elapsed / units)
    return {name: np.array(values) for name, values in seconds.items()}


def table_lines(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a Markdown table."""
    for row in itertools.chain([heads, ['---'] * len(heads)], rows):
        yield f'| {" | ".join(row)} |'


def print_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a Markdown table, each row as soon as it is known."""
    for line in table_lines(heads, rows):
        print(line, flush=True)


class ContestantError(BlfDscError):
    """A contestant has exited early, or does not respond."""


class Contestant(subprocess.Popen[bytes]):
    """A process of this Python interpreter: a script or `-m module`, and its arguments."""

    def __init__(
        self, name: str, arguments: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        self.name = name
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        super().__init__(
            [sys.executable, *arguments],
            env={**os.environ, **(environment or {})},
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
        )

    def cpu_time(self) -> float:
        """Return the user and system time of the process so far [s]."""
        return time.clock_gettime(~self.pid << 3 | _CPUCLOCK_SCHED)

    def check(self) -> None:
        """Raise ContestantError, with the end of its stderr, if the process has ended."""
        code = self.poll()
        if code is not None:
            self._errors.seek(0)
            errors = self._errors.read().decode(errors='replace')[-_TAIL:].strip()
            raise ContestantError(f'{self.name} ended with exit code {code}:\n{errors}')

    def end(self) -> None:
        """End the process as Ctrl-C does, or kill it if that is not enough."""
        self.send_signal(signal.SIGINT)
        try:
            self.wait(_ENDING)
        except subprocess.TimeoutExpired:
            self.kill()
            self.wait()
        self._errors.close()


def wait_for(
    condition: Callable[[], bool],
    what: str,
    contestants: Sequence[Contestant] = (),
    pause: Callable[[], object] = lambda: time.sleep(0.02),
    timeout: float = _START_UP,
) -> None:
    """Wait until the condition holds; ContestantError after `timeout` [s] or if one has ended."""
    begin = time.perf_counter()
    while not condition():
        for contestant in contestants:
            contestant.check()
        if time.perf_counter() - begin > timeout:
            raise ContestantError(f'timed out after {timeout:g} s waiting for {what}')
        pause()


@contextmanager
def own_graph() -> Iterator[None]:
    """Isolate the ROS nodes of this process and of its contestants from all others."""
    from blf_dsc_controller.cli.session import localhost_environment, own_domain

    with own_domain() as domain:
        os.environ.update({'ROS_DOMAIN_ID': str(domain), **localhost_environment()})
        yield


def machine() -> str:
    """Describe the machine and the versions, without the host name."""
    models = re.findall(r'model name\s*:\s*(.*)', Path('/proc/cpuinfo').read_text())
    model = models[0] if models else 'unknown processor'
    versions = [f'Python {platform.python_version()}', f'blf_dsc_controller {__version__}']
    for package in _PACKAGES:
        try:
            versions.append(f'{package} {importlib.metadata.version(package)}')
        except importlib.metadata.PackageNotFoundError:
            versions.append(f'{package} absent')
    return f'{model}, {os.cpu_count()} cores, {platform.system()}; {", ".join(versions)}'


def table(rows: list[Ratio]) -> str:
    """Return Markdown with a table for each group."""
    lines: list[str] = []
    for group, members in groupby(rows, key=lambda row: row.group):
        cells = (
            (row.what, f'**{row.median:.3g}**', f'{row.low:.3g} to {row.high:.3g}', *row[-2:])
            for row in members
        )
        lines += ['', f'## {group}', '']
        lines += table_lines(('what', 'ratio', 'range', 'to', ''), cells)
    return '\n'.join(lines) + '\n'


def main() -> None:
    """Run the groups and write RESULTS.md."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument('groups', nargs='*', metavar='GROUP', help=', '.join(_GROUPS))
    options.add_argument('--out', type=Path, default=_HERE, help='folder for the results')
    chosen = options.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    rows: list[Ratio] = []
    for name in chosen.groups or _GROUPS:
        print(f'measuring: {name}', flush=True)
        module, function = _GROUPS[name]
        for row in getattr(importlib.import_module(module), function)():
            print(f'  {row.what}: {row.median:.3g} times {row.baseline}  {row.note}', flush=True)
            rows.append(row)
    today = dt.datetime.now(dt.timezone.utc).date()
    text = (
        '# Results of the benchmarks\n\n'
        f'Written by `make bench` on {today}. Every figure is a ratio of two things measured in '
        'turns in\nthe same run: median and range of its rounds. Absolute times are notes about '
        f'one machine.\n\n{machine()}\n' + table(rows)
    )
    (chosen.out / 'RESULTS.md').write_text(text, encoding='utf-8')
    print(f'written: {chosen.out / "RESULTS.md"}')


if __name__ == '__main__':
    main()

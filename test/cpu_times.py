# SPDX-License-Identifier: Apache-2.0
"""`--cpu N`: CPU times of test files, and of the N tests that take most, for `conftest.py`.

Times of the clock say little where tests wait for other processes, or share the computer.
User and system time are counted, also that of processes which a test has waited for.
"""

from __future__ import annotations

import resource
from collections import defaultdict

import pytest

_BEGUN = pytest.StashKey[float]()
_KINDS = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN


def _now():
    """Return the CPU time of this process and of those that it has waited for [s]."""
    return sum(sum(resource.getrusage(kind)[:2]) for kind in _KINDS)


def pytest_addoption(parser):
    parser.addoption('--cpu', type=int, metavar='N', help=__doc__.partition('\n')[0])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    item.stash[_BEGUN] = _now()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if call.when == 'teardown':
        report.cpu = _now() - item.stash[_BEGUN]
    return report


def pytest_terminal_summary(terminalreporter, config):
    """Print the table, also of tests that ran on other workers."""
    if config.option.cpu is None:
        return
    tests = {
        report.nodeid: report.cpu
        for reports in terminalreporter.stats.values()
        for report in reports
        if hasattr(report, 'cpu')
    }
    files = defaultdict(float)
    for name, seconds in tests.items():
        files[name.partition('::')[0]] += seconds
    terminalreporter.section(f'CPU times: {sum(tests.values()):.0f} s')
    for times, most in ((files, None), (tests, config.option.cpu)):
        for name in sorted(times, key=times.get, reverse=True)[:most]:
            terminalreporter.line(f'{times[name]:8.1f} s  {name}')

# SPDX-License-Identifier: Apache-2.0
"""The executables: Ctrl-C ends each without a traceback, also while it is still imported.

This module imports next to nothing, since the first second of a command goes into imports.
"""

from __future__ import annotations

import os
import signal
from functools import partial
from importlib import import_module

_MAIN = 'blf_dsc_controller.cli.main'
INTERRUPTED = 130
"""Exit code after Ctrl-C."""


def main() -> int:
    """Run the command `blf_dsc` and return its exit code."""
    _exit_at_signals(INTERRUPTED, b'blf_dsc: interrupted\n')
    code: int = import_module(_MAIN).main()
    return code


def _node(name: str) -> int:
    """Run the executable of a node, which ends silently, and return its exit code."""
    _exit_at_signals(0)
    code: int = getattr(import_module(_MAIN), name)()
    return code


def _exit_at_signals(code: int, text: bytes = b'') -> None:
    """Exit at SIGINT and SIGTERM, until there are other handlers."""

    def leave(*_: object) -> None:
        os.write(2, text)
        os._exit(code)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, leave)


sim_plant = partial(_node, 'sim_plant')
blf_dsc_controller = partial(_node, 'blf_dsc_controller')
bag_recorder = partial(_node, 'bag_recorder')
torque_watchdog = partial(_node, 'torque_watchdog')
arm_view = partial(_node, 'arm_view')

# SPDX-License-Identifier: Apache-2.0
"""The command `blf_dsc`, and the executables of the nodes.

Sub-commands are imported when they run, so `--help` is fast and needs neither ROS nor extras.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from contextvars import copy_context
from functools import partial
from pathlib import Path

from blf_dsc_controller.cli.parser import make_parser
from blf_dsc_controller.errors import BlfDscError

INTERRUPTED = 130
"""Exit code after Ctrl-C."""

_THREADS = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a sub-command and return its exit code; errors print a message to stderr and return 1."""
    parser = make_parser()
    options = parser.parse_args(arguments)
    _keep_to_one_thread()
    if options.command is None:
        parser.print_help(sys.stderr)
        return 2
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, partial(_interrupt, options.command))
    # Names may have letters that the font of the pictures lacks.
    warnings.filterwarnings('ignore', 'Glyph .* missing')
    try:
        code = copy_context().run(_handle, options)
    except (BlfDscError, OSError) as error:
        print(f'blf_dsc {options.command}: {_sentence(error, options)}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        is_study = options.command == 'monte-carlo' and not (options.reproduce or options.report)
        remedy = '; the same command resumes the study' if is_study else ''
        print(f'blf_dsc {options.command}: interrupted{remedy}', file=sys.stderr)
        return INTERRUPTED
    return code or 0


def _handle(options: argparse.Namespace) -> int | None:
    if options.command == 'run' and not options.offline:
        require_ros()  # before what takes a second to import
    module, function = options.handler
    code: int | None = getattr(
        importlib.import_module(f'blf_dsc_controller.cli.{module}'), function
    )(options)
    return code


def _keep_to_one_thread() -> None:
    """Let numpy's libraries, not loaded yet, start no threads unless the environment says so.

    The matrices here are small. The threads would spin, beside nodes that run at the same time and,
    in a real-time node, at its priority.
    """
    for name in _THREADS:
        os.environ.setdefault(name, '1')


def _interrupt(command: str, _number: int, _frame: object) -> None:
    """Raise KeyboardInterrupt, or exit at once during compilation, which would swallow it."""
    numba = sys.modules.get('numba.core.compiler_lock')
    if numba is not None and numba.global_compiler_lock.is_locked():
        os.write(2, f'blf_dsc {command}: interrupted\n'.encode())
        os._exit(INTERRUPTED)
    raise KeyboardInterrupt


def _sentence(error: BlfDscError | OSError, options: argparse.Namespace) -> str:
    """Return the message of an error; an OSError around --out is reported as unwritable."""
    out = getattr(options, 'out', None)
    if isinstance(error, BlfDscError) or not (out and error.errno):
        return str(error)
    named, out = Path(error.filename or out).resolve(), Path(out).resolve()
    if named not in (out, *out.parents) and not named.is_relative_to(out.parent):
        return str(error)
    return str(unwritable(options.out, error))


def unwritable(path: Path, error: OSError) -> BlfDscError:
    """Return the error for a file or folder of --out that cannot be written."""
    reason = os.strerror(error.errno) if error.errno else error
    return BlfDscError(f'{path} cannot be written ({reason}): make space or choose another path')


def require_ros() -> None:
    """Raise BlfDscError if ROS 2 cannot be imported."""
    try:
        importlib.import_module('rclpy')
    except ImportError as error:
        raise BlfDscError(
            f'ROS 2 cannot be imported ({error}): source ROS 2 Jazzy '
            '(source /opt/ros/jazzy/setup.bash), or install it as wheels '
            "(pip install 'blf_dsc_controller[ros]')"
        ) from error


def make_room(*paths: Path, force: bool) -> None:
    """Prepare `paths` for writing; a symbolic link is replaced instead of followed.

    Raises BlfDscError if one of them exists, unless `force` is set.
    """
    existing = [path for path in paths if os.path.lexists(path)]
    if existing and not force:
        names = ', '.join(str(path) for path in existing)
        exist = 'exists' if len(existing) == 1 else 'exist'
        raise BlfDscError(f'{names} {exist} already: choose another path, or use --force')
    for path in existing:
        if path.is_symlink():
            path.unlink()


def _node(module: str) -> int:
    _keep_to_one_thread()
    for number in (signal.SIGINT, signal.SIGTERM):  # until the node installs its own handlers
        signal.signal(number, lambda *_: os._exit(0))
    try:
        require_ros()
    except BlfDscError as error:
        print(error, file=sys.stderr)
        return 1
    code: int = importlib.import_module(module).main()
    return code


sim_plant = partial(_node, 'blf_dsc_controller.nodes.plant_node')
blf_dsc_controller = partial(_node, 'blf_dsc_controller.nodes.controller_node')
bag_recorder = partial(_node, 'blf_dsc_controller.nodes.recorder_node')
torque_watchdog = partial(_node, 'blf_dsc_controller.nodes.watchdog_node')
arm_view = partial(_node, 'blf_dsc_controller.view.node')

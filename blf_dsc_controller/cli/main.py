# SPDX-License-Identifier: Apache-2.0
"""The command `blf_dsc` with its sub-commands, and the executables of the nodes.

Sub-commands are imported when they run, so `--help` is fast and needs neither ROS nor
extras.
"""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from blf_dsc_controller import child, writing
from blf_dsc_controller.cli.parser import (
    check_command,
    check_text,
    make_parser,
    parse,
)
from blf_dsc_controller.cli.result_folder import discard_empty, discard_unbegun
from blf_dsc_controller.cli.start import INTERRUPTED
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.nodes.ros_check import require_ros

_USAGE = """\
usage: ros2 run blf_dsc_controller {} --ros-args [--params-file FILE.yaml] [-p NAME:=VALUE]
`ros2 param describe` and doc/parameters.md tell its parameters, doc/topics.md its topics."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a sub-command and return its exit code.

    Errors print a message to stderr and return 1.
    """
    parser = make_parser()
    words = sys.argv[1:] if arguments is None else arguments
    check_command(parser, words)
    check_text(parser, words)
    options = parse(
        parser, words, argparse.Namespace(line=shlex.join(['blf_dsc', *words]))
    )
    keep_to_one_thread()
    if options.command is None:
        parser.print_help(sys.stderr)
        return 2
    end_at_signals(f'blf_dsc {options.command}')
    # Names may have letters that the font of the pictures lacks.
    warnings.filterwarnings('ignore', 'Glyph .* missing')
    code = _code_of(options)
    lost = _lost_output()
    if lost:
        print(f'blf_dsc {options.command}: {lost}', file=sys.stderr)
        return code or 1
    return code


def _code_of(options: argparse.Namespace) -> int:
    """Run the chosen command and return its exit code."""
    try:
        if options.command == 'run' and not options.offline:
            require_ros()  # before what takes a second to import
        module, function = options.handler
        command = getattr(child.imported(f'blf_dsc_controller.cli.{module}'), function)
        code: int | None = command(options)
    except BrokenPipeError:
        return 1  # nobody reads any more
    except (BlfDscError, OSError) as error:
        discard_empty()
        text = _place_text(error) if isinstance(error, OSError) else error
        print(f'blf_dsc {options.command}: {text}', file=sys.stderr)
        return 1
    except UnicodeEncodeError as error:
        print(
            f'blf_dsc {options.command}: {error.object[error.start : error.end]!a} cannot be '
            'written in the encoding of this shell: set LC_ALL=C.UTF-8',
            file=sys.stderr,
        )
        return 1
    except KeyboardInterrupt:
        discard_unbegun()
        print(f'blf_dsc {options.command}: interrupted', file=sys.stderr)
        return INTERRUPTED
    return code or 0


def _place_text(error: OSError) -> str:
    """Return what is wrong with the place of a file, and what to do."""
    path = error.filename
    match error:
        case OSError(filename=None):
            return error.strerror or f'{error}'
        case FileNotFoundError():
            folder = Path(path).parent
            what = (
                (path, 'its folder') if folder.exists() else (f'folder {folder}', 'it')
            )
            return f'there is no {what[0]}: make {what[1]}, or choose another path'
        case PermissionError():
            return f'{path} may not be read or written by you: choose another path'
        case IsADirectoryError():
            return f'{path} is a folder: choose the path of a file'
        case FileExistsError() | NotADirectoryError():
            return f'{path} is no folder: choose another path'
    return f'{path}: {error.strerror}: choose another path'


def _lost_output() -> str:
    """Write what is still to be printed; return what is lost of it, in a sentence.

    Nothing is lost of a pipe that somebody closes, as `head` does.
    """
    try:
        sys.stdout.flush()
    except OSError as error:
        # so that the end of the interpreter does not try again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            return f'what it says cannot be written: {error.strerror}'
    return ''


def keep_to_one_thread() -> None:
    """Let numpy's libraries start no threads, unless the environment says so.

    They must not be loaded yet.

    The matrices here are small. The threads would spin, beside nodes that run at the
    same time and, in a real-time node, at its priority.
    """
    for name, count in child.ONE_THREAD.items():
        os.environ.setdefault(name, count)


def end_at_signals(program: str) -> None:
    """Let SIGINT and SIGTERM interrupt a program, also while it compiles."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, partial(_interrupt, program))


def _interrupt(program: str, _number: int, _frame: object) -> None:
    """Raise KeyboardInterrupt, or exit at once during compilation, which would swallow it."""
    numba = sys.modules.get('numba.core.compiler_lock')
    if numba is not None and numba.global_compiler_lock.is_locked():
        discard_unbegun()
        os.write(2, f'{program}: interrupted\n'.encode())
        os._exit(INTERRUPTED)
    raise KeyboardInterrupt


def make_room(*paths: Path, force: bool, try_out: bool = True) -> None:
    """Prepare `paths` for writing; a symbolic link is replaced instead of followed.

    They are tried out, before minutes of work: not those whose folder is still to be made.

    Raises:
        BlfDscError: one of them exists, unless `force` is set.
        OSError: one of them cannot be written.
    """
    existing = [path for path in paths if os.path.lexists(path)]
    if existing and not force:
        raise BlfDscError(
            f'{existing[0]} exists already: choose another path, or use --force'
        )
    for path in existing:
        if path.is_symlink():
            path.unlink()
    for path in paths if try_out else ():
        writing.try_out(path)


def _node(module: str) -> int:
    if {'-h', '--help'} & {*sys.argv[1:]}:
        print(_USAGE.format(Path(sys.argv[0]).name))
        return 0
    keep_to_one_thread()
    # until the node installs its own handlers
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    try:
        require_ros()
    except BlfDscError as error:
        print(error, file=sys.stderr)
        return 1
    code: int = child.imported(module).main()
    return code


sim_plant = partial(_node, 'blf_dsc_controller.nodes.plant_node')
blf_dsc_controller = partial(_node, 'blf_dsc_controller.nodes.controller_node')
bag_recorder = partial(_node, 'blf_dsc_controller.nodes.recorder_node')
torque_watchdog = partial(_node, 'blf_dsc_controller.nodes.watchdog_node')
arm_view = partial(_node, 'blf_dsc_controller.view.node')

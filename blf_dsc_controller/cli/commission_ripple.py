# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc commission --ripple`: the slow motion that shows torque ripple, and what it shows.

On a robot it follows a proof. The file with the gains exists before, so an end before its time
costs the ripple alone.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path

from blf_dsc_controller.cli.commissioned_file import CommissionedFile, wrapped
from blf_dsc_controller.cli.run import STOPPED
from blf_dsc_controller.commissioning import files, ripple_page, simulated
from blf_dsc_controller.commissioning.commissioned import Commissioned
from blf_dsc_controller.commissioning.postures import (
    EndedError,
    PostureByPosture,
    ripples_by_bag,
)
from blf_dsc_controller.commissioning.ripple import ripples_in, to_learn
from blf_dsc_controller.commissioning.slow_motion import slow_motion
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import dump, load_loop, read
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.ripple import Ripples
from blf_dsc_controller.progress import print_notice


def after_proof(
    options: Namespace, arm: PostureByPosture, config: ControllerConfig, source: Path
) -> int:
    """Make the slow motion with gains that are proven, and write what it shows.

    `source` is the file that has them; with a ripple, it is written anew.  Return the exit code.
    An error is printed, since the arm is still to be held.

    Raises EndedError if it is not.
    """
    try:
        with _without_ripple(source):
            ripples = _measured(arm, config)
    except EndedError:
        raise
    except BlfDscError as error:
        print(f'blf_dsc commission: {error}', file=sys.stderr)
        return 1
    _tell(config, ripples)
    if listed := to_learn(ripples):
        sections = files.with_ripple(read(source), [each.cycles for each in listed])
        table = ripple_page.ripple_table(config, ripples).splitlines()
        told = wrapped([*ripple_page.of_ripple(config, ripples)])
        comment = [f'# {line}\n' for line in (options.line, *told, *table)]
        dump(options.out, sections, ''.join([*_comment(source), *comment]))
        print(f'wrote {options.out}')
    return 0


def _comment(path: Path) -> Iterator[str]:
    """Yield the lines of a parameter file before its first section."""
    with path.open(encoding='utf-8') as lines:
        yield from takewhile(lambda line: line.startswith('#'), lines)


def _measured(arm: PostureByPosture, config: ControllerConfig) -> tuple[Ripples, ...]:
    """Return what the slow motion of a configuration shows."""
    motion = arm.aside(slow_motion, config)
    print(ripple_page.description(motion), flush=True)
    bag = arm.slow(motion)
    print_notice('looking for torque ripple in it: some seconds')
    return arm.aside(ripples_by_bag, bag)


def on_simulated(file: CommissionedFile, found: Commissioned, stop: str) -> int:
    """Simulate the slow motion with the gains that are in a file, and write what it shows.

    Not if a `stop` has ended the proof.  Return the exit code.
    """
    try:
        with _without_ripple(file.path):
            ripples = _simulated(file.path, stop)
    except BlfDscError as error:
        print(f'blf_dsc commission: {error}', file=sys.stderr)
        return STOPPED
    found = found._replace(ripples=ripples)
    file.write(found, file.content(found))
    _tell(found.before, ripples)
    print(f'wrote {file.path}')
    return 0


def _simulated(path: Path, stop: str) -> tuple[Ripples, ...]:
    """Return what the slow motion shows of the simulated arm of a file."""
    if stop:
        raise BlfDscError('the simulated arm stops with these gains')
    loop = load_loop(path)
    motion = slow_motion(loop.controller)
    print(ripple_page.description(motion))
    print_notice('simulating it, and looking for torque ripple: some ten seconds')
    return ripples_in([simulated.slow_run(motion, loop.plant)])


@contextmanager
def _without_ripple(path: Path) -> Iterator[None]:
    """Let an error say what was not measured, and which file has the gains."""
    left = f'Torque ripple was not measured; {path} has all else'
    try:
        yield
    except EndedError as error:
        raise EndedError(error.end, f'{error}. {left}') from error
    except BlfDscError as error:
        raise BlfDscError(f'{error}. {left}') from error


def _tell(config: ControllerConfig, ripples: Sequence[Ripples]) -> None:
    """Print the torque ripple, and how sure it is."""
    told = wrapped([*ripple_page.of_ripple(config, ripples)])
    print('\n'.join(['', ripple_page.ripple_table(config, ripples), '', *told]))

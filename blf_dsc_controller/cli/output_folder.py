# SPDX-License-Identifier: Apache-2.0
"""The folder of a run's results, which is always a new one."""

from __future__ import annotations

import itertools
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError

DEFAULT = 'closed_loop'


class OutputExistsError(BlfDscError):
    """The folder for the results is there already."""

    def __init__(self, path: Path) -> None:
        self.path = path
        super().__init__(f'{path} exists already and is not overwritten: choose another --out')


class OutputError(BlfDscError):
    """The folder for the results cannot be written."""

    def __init__(self, path: Path, error: OSError) -> None:
        self.path = path
        super().__init__(
            f'{error.filename or path} cannot be written ({error.strerror}): make room or choose '
            'another --out'
        )


def make_folder(chosen: Path | None) -> Path:
    """Make the folder that was chosen, or else the first free one of closed_loop, closed_loop-2...

    Raises:
        OutputExistsError: the chosen folder is there already.
        OutputError: it cannot be made.
    """
    try:
        return _make(chosen) if chosen is not None else _make_next()
    except OSError as error:
        raise OutputError(chosen or Path(DEFAULT), error) from error


def _make(path: Path) -> Path:
    try:
        path.mkdir(parents=True)
    except FileExistsError:
        raise OutputExistsError(path) from None
    return path


def _make_next() -> Path:
    for number in itertools.count(1):
        try:
            return _make(Path(DEFAULT if number == 1 else f'{DEFAULT}-{number}'))
        except OutputExistsError:
            continue
    raise AssertionError

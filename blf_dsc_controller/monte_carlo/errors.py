# SPDX-License-Identifier: Apache-2.0
"""What can keep a study from being run or gone on with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError


class NotAStudyError(BlfDscError):
    """A folder that is there already, but holds no study."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        super().__init__(
            f'{folder} exists already, holds no study and is not written into: '
            'choose another folder'
        )


class OtherStudyError(BlfDscError):
    """The folder holds the results of another study."""

    def __init__(self, folder: Path, differences: Mapping[str, tuple[object, object]]) -> None:
        self.folder = folder
        self.differences = differences
        lines = ''.join(
            f'\n  - {name}: there {there}, here {here}'
            for name, (there, here) in differences.items()
        )
        super().__init__(
            f'{folder} holds another study, which is neither gone on with nor overwritten: '
            f'choose another folder, or make them equal:{lines}'
        )


class StudyInUseError(BlfDscError):
    """Another process is writing into the folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        super().__init__(f'another monte_carlo is running in {folder}: wait for it, or end it')


class UnreadablePartError(BlfDscError):
    """A file of results that cannot be read."""

    def __init__(self, path: Path, reason: str) -> None:
        self.path = path
        super().__init__(
            f'{path} cannot be read ({reason}): remove it and start the study again, which '
            'computes these runs anew'
        )


class NoResultsError(BlfDscError):
    """There are no results to report or to reproduce."""

    def __init__(self, folder: Path, what: str) -> None:
        self.folder = folder
        super().__init__(f'{folder} has no {what}')


class WorkersLostError(BlfDscError):
    """Workers end again and again, without getting anything done."""

    def __init__(self, times: int, waiting: int, reason: str) -> None:
        self.times = times
        super().__init__(
            f'{times} times in a row all workers were lost before any finished a chunk ({reason}); '
            f'{waiting} chunks are left. Is there enough memory? Start the same command again to '
            'go on: what is done is kept'
        )


class NotReproducedError(BlfDscError):
    """A run computed again differs from its results."""

    def __init__(self, run: int, differences: Mapping[str, tuple[object, object]]) -> None:
        self.run = run
        self.differences = differences
        lines = ''.join(
            f'\n  - {name}: there {there}, here {here}'
            for name, (there, here) in differences.items()
        )
        super().__init__(
            f'run {run} is not what it was: was it computed on another kind of machine, or by '
            f'another version?{lines}'
        )

# SPDX-License-Identifier: Apache-2.0
"""Errors of the package; one `except` of their common base class catches them all."""

_MOST_LINES = 50  # of one message


class BlfDscError(Exception):
    """Base class of all errors that this package raises on purpose; can be pickled."""


class ArgumentTypeError(BlfDscError, TypeError):
    """An argument is of another type than the function takes."""


def check_type(
    name: str, value: object, expected: type | tuple[type, ...], remedy: str
) -> None:
    """Raise ArgumentTypeError, with the remedy, unless an argument is of an expected type."""
    if isinstance(value, expected):
        return
    types = expected if isinstance(expected, tuple) else (expected,)
    wanted = ' or '.join(each.__name__ for each in types)
    raise ArgumentTypeError(
        f'{name}: got {type(value).__name__}, expected {wanted}: {remedy}'
    )


class ConfigurationError(BlfDscError):
    """Invalid configuration; the message lists the problems found, up to 50 of them."""

    def __init__(self, problems: list[str], source: str = '') -> None:
        super().__init__(problems, source)
        self.problems = problems
        self.source = source

    def __str__(self) -> str:
        """Return a line for each problem, below one with their number and source."""
        where = f' in {self.source}' if self.source else ''
        count = 'problem' if len(self.problems) == 1 else 'problems'
        lines = ''.join(f'\n  - {problem}' for problem in self.problems[:_MOST_LINES])
        if len(self.problems) > _MOST_LINES:
            lines += f'\n  - and {len(self.problems) - _MOST_LINES} more'
        return f'{len(self.problems)} {count} with the configuration{where}:{lines}'


class StartError(BlfDscError):
    """The law cannot take over the arm in its present state."""


class TareError(BlfDscError):
    """The external torque cannot be tared now; the message says why."""


class MissingExtraError(BlfDscError):
    """A package from one of the optional extras is not installed."""


class DriveError(BlfDscError):
    """The arm of a `Drive` cannot do what a script wants; the message says why."""


class MotionFailedError(DriveError):
    """A motion was rejected, replaced or given up; the law is still in command."""


class NotInTimeError(DriveError, TimeoutError):
    """Not over after the given time; a motion is braked."""


class LoopEndedError(DriveError):
    """The loop has ended: the law is not in command any more."""

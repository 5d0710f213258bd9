# SPDX-License-Identifier: Apache-2.0
"""The errors a user of the package can meet. One base, so one `except` catches them all."""

from typing import Any


class BlfDscError(Exception):
    """Base of every error this package raises on purpose; it passes between processes."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Message and attributes, whatever the constructor takes."""
        return Exception.__new__, (type(self), *self.args), self.__dict__


class ConfigurationError(BlfDscError):
    """A configuration that cannot be run; the message lists every problem found."""

    def __init__(self, problems: list[str], source: str = '') -> None:
        self.problems = problems
        self.source = source
        where = f' in {source}' if source else ''
        count = 'problem' if len(problems) == 1 else 'problems'
        lines = ''.join(f'\n  - {problem}' for problem in problems)
        super().__init__(f'{len(problems)} {count} with the configuration{where}:{lines}')


class StartError(BlfDscError):
    """The law cannot take the arm over as it moves now."""


class OutsideBarrierError(StartError):
    """The tracking error of a joint is not inside its bound, where the law is not defined."""

    def __init__(self, joint: str, error: float, bound: float) -> None:
        self.joint = joint
        self.error = error
        self.bound = bound
        super().__init__(
            f'joint {joint!r} starts {error:+.6g} rad from the reference, outside its bound of '
            f'{bound:.6g} rad: start closer to the reference, or widen barrier.bound'
        )


class VelocityMismatchError(StartError):
    """A joint differs too much from its reference in velocity: it would leave the bound."""

    def __init__(self, joint: str, difference: float, limit: float) -> None:
        self.joint = joint
        self.difference = difference
        self.limit = limit
        super().__init__(
            f'joint {joint!r} starts {difference:+.6g} rad/s faster than the reference, but only '
            f'{limit:.6g} rad/s can be made up within its bound at limits.acceleration: start with '
            'the velocity of the reference, or enable the approach (approach.enabled)'
        )


class MissingExtraError(BlfDscError):
    """A package of one of the extras is not installed."""

    def __init__(self, module: str, extra: str, purpose: str) -> None:
        self.module = module
        self.extra = extra
        super().__init__(
            f'{purpose} needs {module}, which is not installed: '
            f"pip install 'blf_dsc_controller[{extra}]'"
        )

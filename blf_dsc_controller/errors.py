# SPDX-License-Identifier: Apache-2.0
"""Errors of the package; one `except` of their common base class catches them all."""

from typing import Any


class BlfDscError(Exception):
    """Base class of all errors that this package raises on purpose; can be pickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle message and attributes, whatever the signature of the constructor."""
        return Exception.__new__, (type(self), *self.args), self.__dict__


class ConfigurationError(BlfDscError):
    """Invalid configuration; the message lists every problem found."""

    def __init__(self, problems: list[str], source: str = '') -> None:
        self.problems = problems
        self.source = source
        where = f' in {source}' if source else ''
        count = 'problem' if len(problems) == 1 else 'problems'
        lines = ''.join(f'\n  - {problem}' for problem in problems)
        super().__init__(f'{len(problems)} {count} with the configuration{where}:{lines}')


class StartError(BlfDscError):
    """The law cannot take over the arm in its present state."""


class OutsideBarrierError(StartError):
    """The tracking error of a joint is outside its bound, where the law is undefined."""

    def __init__(self, joint: str, error: float, bound: float) -> None:
        self.joint = joint
        self.error = error
        self.bound = bound
        super().__init__(
            f'joint {joint!r} starts {error:+.6g} rad from the reference, outside its bound of '
            f'{bound:.6g} rad: start closer to the reference, or widen barrier.bound'
        )


class VelocityMismatchError(StartError):
    """The velocity of a joint is so far from the reference that it would leave the bound."""

    def __init__(self, joint: str, difference: float, limit: float) -> None:
        super().__init__(
            f'joint {joint!r} starts {difference:+.6g} rad/s from the velocity of the reference; '
            f'at limits.acceleration {limit:.6g} rad/s can be made up within its bound: start with '
            'the velocity of the reference, or enable the approach (approach.enabled)'
        )


class MissingExtraError(BlfDscError):
    """A package from one of the optional extras is not installed."""

    def __init__(self, module: str, extra: str, purpose: str) -> None:
        super().__init__(
            f'{purpose} needs {module}, which is not installed: '
            f"pip install 'blf_dsc_controller[{extra}]'"
        )

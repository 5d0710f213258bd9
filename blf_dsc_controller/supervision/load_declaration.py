# SPDX-License-Identifier: Apache-2.0
"""Declare an estimated payload to the drives, one step after the other has taken effect.

This is the sequence, whatever reaches the drives: the SDK of a robot (`drive/`) or a ROS
service of its driver (`nodes/`).  Which steps there are is decided by `drive_load`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.tip_load import TipLoad

_EVERY = 20  # states, from one step that is in force to the next


class DeclarationError(BlfDscError):
    """The drives do not accept a load."""


class LawWithLoad(Protocol):
    """What declares its load: a `Guard` or an `ArmController`."""

    @property
    def is_at_rest(self) -> bool:
        """Whether the reference and the arm rest."""

    def load_to_tell(self) -> TipLoad | None:
        """Return the next step; None if there is none."""

    def take_over(self, load: TipLoad) -> None:
        """Subtract the weight of this load from the next state on."""


class LoadDeclaration(ABC):
    """Declares the load of a law in steps; the law takes over each that is in force.

    Attributes:
        problem: why no more loads are declared, or empty.
        in_force: the load that the law has taken over last; None: none.
        states: since the last step was declared or taken over.
    """

    def __init__(self) -> None:
        self.problem = ''
        self.in_force: TipLoad | None = None
        self.states = 0
        self._declared: TipLoad | None = None  # not yet in force

    def follow(self, law: LawWithLoad, *, in_motion: bool) -> None:
        """Before each state: let the law take over a step in force, or declare the next.

        `in_motion`: whether the drives accept a load while the arm moves.
        """
        if self.problem:
            return
        self.states += 1
        try:
            if (declared := self._declared) is not None:
                if self.is_in_force(declared):
                    self.states = 0
                    self.in_force, self._declared = declared, None
                    law.take_over(declared)
            elif self.states >= _EVERY and self.can_declare():
                self.states = 0
                load = law.load_to_tell() if in_motion or law.is_at_rest else None
                if load is not None:
                    self.declare(load)
                    self._declared = load
        except DeclarationError as error:
            self.give_up(str(error))

    def give_up(self, problem: str) -> None:
        """Declare no more loads, for this reason."""
        self.problem = problem

    def can_declare(self) -> bool:
        """Whether the drives accept a load now."""
        return True

    @abstractmethod
    def declare(self, load: TipLoad) -> None:
        """Begin to send a load in the frame of the tip to the drives, without waiting.

        Raises:
            DeclarationError: it cannot be sent.
        """

    @abstractmethod
    def is_in_force(self, load: TipLoad) -> bool:
        """Whether the drives add the weight of this load, which was declared last.

        Raises:
            DeclarationError: they have refused it, or do not answer.
        """

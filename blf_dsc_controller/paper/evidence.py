# SPDX-License-Identifier: Apache-2.0
"""What a claim of the paper is judged by, and how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from blf_dsc_controller.paper.metrics import Courses, Metrics
from blf_dsc_controller.paper.runs import Outcome
from blf_dsc_controller.paper.sweeps import SWEEPS, case_name

HOLDS = 'holds'
ONLY_IF = 'holds only if'
FAILS = 'does not hold'

_SWEEPS = {sweep.name: sweep for sweep in SWEEPS}


@dataclass(frozen=True)
class Claim:
    """One row of the table; `condition` goes on from the verdict `holds only if`."""

    where: str
    says: str
    measured: str
    verdict: str
    condition: str
    command: str

    @property
    def judgement(self) -> str:
        """The verdict in full."""
        return f'{self.verdict} {self.condition}' if self.verdict == ONLY_IF else self.verdict


class Evidence:
    """The runs, as the claims ask for them."""

    def __init__(self, outcomes: Mapping[str, Outcome]) -> None:
        self._outcomes = outcomes

    def metrics(self, name: str) -> Metrics:
        """Numbers of a case."""
        found = self._outcomes[name].metrics
        assert found is not None, name  # noqa: S101 - the side-by-side cases can be run
        return found

    def courses(self, name: str) -> Courses:
        """Courses of a case that were kept."""
        found = self._outcomes[name].courses
        assert found is not None, name  # noqa: S101
        return found

    def held(self, sweep: str, law: str) -> list[float]:
        """Values of a sweep at which the law keeps its bound."""
        found = []
        for value in _SWEEPS[sweep].values:
            metrics = self._outcomes[case_name(sweep, law, value)].metrics
            if metrics is not None and metrics.held:
                found.append(value)
        return found


def verdict(*truths: bool) -> str:
    """`holds` where all of the runs agree, `does not hold` where none does."""
    return HOLDS if all(truths) else ONLY_IF if any(truths) else FAILS

# SPDX-License-Identifier: Apache-2.0
"""What a study can be told beside its closed loop: the section `monte_carlo` of its file."""

from __future__ import annotations

from dataclasses import dataclass

from blf_dsc_controller.configuration.schema import parameter

_ONE_STUDY = 'a study is one configuration from its first run to its last'


@dataclass(frozen=True)
class MonteCarloConfig:
    """How many runs, and what is measured of each."""

    runs: int = parameter(
        1000, 'closed loops to run', at_least=1, at_most=100_000_000, read_only=_ONE_STUDY
    )
    seed: int = parameter(
        0,
        'run i is determined by this seed and i alone',
        at_least=0,
        read_only=_ONE_STUDY,
    )
    settled_after: float = parameter(
        0.0,
        'time from which on the rms error is taken: leave the learning its window',
        unit='s',
        at_least=0.0,
        read_only=_ONE_STUDY,
    )
    moments: tuple[float, ...] = parameter(
        (),
        'times at which the parameter error is kept, beside the end',
        unit='s',
        at_least=0.0,
        may_be_empty=True,
        read_only=_ONE_STUDY,
    )

    def duration_problems(self, duration: float) -> list[str]:
        """Whether all that is measured comes to pass within the duration of a run [s]."""
        if duration == 0.0:
            return ['sim_plant.duration: got 0 s, but every run must end: give its time']
        problems = [
            f'moments: got {moment:g} s at entry {entry}, but a run ends at {duration:g} s'
            for entry, moment in enumerate(self.moments, 1)
            if moment > duration
        ]
        if self.settled_after >= duration:
            problems.append(
                f'settled_after: got {self.settled_after:g} s, but a run ends at {duration:g} s'
            )
        repeated = sorted({moment for moment in self.moments if self.moments.count(moment) > 1})
        return problems + [f'moments: {moment:g} s is there more than once' for moment in repeated]

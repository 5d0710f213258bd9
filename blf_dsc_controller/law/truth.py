# SPDX-License-Identifier: Apache-2.0
"""True parameters and disturbance of a simulated arm, for the terms of (29) and the law (16).

tau_dist(t) = constant + amplitude sin(frequency t + phase)                         [N m]
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array
from blf_dsc_controller.numerics.elementary import sin


class Settings(NamedTuple):
    """The true parameters and disturbance; zeros where they are unknown."""

    known: int  # 1: they are, for (29)
    feed_forward: int  # 1: the disturbance is fed forward
    parameters: Annotated[Array, 'p']
    # constant, then amplitude, frequency, phase
    disturbance: Annotated[Array, 4, 'n']


class Work(NamedTuple):
    """Values of one sample."""

    disturbance: Annotated[Array, 'n']  # tau_dist, N m


@inner
def update_disturbance(settings: Settings, work: Work, t: float) -> None:
    """Compute the known disturbance (n,) [N m] at time t [s]."""
    if settings.known == 0 and settings.feed_forward == 0:
        return
    d = settings.disturbance
    for i in range(work.disturbance.size):
        work.disturbance[i] = d[0, i] + d[1, i] * sin(d[2, i] * t + d[3, i])

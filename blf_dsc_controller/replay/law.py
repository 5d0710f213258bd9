# SPDX-License-Identifier: Apache-2.0
"""The controller on recorded states, sample by sample as the node runs it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.law.factory import begin, controller_of
from blf_dsc_controller.law.sample import Sample, sample_of
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.replay.states import States
from blf_dsc_controller.run import Floats
from blf_dsc_controller.supervision.retuning import transfer
from blf_dsc_controller.supervision.velocity import Velocity

_NANO = 1e-9


@dataclass(frozen=True)
class Change:
    """A configuration that came into force.

    Attributes:
        stamp: of the last state that had come by then [ns].
        told: when the recorder heard of it [ns].
        config: from then on.
    """

    stamp: int
    told: int
    config: ControllerConfig


@dataclass(frozen=True)
class Replayed:
    """What the controller tells of N states.

    Attributes:
        config: with which it began.
        rows: of `core.sample` (N, s).
        told: the columns of `rows` by name; each is (N, its length).
        settings: of the law at the end.
    """

    config: ControllerConfig
    rows: Floats
    told: Sample
    settings: Settings

    def sample(self, row: int) -> Sample:
        """Names for one row of `rows`."""
        return sample_of(self.rows[row], self.settings)


def run_law(config: ControllerConfig, states: States, changes: Sequence[Change] = ()) -> Replayed:
    """Run a configuration over recorded states; the arm does not feel its torques.

    Args:
        config: in force at the first state.
        states: to be answered.
        changes: of the configuration, in turn.

    Raises:
        OutsideBarrierError: the first state is outside the bound, and there is to be no approach.
        MotionError: there is no approach within the limits.
    """
    controller = controller_of(config)
    settings = controller.settings
    rows = np.empty((states.stamp.size, controller.sample_vector.size))
    stamps = states.stamp.tolist()
    last = stamps[0] - config.sample_time_ns if stamps else 0
    waiting = list(changes)
    velocity = Velocity(config.safety.velocity, settings.n)
    measurement = states.measurement.copy()
    n = settings.n
    for k, stamp in enumerate(stamps):
        now = measurement[k]
        velocity.replace(stamp, now[:n], now[n : 2 * n])
        if k == 0:
            begin(controller, config, now[:n], now[n : 2 * n])
        while waiting and waiting[0].stamp < stamp:
            t = (last - stamps[0]) * _NANO
            transfer(controller, waiting.pop(0).config, t, measurement[k - 1])
        controller.update((stamp - stamps[0]) * _NANO, (stamp - last) * _NANO, now)
        rows[k] = controller.sample_vector
        last = stamp
    return replayed_of(config, rows, settings)


def replayed_of(config: ControllerConfig, rows: Floats, settings: Settings) -> Replayed:
    """Give the columns of `rows` their names: their places are found on a row of indices."""
    places = sample_of(np.arange(rows.shape[1], dtype=np.float64), settings)
    told = Sample(*(rows[:, part.astype(np.intp)] for part in places))
    return Replayed(config, rows, told, settings)

# SPDX-License-Identifier: Apache-2.0
"""The slow topic `~/monitor`: how far the guarantees of the law hold, a few times a second.

Where the truth is known: the Lyapunov function (29) term by term, and the bound (32) on it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blf_dsc_controller.law.lyapunov import ExponentialBound
from blf_dsc_controller.law.settings import Settings
from blf_dsc_controller.law.state import Sample
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.topics import DISTANCE, LAMBDA_MIN, LATCHED, LYAPUNOV, RATIO

LYAPUNOV_TERMS = tuple(
    LYAPUNOV + term for term in ('barrier', 'velocity', 'parameters', 'disturbance')
)
LYAPUNOV_BOUND = LYAPUNOV + 'bound'


class Monitor:
    """Builds the messages of `~/monitor`; `estimates` are the names of theta^ (m,)."""

    def __init__(self, joints: Sequence[str], estimates: Sequence[str], settings: Settings) -> None:
        names = [what + joint for what in (RATIO, DISTANCE) for joint in joints]
        names += [*estimates, LAMBDA_MIN, LATCHED]
        self._ceiling = None
        if settings.truth_known == 1:
            names += [*LYAPUNOV_TERMS, LYAPUNOV_BOUND]
            self._ceiling = ExponentialBound(settings)
        self._encoder = JointStateEncoder(names, ('position',))
        self._start: int | None = None

    def message(
        self, stamp: int, sample: Sample, ratio: np.ndarray, bound: np.ndarray
    ) -> tuple[topics.Topic, bytes]:
        """Message of a telemetry sample: largest |xi1| / k_c so far, present k_c (n,) [rad]."""
        distance = bound - np.abs(sample.xi1)
        values = [*ratio, *distance, *sample.estimate, sample.lambda_min[0], sample.latched[0]]
        if self._ceiling is not None:
            self._start = stamp if self._start is None else self._start
            V = float(sample.lyapunov.sum())
            t = (stamp - self._start) * 1e-9
            values += [*sample.lyapunov, self._ceiling.at(t, V, bool(sample.latched[0]))]
        return topics.MONITOR, self._encoder.encode(stamp, values)

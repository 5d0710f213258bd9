# SPDX-License-Identifier: Apache-2.0
"""How the estimated parameters of a run compare with the true ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.messages.names import BIAS, COMPUTE_TIME, DISTURBANCE, LAMBDA_MIN, LATCHED
from blf_dsc_controller.run import Floats, Run


@dataclass(frozen=True)
class Estimation:
    """Estimates of p model parameters over m samples of the learning."""

    names: tuple[str, ...]
    time: Floats  # (m,) s since the first sample of the run
    estimate: Floats  # (m, p)
    true: Floats | None  # (m, p), if the bag tells

    @classmethod
    def of(cls, run: Run) -> Estimation | None:
        """Take it from a run, None if nothing was learned there.

        The model parameters are those of which the true values are told; if none are, all that is
        estimated beside disturbances.
        """
        if run.learning is None:
            return None
        names = tuple(name for name in run.learning.names if _is_parameter(name))
        told = () if run.truth is None else tuple(n for n in names if n in run.truth.names)
        true = None
        if run.truth is not None and told:
            columns = [run.truth.names.index(name) for name in told]
            true = run.truth.held(run.learning.stamp)[:, columns]
        chosen = told or names
        return cls(chosen, run.time_of(run.learning.stamp), run.learning.select(chosen), true)

    @property
    def relative_error(self) -> Floats | None:
        """Norm of the estimates' error over the norm of the true values, (m,)."""
        if self.true is None:
            return None
        error = np.linalg.norm(self.estimate - self.true, axis=1)
        return np.asarray(error / np.linalg.norm(self.true, axis=1))


def latch_time(run: Run) -> float | None:
    """Time at which learning began [s], None if it never did or the bag does not tell."""
    if run.learning is None or LATCHED not in run.learning.names:
        return None
    latched = np.flatnonzero(run.learning.column(LATCHED) > 0.5)
    return float(run.time_of(run.learning.stamp)[latched[0]]) if latched.size else None


def _is_parameter(name: str) -> bool:
    return name not in (LAMBDA_MIN, LATCHED, COMPUTE_TIME) and not name.startswith(
        (DISTURBANCE, BIAS)
    )

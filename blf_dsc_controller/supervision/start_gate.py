# SPDX-License-Identifier: Apache-2.0
"""The gate before the start: the law gets no state until the sender's rate is known."""

from __future__ import annotations

from enum import Enum

import numpy as np

from blf_dsc_controller.supervision.state_check import rate_mismatch

_INTERVALS = 10  # between states, measured ...
_RATE_RATIO = 1.5  # ... which may differ from the sample time by this factor ...
# ... at these quantiles: a busy computer loses states between two others
_TYPICAL = 0.2, 0.5
# checks without a newer state (0.2 s), after which a sender waits, or has paused
_PATIENT_STATES = 25


class GateState(Enum):
    """What the gate does with a state."""

    MEASURING = 'measuring'  # holds it back: the rate is not known yet
    OPEN = 'open'  # the rate is that of the sample time
    WAITED_FOR = 'waited for'  # open: the sender waits for a torque, as a plant in lock-step does
    REFUSED = 'refused'  # closed until the next restart: another rate


class StartGate:
    """Measures the rate of the first states by their stamps.

    At another rate than that of the sample time the gains are wrong, up to instability.
    Only a sender that sends a single state, and no newer one for 0.2 s, may start
    unmeasured: it waits for a torque.  A pause after several states proves nothing: the
    measurement begins anew.

    Attributes:
        state: what the gate does.
        problem: why it refuses; else empty.
    """

    def __init__(self, sample_time: float) -> None:
        """`sample_time` is T [s]."""
        self._sample_time = sample_time
        self.restart()

    def restart(self) -> None:
        """Measure anew."""
        self.state = GateState.MEASURING
        self.problem = ''
        self._stamps: list[int] = []
        self._checks = 0

    @property
    def count(self) -> int:
        """Number of states of the present measurement."""
        return len(self._stamps)

    def take(self, stamp: int) -> GateState:
        """Return what to do with a state of a stamp [ns]."""
        is_new = not self._stamps or stamp > self._stamps[-1]
        if self.state is not GateState.MEASURING or not is_new:
            return self.state
        self._stamps.append(stamp)
        self._checks = 0
        if len(self._stamps) > _INTERVALS:
            self._decide()
        return self.state

    def _decide(self) -> None:
        """Open or refuse by the measured intervals: another rate by a factor of 1.5 is refused."""
        often, period = 1e-9 * np.quantile(np.diff(self._stamps), _TYPICAL)
        T = self._sample_time
        self.state = GateState.OPEN
        if period <= T / _RATE_RATIO or often >= T * _RATE_RATIO:
            self.state = GateState.REFUSED
            self.problem = rate_mismatch(float(period), T)

    def poll(self) -> bool:
        """Return whether the sender has turned out to wait; call it every 8 ms."""
        if self.state is not GateState.MEASURING or not self._stamps:
            return False
        self._checks += 1
        if self._checks < _PATIENT_STATES:
            return False
        if len(self._stamps) > 1:
            self.restart()
            return False
        self.state = GateState.WAITED_FOR
        return True

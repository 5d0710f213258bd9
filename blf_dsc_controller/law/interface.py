# SPDX-License-Identifier: Apache-2.0
"""The contract between the loop and a control law, and the law that a Python file defines.

A law is a `NamedTuple` of its gains with the two methods of `Law`, which are compiled
into every loop: the node, the simulation, a replay, and the studies.  In each sample,
the loop

    1. reads the measurement, evaluates the reference, and computes the error and its bound,
    2. asks the law for the torque (`compute_demand`),
    3. cuts it at the limits of level and rate, less what the drives add (`torque.saturate`),
    4. and, once it is sent, lets the law advance its memory (`finish`).

Everything that a law keeps from one sample to the next is in `State`, so that a
controller is saved, restored, replayed and compared as one vector.  A law of a file
keeps its values in `state.memory`, whose parts `MEMORY` of the file names; they are
zero at the start.  One that calls `learning.observe` and `learning.adapt` says so by
`learns = True`: its estimate is that of latched windows, so that contacts can be detected.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from blf_dsc_controller.law.state import Settings, Signals, State


class Law(Protocol):
    """A control law: a `NamedTuple` of its gains.  Its methods allocate nothing."""

    @property
    def has_barrier(self) -> bool:
        """Whether it keeps the error inside the bound: then larger errors stop the arm."""

    def compute_demand(
        self, settings: Settings, state: State, signals: Signals, t: float, dt: float
    ) -> None:
        """Write the torque before saturation to `signals.demand` (n,) [N m].

        `signals` has the measurement q, dq, the reference qr, dqr, ddqr, the error xi1
        = q - qr and its bound; `settings` the model with P^(0), and what is known of
        the joints.  t [s] is the time since the start, dt [s] since the last sample.
        """

    def finish(
        self,
        settings: Settings,
        state: State,
        signals: Signals,
        dt: float,
        saturated: bool,
    ) -> None:
        """Advance `state` by `dt` [s], once the torque is sent; `saturated`: it was cut."""

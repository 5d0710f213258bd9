# SPDX-License-Identifier: Apache-2.0
"""Snapshots of a run of any length, to be replayed."""

from __future__ import annotations

from blf_dsc_controller.view.snapshot import Snapshot

KEPT = 2000
"""Snapshots of a run that are kept, at most."""


class ThinnedRun:
    """Snapshots of a whole run, at most `KEPT`, evenly spaced.

    Attributes:
        snapshots: those that are kept.
        taken: number of all.
    """

    def __init__(self) -> None:
        self.snapshots: list[Snapshot] = []
        self.taken = 0
        self._stride = 1  # from one that is kept to the next

    def take(self, snapshot: Snapshot) -> None:
        """Keep every `_stride`-th snapshot; thin them out if there are too many."""
        if self.taken % self._stride == 0:
            self.snapshots.append(snapshot)
        self.taken += 1
        if len(self.snapshots) > KEPT:
            del self.snapshots[1::2]
            self._stride *= 2

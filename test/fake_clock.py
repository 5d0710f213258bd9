# SPDX-License-Identifier: Apache-2.0
"""A clock for nodes that only the test advances, however slow the machine is."""

from __future__ import annotations


class FakeClock:
    """Steady clock [ns]."""

    def __init__(self):
        self.now = 10**9

    def __call__(self):
        return self.now

    def advance(self, seconds):
        self.now += round(1e9 * seconds)

# SPDX-License-Identifier: Apache-2.0
"""A pickle that somebody else has planted."""

from __future__ import annotations

import os


class Planted:
    """A pickle that leaves a mark when it is read."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (self.mark,)

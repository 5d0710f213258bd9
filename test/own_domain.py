# SPDX-License-Identifier: Apache-2.0
"""A ROS domain for each context of a test process, for nodes leave the graph slowly."""

from __future__ import annotations

import itertools
import os

# By twos: the two workers of a run have domains of different parity (conftest.py).
_COUNT = itertools.count(int(os.environ.get('ROS_DOMAIN_ID', '1')) - 1, 2)


def own_domain() -> int:
    """Domain from 1 to 100 that this process has not used lately."""
    return 1 + next(_COUNT) % 100

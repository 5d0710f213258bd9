# SPDX-License-Identifier: Apache-2.0
"""Why disturbance columns are not estimated, as `/diagnostics` in a bag tells it.

The controller says it there; the offline run writes the same message.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.messages.names import COMPUTE_TIME, REJECTED
from blf_dsc_controller.messages.topics import DIAGNOSTICS
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.run import Series


def refused(path: Path, learning: Series | None, namespace: str = '') -> dict[str, str]:
    """Columns that the learning tells as NaN at its end, and why; empty words if it is not told.

    Args:
        path: of the bag.
        learning: in it.
        namespace: of the robot to look at, if the bag holds several.

    Raises:
        UnreadableBagError: the bag is damaged.
    """
    if learning is None:
        return {}
    last = dict(zip(learning.names, learning.values[-1], strict=True))
    columns = [name for name, value in last.items() if name != COMPUTE_TIME and np.isnan(value)]
    reasons = _reasons(path, namespace.strip('/')) if columns else {}
    return {column: reasons.get(column, '') for column in columns}


def _reasons(path: Path, namespace: str) -> dict[str, str]:
    """Reasons by column, from the last message that holds any."""
    with open_bag(path) as bag:
        if (DIAGNOSTICS.resolved, DIAGNOSTICS.type) not in bag.held:
            return {}
        for _, _, raw in reversed(list(bag.messages({DIAGNOSTICS.resolved}))):
            message: Any = typestore().deserialize_cdr(raw, DIAGNOSTICS.type)
            found = {
                pair.key.removeprefix(REJECTED): pair.value
                for status in message.status
                if status.name.startswith(namespace)
                for pair in status.values
                if pair.key.startswith(REJECTED)
            }
            if found:
                return found
    return {}

# SPDX-License-Identifier: Apache-2.0
"""Why disturbance columns are not estimated, as `/diagnostics` in a bag tells it.

The controller says it there; the offline run writes the same message.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from blf_dsc_controller.bags.sources import open_bag
from blf_dsc_controller.law.rejected_columns import Refusal
from blf_dsc_controller.messages.names import COMPUTE_TIME, REFUSED
from blf_dsc_controller.messages.topics import CONTROLLER, DIAGNOSTICS
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.run import Series

_WARN = 1
_NANOSECONDS = 1_000_000_000


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


def diagnosis(stamp: int, refusals: Sequence[Refusal]) -> bytes:
    """The message by which the controller tells of its refusals at a time [ns]."""
    types = typestore().types
    words = {f'{REFUSED}{one.column}': f'{one}' for one in refusals}
    status = types['diagnostic_msgs/msg/DiagnosticStatus'](
        level=_WARN,
        name=f'{CONTROLLER}/learning',
        message=f'not estimated: {", ".join(one.column for one in refusals)}',
        hardware_id='',
        values=[types['diagnostic_msgs/msg/KeyValue'](key=k, value=v) for k, v in words.items()],
    )
    seconds, nanoseconds = divmod(stamp, _NANOSECONDS)
    time = types['builtin_interfaces/msg/Time'](sec=seconds, nanosec=nanoseconds)
    header = types['std_msgs/msg/Header'](stamp=time, frame_id='')
    message = types[DIAGNOSTICS.type](header=header, status=[status])
    return bytes(typestore().serialize_cdr(message, DIAGNOSTICS.type))


def _reasons(path: Path, namespace: str) -> dict[str, str]:
    """Reasons by column, from the last message that holds any."""
    with open_bag(path) as bag:
        if (DIAGNOSTICS.resolved, DIAGNOSTICS.type) not in bag.held:
            return {}
        for _, _, raw in reversed(list(bag.messages({DIAGNOSTICS.resolved}))):
            message: Any = typestore().deserialize_cdr(raw, DIAGNOSTICS.type)
            found = {
                pair.key.removeprefix(REFUSED): pair.value
                for status in message.status
                if status.name.startswith(namespace)
                for pair in status.values
                if pair.key.startswith(REFUSED)
            }
            if found:
                return found
    return {}

# SPDX-License-Identifier: Apache-2.0
"""The log of a controller: that of a node, or one of a loop without ROS."""

from __future__ import annotations

from typing import Protocol


class Log(Protocol):
    """Takes texts by their severity, as the logger of a node does."""

    def info(self, message: str) -> object:
        """Tell what happens."""

    def warning(self, message: str, *, throttle_duration_sec: float = 0.0) -> object:
        """Warn; with a duration [s], a caller's warnings within it are dropped."""

    def error(self, message: str) -> object:
        """Tell what went wrong."""

# SPDX-License-Identifier: Apache-2.0
"""Animated pictures of the documentation."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from PIL import Image

RATE = 8.0  # frames per second


def save(out: Path, frames: Iterable[Image.Image]) -> None:
    """Write frames, `RATE` in a second, as an endless animation."""
    first, *others = frames
    first.save(
        out,
        save_all=True,
        append_images=others,
        duration=round(1000.0 / RATE),
        loop=0,
        quality=60,
        method=6,
    )

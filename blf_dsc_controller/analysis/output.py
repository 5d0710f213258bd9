# SPDX-License-Identifier: Apache-2.0
"""Output of numbers: a table for the terminal, and JSON for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from blf_dsc_controller.writing import write_text


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Return a table for the terminal: first column flush left, others right."""
    first, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    return '\n'.join(
        '  '.join([name.ljust(first), *map(str.rjust, values, widths)])
        for name, *values in rows
    )


def write_json(numbers: Any, path: Path) -> None:
    """Write metrics, or other data in dictionaries and lists, as JSON."""
    write_text(path, json.dumps(plain(numbers), indent=2, allow_nan=False) + '\n')


def plain(value: Any) -> Any:
    """Convert to lists and dictionaries for JSON; NaN and infinity become None."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value

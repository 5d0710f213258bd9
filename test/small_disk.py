# SPDX-License-Identifier: Apache-2.0
"""A disk of a few megabytes for the duration of a test."""

from __future__ import annotations

import subprocess
from contextlib import contextmanager

import pytest


@contextmanager
def small_disk(path, megabytes):
    """Mount a disk of this size at a new folder; skip the test if that is not allowed."""
    path.mkdir()
    command = ['mount', '-t', 'tmpfs', '-o', f'size={megabytes}m', 'tmpfs', str(path)]
    try:
        mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip('there is no command mount here')
    if mounted.returncode != 0:
        pytest.skip(f'a small disk cannot be mounted here (root may): {mounted.stderr.strip()}')
    try:
        yield path
    finally:
        subprocess.run(['umount', '-l', str(path)], check=False)  # noqa: S607

# SPDX-License-Identifier: Apache-2.0
"""Machine code is cached by the contents of every file that a kernel lives in."""

from __future__ import annotations

import re
from pathlib import Path

import blf_dsc_controller
import sim_plant
from blf_dsc_controller.compiled.jit import ground_floor_sources


def test_every_file_with_a_kernel_is_in_the_digest_of_the_cache():
    """Or an edit there would run on stale machine code."""
    packages = (
        Path(package.__file__).resolve().parent for package in (blf_dsc_controller, sim_plant)
    )
    with_kernels = {
        path
        for package in packages
        for path in package.rglob('*.py')
        if re.search(r'^@(kernel|inner)$', path.read_text(encoding='utf-8'), re.MULTILINE)
    }
    assert with_kernels
    assert with_kernels <= set(ground_floor_sources())

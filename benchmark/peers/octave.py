# SPDX-License-Identifier: Apache-2.0
"""The closed loop in Octave, as one would write it for MATLAB."""

from __future__ import annotations

import subprocess
from pathlib import Path

_SCRIPT = Path(__file__).with_name('closed_loop.m')


def octave_loop(duration: float) -> int:
    """Run `closed_loop.m` for `duration` [s] and return the number of samples.

    Raises:
        subprocess.CalledProcessError: Octave ended with an error.
    """
    command = ['octave', '--no-gui', '--quiet', str(_SCRIPT), str(duration)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return int(output.split()[-1])

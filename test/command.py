# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc run` in its own process, as a user starts it, and the processes it starts."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

PATIENCE = 180.0  # s, until a test gives up on what should take seconds
COMPILED = 300.0  # s, likewise with kernels, which a first run compiles in two minutes
# For real time on a machine too slow for it, where a controller would rightly stop.
PATIENT = """blf_dsc_controller:
  ros__parameters:
    safety:
      oscillation: ignore
      state_timeout: 1000.0
      watchdog: 'off'
      error_ratio: 0.0
      saturation_time: 1000.0
"""
OLDER = {
    'GLIBC_TUNABLES': 'glibc.cpu.hwcaps=-FMA,-AVX2,-FMA4,-AVX2_Usable,-FMA_Usable',
    'OPENBLAS_CORETYPE': 'Nehalem',
    'NPY_DISABLE_CPU_FEATURES': 'AVX2 FMA3 AVX512F AVX512_SKX X86_V3 X86_V4',
}
"""Variables by which C library, BLAS and numpy take this processor for an older one."""
COMMAND = (sys.executable, '-m', 'blf_dsc_controller', 'run')
_PLACES = str(Path(__file__).with_name('no_pictures')), os.environ.get('PYTHONPATH')
NO_PICTURES = {'PYTHONPATH': os.pathsep.join(filter(None, _PLACES))}
"""Variable by which commands write empty pictures."""


def own_address():
    """Return an address of this computer, drawn from 16 million: no other test is at it."""
    return f'127.{".".join(str(1 + byte % 254) for byte in os.urandom(3))}'


def closed_loop(*arguments, pictures=False):
    """Run the command to completion."""
    environment = os.environ | ({} if pictures else NO_PICTURES)
    return finished(*COMMAND, *arguments, env=environment)


def finished(*command, **options):
    """Run any command to completion."""
    return subprocess.run(
        [*map(str, command)],
        capture_output=True,
        text=True,
        timeout=COMPILED,
        check=False,
        **options,
    )


def wait_for(condition, patience=PATIENCE):
    deadline = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < deadline, 'still waiting'
        time.sleep(0.02)


def children_of(pid):
    """Return the ids of the processes that a process has started."""
    text = Path(f'/proc/{pid}/task/{pid}/children').read_text()
    return [int(child) for child in text.split()]


def child_of(pid, module):
    """Return the id of the one that runs a module."""
    children = children_of(pid)
    (found,) = (c for c in children if module in Path(f'/proc/{c}/cmdline').read_text())
    return found


class Running:
    """An endless run, until the test ends it."""

    def __init__(self, out):
        self.out = out
        self.process = subprocess.Popen(
            [*COMMAND, '--mode', 'lockstep', '--duration', '100000', '--out', str(out)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | NO_PICTURES,
        )
        bag = out / 'bag' / 'bag_0.mcap'
        # 500 kB: some 200 samples have been recorded, each about 2 kB with all topics.
        wait_for(lambda: bag.exists() and bag.stat().st_size > 500_000, COMPILED)
        self.children = children_of(self.process.pid)
        assert len(self.children) == 2  # recorder and loop

    def child(self, module):
        """Return the process id of the child that runs a module."""
        return child_of(self.process.pid, module)

    def end(self):
        """Wait for the end; return exit code, output and errors."""
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err

    def wait_for_children(self):
        """Wait until all nodes have exited."""
        wait_for(lambda: not any(_is_alive(child) for child in self.children))

    def close(self):
        """Kill all processes that are left."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()
        for child in self.children:
            if _is_alive(child):
                os.kill(child, 9)


def _is_alive(pid):
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != 'Z'

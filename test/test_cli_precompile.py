# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc precompile` leaves nothing for the nodes to compile."""

from __future__ import annotations

import subprocess
import sys

import numba
import pytest

from blf_dsc_controller.cli.main import main

SHOW = """
import sys
from blf_dsc_controller.cli import run as precompile
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.law.controller import update
from blf_dsc_controller.reference.terms import _sample
from sim_plant.kernels import KERNELS

config = load_loop('recommended')
precompile._compile_law(config.controller)
precompile._compile_plant(config.plant)
for kernel in (update, _sample, *KERNELS):
    print(kernel.__name__, len(kernel.signatures))
"""


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
def test_every_kernel_called_by_a_node_is_compiled():
    run = subprocess.run([sys.executable, '-c', SHOW], capture_output=True, text=True, check=True)
    kernels = dict(line.split() for line in run.stdout.splitlines())
    assert len(kernels) == 5
    assert all(int(count) >= 1 for count in kernels.values()), kernels


def test_command_reports_that_kernels_are_compiled(capsys):
    assert main(['precompile', '--config', 'recommended']) == 0
    assert 'recommended: the kernels are compiled' in capsys.readouterr().out

# SPDX-License-Identifier: Apache-2.0
"""The public interface: documented names, lazy imports, errors that can be pickled."""

from __future__ import annotations

import copy
import subprocess
import sys

import pytest

import blf_dsc_controller as blf
from blf_dsc_controller.errors import ConfigurationError, MissingExtraError, OutsideBarrierError


def run_python(*arguments, folder):
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def test_every_public_name_is_documented():
    for name in blf.__all__:
        assert getattr(blf, name).__doc__, name


def test_importing_the_package_does_not_import_numpy(tmp_path):
    program = 'import sys, blf_dsc_controller; print("numpy" in sys.modules)'
    assert run_python('-c', program, folder=tmp_path).strip() == 'False'


@pytest.mark.parametrize(
    'error',
    [
        ConfigurationError(['a: got 1', 'b: got 2'], 'my.yaml'),
        OutsideBarrierError('joint1', 0.1, 0.002),
        MissingExtraError('dask', 'dask', 'a cluster'),
    ],
)
def test_errors_can_be_passed_between_processes(error):
    copied = copy.copy(error)  # as pickle does
    assert type(copied) is type(error)
    assert str(copied) == str(error)
    assert vars(copied) == vars(error)

# SPDX-License-Identifier: Apache-2.0
"""ROS environment of the test process and its child processes; profile of hypothesis.

Both are set here, before any test module imports rclpy. The environment has a domain in
which nobody else is, discovery on this machine only, and a log folder that is removed
at the end.
"""

import gc
import os
import shutil
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import cpu_times
import hypothesis
import node_garbage
import pytest
from cpu_times import (  # noqa: F401 - hooks
    pytest_runtest_makereport,
    pytest_runtest_protocol,
    pytest_terminal_summary,
)

# The time that an example takes depends on the machine, not on the package. Each run
# has the same examples; `make test-nightly` (NIGHTLY=1) draws others, and more.
hypothesis.settings.register_profile(
    'suite', deadline=None, derandomize='NIGHTLY' not in os.environ
)
hypothesis.settings.load_profile('suite')

# The folder of the tables, which is not installed.
sys.path.append(str(Path(__file__).parents[1]))

_LOG_FOLDER = tempfile.mkdtemp(prefix='blf_dsc_controller_test_log_')

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')  # numpy is not imported yet
os.environ['ROS_LOG_DIR'] = os.environ['DASK_TEMPORARY_DIRECTORY'] = _LOG_FOLDER
if find_spec('rclpy'):  # some tests run without ROS
    from own_domain import avoid_domain_of_shell, own_domain

    from blf_dsc_controller.cli.isolation import localhost_environment

    avoid_domain_of_shell()
    os.environ.update({'ROS_DOMAIN_ID': str(own_domain()), **localhost_environment()})

# The files that take longest start first, by their CPU times (`--cpu`), so that no worker is left
# with one of them at the end.
_FIRST = (
    'test_drive_franka',
    'test_commissioning',
    'test_identify',
    'test_closed_loop',
    'test_examples',
    'test_compiled',
    'test_presets',
    'test_view',
    'test_mujoco_plant',
    'test_drive_damiao',
    'test_drive_loop',
    'test_bag_recorder',
    'test_studies',
    'test_pages',
    'test_monte_carlo',
    'test_watchdog',
    'test_nodes',
    'test_contact',
    'test_replay',
)


@pytest.fixture
def ros():
    """Provide nodes of the package in this process."""
    from ros_rig import RosRig

    rig = RosRig()
    yield rig
    rig.close()


@pytest.fixture
def bare_node():
    """Return a function that makes a node of rclpy, with a parameter file or with overrides."""
    pytest.importorskip('rclpy')
    from rclpy.context import Context
    from rclpy.node import Node
    from rclpy.parameter import Parameter

    node_garbage.begin()
    context, nodes = Context(), []
    context.init()

    def make(name, path=None, overrides=None):
        space, _, base = name.rpartition('/')
        node = Node(
            base,
            namespace=space,
            context=context,
            cli_args=['--ros-args', '--params-file', str(path)] if path else None,
            parameter_overrides=[
                Parameter(k, value=v) for k, v in (overrides or {}).items()
            ],
            enable_rosout=False,
        )
        nodes.append(node)
        return node

    yield make
    while nodes:
        nodes.pop().destroy_node()
    context.shutdown()
    node_garbage.end()


@pytest.fixture
def blank_pictures(monkeypatch):
    """Write empty pictures where no test looks at them: drawing takes a second for each run."""
    from blf_dsc_controller.analysis import figures

    monkeypatch.setattr(figures, 'draw_panels', lambda path, *_, **__: path.touch())
    monkeypatch.setattr(figures.Picture, 'save', lambda _, path: path.touch())


def pytest_addoption(parser):
    cpu_times.pytest_addoption(parser)
    parser.addoption(
        '--regenerate-refusals',
        action='store_true',
        help='write into test/refusals what is said now, where it is something else',
    )


def pytest_collection_finish():
    """Spare garbage collections what was loaded by now: 0.3 s of each whole one."""
    gc.collect()
    gc.freeze()


def pytest_collection_modifyitems(items):
    def place(item):
        stem = item.path.stem
        found = (k for k, name in enumerate(_FIRST) if stem.startswith(name))
        return next(found, len(_FIRST))

    items.sort(key=place)


def pytest_unconfigure():
    """Remove the logs here, as workers of pytest-xdist run no atexit handlers."""
    shutil.rmtree(_LOG_FOLDER, ignore_errors=True)

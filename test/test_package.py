# SPDX-License-Identifier: Apache-2.0
"""The package as pip, colcon, ROS and Python see it: what is installed, and that it agrees."""

from __future__ import annotations

import ast
import configparser
import pickle
import re
import shutil
import subprocess
import sys
import tarfile
import xml.etree.ElementTree as ET
import zipfile
from importlib.metadata import PathDistribution
from pathlib import Path

import pytest

import blf_dsc_controller

ROOT = Path(__file__).resolve().parents[1]
NAME = 'blf_dsc_controller'
PACKAGES = (NAME, 'sim_plant')
URL = 'https://example.org/blf_dsc_controller'
NODES = {
    'sim_plant',
    'blf_dsc_controller',
    'bag_recorder',
    'torque_watchdog',
    'arm_view',
}

# rosdep's names for what pip installs. rosdep has no key for mcap alone.
ROSDEP_KEYS = {
    'numpy': 'python3-numpy',
    'numba': 'python3-numba',
    'matplotlib': 'python3-matplotlib',
    'pyyaml': 'python3-yaml',
    'tqdm': 'python3-tqdm',
    'scipy': 'python3-scipy',
    'jinja2': 'python3-jinja2',
    'mcap': 'mcap-ros2-support',
    'lz4': 'mcap-ros2-support',  # through mcap
    'zstandard': 'mcap-ros2-support',
    'rosbags': 'python3-rosbags-pip',
}


def manifest():
    return ET.parse(ROOT / 'package.xml').getroot()  # noqa: S314 - our own file


def depends(kind):
    return {element.text for element in manifest().findall(kind)}


def sources():
    return [
        path for package in PACKAGES for path in sorted((ROOT / package).rglob('*.py'))
    ]


@pytest.fixture(scope='module')
def sdist(tmp_path_factory):
    """Build the source distribution from a copy of the sources."""
    copy = tmp_path_factory.mktemp('source') / NAME
    unwanted = ('.*', 'build', 'install', 'log', 'out', '*.egg-info', '__pycache__')
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(*unwanted))
    text = (copy / 'package.xml').read_text()
    url = f'<url type="repository">{URL}</url>'  # as its publisher would add it
    (copy / 'package.xml').write_text(
        text.replace('<exec_depend>', f'{url}<exec_depend>', 1)
    )
    subprocess.run([sys.executable, 'setup.py', '-q', 'sdist'], cwd=copy, check=True)
    (path,) = copy.glob('dist/*.tar.gz')
    return path


@pytest.fixture(scope='module')
def wheel(sdist, tmp_path_factory):
    """Build the wheel from the source distribution, with what is installed and no network."""
    build = [sys.executable, '-m', 'pip', 'wheel', '--quiet', '--no-deps', '--no-index']
    out = tmp_path_factory.mktemp('wheel')
    subprocess.run(
        [*build, '--no-build-isolation', '--wheel-dir', str(out), str(sdist)],
        check=True,
    )
    (path,) = out.glob('*.whl')
    return zipfile.ZipFile(path)


@pytest.fixture(scope='module')
def distribution(wheel):
    """Metadata, requirements and entry points of the wheel."""
    (folder,) = {
        name.split('/')[0] for name in wheel.namelist() if '.dist-info/' in name
    }
    return PathDistribution(zipfile.Path(wheel.filename, f'{folder}/'))


def requirements(distribution, extra=None):
    wanted = [
        line
        for line in distribution.requires
        if (f'extra == "{extra}"' in line if extra else 'extra' not in line)
    ]
    return {re.match(r'[\w-]+', line).group().lower() for line in wanted}


def test_colcon_and_ros2_run_find_the_package():
    root = manifest()
    assert root.get('format') == '3'
    assert root.findtext('name') == NAME
    assert root.findtext('export/build_type') == 'ament_python'
    # colcon silently treats a package with an invalid address as plain Python.
    assert re.fullmatch(
        r'[\w.+-]+@([\w-]+\.)+[a-zA-Z]{2,}', root.find('maintainer').get('email')
    )
    setup = configparser.ConfigParser()
    setup.read(ROOT / 'setup.cfg')
    assert setup['develop']['script_dir'] == f'$base/lib/{NAME}'
    assert setup['install']['install_scripts'] == f'$base/lib/{NAME}'
    # setuptools makes an object that colcon rejects
    assert 'python_requires' not in setup['options']


def test_wheel_contains_every_module_with_its_types_and_no_tests(wheel, sdist):
    installed = {name for name in wheel.namelist() if '.data/' not in name}
    modules = {name for name in installed if name.endswith('.py')}
    assert modules == {path.relative_to(ROOT).as_posix() for path in sources()}
    assert {f'{package}/py.typed' for package in PACKAGES} <= installed
    with tarfile.open(sdist) as archive:
        folders = {name.split('/')[1] for name in archive.getnames() if '/' in name}
    assert {
        *PACKAGES,
        'config',
        'launch',
        'resource',
        'setup.py',
        'package.xml',
    } <= folders
    assert 'test' not in folders


def test_wheel_installs_the_share_files_that_ros_expects(wheel):
    start = f'{NAME}-{blf_dsc_controller.__version__}.data/data/share/'
    shared = {
        name.removeprefix(start) for name in wheel.namelist() if name.startswith(start)
    }
    assert {
        f'ament_index/resource_index/packages/{NAME}',
        f'{NAME}/package.xml',
        f'{NAME}/LICENSE',
        f'{NAME}/CHANGELOG.rst',
        f'{NAME}/launch/closed_loop.launch.py',
        f'{NAME}/config/recommended.yaml',
    } <= shared
    assert {
        Path(name).name for name in shared if name.startswith(f'{NAME}/config/')
    } == {path.name for path in (ROOT / 'config').iterdir() if path.is_file()}


def test_every_executable_has_a_callable_entry_point(distribution):
    assert distribution.entry_points.names == {'blf_dsc', *NODES}
    for entry in distribution.entry_points:
        assert callable(entry.load())


def imports(path):
    """Top-level names of the packages that a source file imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.split('.')[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module.split('.')[0]


def test_every_import_is_a_declared_dependency(distribution):
    used = {name for path in sources() for name in imports(path)}
    used |= set(imports(ROOT / 'launch/closed_loop.launch.py'))
    # a part of numba
    foreign = used - set(sys.stdlib_module_names) - set(PACKAGES) - {'llvmlite'}
    others = {'yaml': 'pyyaml', 'can': 'python-can'}
    distributions = {others.get(name, name) for name in foreign}
    extras = ('monte-carlo', 'dask', 'report', 'view', 'streams', 'mujoco', 'franka')
    extras += ('damiao',)
    optional = set().union(*(requirements(distribution, extra) for extra in extras))
    assert distributions <= requirements(distribution) | optional | depends(
        'exec_depend'
    )


def test_rosdep_and_pip_install_the_same_dependencies(distribution):
    assert requirements(distribution) == set(ROSDEP_KEYS)
    assert set(ROSDEP_KEYS.values()) <= depends('exec_depend')
    assert {'ros-jazzy-rclpy', 'ros-jazzy-rmw-fastrtps-cpp'} <= requirements(
        distribution, 'ros'
    )
    assert 'pytest' in requirements(distribution, 'test')  # where colcon looks


def test_public_names_are_documented_and_imported_on_first_use(tmp_path):
    for name in blf_dsc_controller.__all__:
        assert getattr(blf_dsc_controller, name).__doc__, name
    program = 'import sys, blf_dsc_controller; assert "numpy" not in sys.modules'
    subprocess.run([sys.executable, '-c', program], cwd=tmp_path, check=True)


def test_setup_runs_in_the_links_of_a_colcon_symlink_install(tmp_path):
    for name in ('setup.py', 'setup.cfg', 'package.xml', *PACKAGES):
        (tmp_path / name).symlink_to(ROOT / name)
    run = [sys.executable, 'setup.py', '--version']
    ended = subprocess.run(
        run, cwd=tmp_path, check=True, capture_output=True, text=True
    )
    assert ended.stdout.split()[-1] == blf_dsc_controller.__version__


def test_errors_can_be_passed_between_processes():
    error = blf_dsc_controller.ConfigurationError(['a: got 1', 'b: got 2'], 'my.yaml')
    copied = pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
    assert (str(copied), vars(copied)) == (str(error), vars(error))

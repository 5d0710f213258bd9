# SPDX-License-Identifier: Apache-2.0
"""Setup for pip, colcon and ament: two Python packages, their commands and share files."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'blf_dsc_controller'
SHARE = f'share/{NAME}'
HERE = Path(__file__).resolve().parent  # colcon --symlink-install runs a link to this file
# For the documentation site, which the tests build too; ziamath renders its equations.
DOCS = ['sphinx>=8', 'myst-parser>=4', 'furo', 'ziamath>=0.12']


def version() -> str:
    """Read the version from the source, without importing the package."""
    text = Path(NAME, '__init__.py').read_text(encoding='utf-8')
    match = re.search(r"^__version__ = '(.+)'$", text, re.MULTILINE)
    if match is None:
        raise RuntimeError(f'{NAME}/__init__.py has no line __version__ = ...')
    return match.group(1)


def files(folder: str) -> list[str]:
    """List the files of a folder, to be installed under the same name in the share folder."""
    return sorted(str(path) for path in Path(folder).glob('*.*') if path.is_file())


# Maintainer and URLs are given in package.xml only.
MANIFEST = ET.parse(HERE / 'package.xml').getroot()  # noqa: S314 - our own file
(MAINTAINER,) = MANIFEST.findall('maintainer')
URLS = {url.get('type', 'website'): url.text for url in MANIFEST.findall('url')}


def readme() -> str:
    """Return README.md as PyPI can show it: links and pictures lead to the repository, if known."""
    text = (HERE / 'README.md').read_text(encoding='utf-8')
    if 'repository' not in URLS:
        return text
    for link, place in ((r'(!\[[^]]*\]\()', 'raw'), (r'((?<!!)\[[^]]*\]\()', 'blob')):
        address = rf'\1{URLS["repository"]}/{place}/{version()}/'
        text = re.sub(rf'{link}(?![a-z]+://|#)', address, text)
    return text


setup(
    name=NAME,
    version=version(),
    description='Output-constrained tracking of robot arms with unknown dynamics, for ROS 2',
    long_description=readme(),
    long_description_content_type='text/markdown',
    keywords=[
        'ROS 2',
        'robot arm',
        'adaptive control',
        'barrier Lyapunov function',
        'composite learning',
        'parameter identification',
    ],
    author=MAINTAINER.text,
    maintainer=MAINTAINER.text,
    maintainer_email=MAINTAINER.get('email'),
    project_urls=URLS,
    license='Apache-2.0',
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Science/Research',
        'Intended Audience :: Developers',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        *(f'Programming Language :: Python :: 3.{minor}' for minor in range(10, 14)),
        'Topic :: Scientific/Engineering',
        'Typing :: Typed',
    ],
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*', 'sim_plant', 'sim_plant.*']),
    package_data={NAME: ['py.typed', 'templates/*'], 'sim_plant': ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (SHARE, ['package.xml', 'LICENSE', 'CHANGELOG.rst']),
        (f'{SHARE}/config', files('config')),
        (f'{SHARE}/launch', files('launch')),
    ],
    install_requires=[
        # Lower bounds: the versions of Ubuntu 24.04, which a sourced Jazzy runs on.
        'numpy>=1.26',
        'numba>=0.58',
        'mcap>=1.6',
        'rosbags>=0.11',
        # Compression of the chunks of MCAP files; mcap depends on both.
        'lz4',
        'zstandard',
        'matplotlib>=3.6',
        'pyyaml',
        'tqdm',
        'jinja2',
        'scipy>=1.11',
    ],
    extras_require={
        # ROS 2 Jazzy itself, as wheels. An extra, because a sourced Jazzy has its own.
        'ros': [
            'ros-jazzy-rclpy',
            'ros-jazzy-rmw-fastrtps-cpp',
            'ros-jazzy-common-interfaces',
            'ros-jazzy-builtin-interfaces',
            'ros-jazzy-lifecycle-msgs',
            'ros-jazzy-rcl-interfaces',
            'ros-jazzy-rosgraph-msgs',
            'ros-jazzy-ament-index-python',
        ],
        # Only for `monte_carlo`, whose results are Parquet files: 50 MB that a robot does not need.
        'monte-carlo': ['pyarrow'],
        'dask': ['pyarrow', 'distributed'],
        # Only for `blf_dsc report`, to draw its pages: 40 MB.
        'report': ['plotly>=6'],
        # Only for `view`, to serve its page: 130 MB, most of it for reading meshes.
        'view': ['viser>=1.1', 'yourdfpy>=0.0.57', 'trimesh'],
        # Only to draw known arms, such as the Panda, with their meshes: 414 MB.
        'meshes': ['example-robot-data', 'pycollada'],
        'parquet': ['pyarrow'],  # only for `blf_dsc export` into Parquet
        # setuptools: test_package.py builds a wheel offline.
        'test': [
            'pytest>=7',
            'pytest-xdist',
            'hypothesis',
            'mujoco',
            'pin',  # pinocchio, the oracle of the arm models: 400 MB
            'setuptools>=70.1',
            'pyarrow',
            'distributed',
            'plotly>=6',
            *DOCS,
            'viser>=1.1',
            'yourdfpy>=0.0.57',
        ],
        'docs': DOCS,
        'release': ['build', 'twine'],
        # The peers of `make bench`; a C compiler comes from the system.
        'bench': ['mujoco', 'pin', 'pyarrow'],
        # Pinned: with nearly all rules enabled, each release of the linter finds something new.
        'lint': [
            'ruff~=0.17.5',
            'mypy~=2.4.1',
            'types-PyYAML',
            'types-tqdm',
            'pre-commit',
            'import-linter',
        ],
    },
    entry_points={
        'console_scripts': [
            'blf_dsc = blf_dsc_controller.cli.main:main',
            # The nodes, for `ros2 run` and the launch file.
            'sim_plant = blf_dsc_controller.cli.main:sim_plant',
            'blf_dsc_controller = blf_dsc_controller.cli.main:blf_dsc_controller',
            'bag_recorder = blf_dsc_controller.cli.main:bag_recorder',
            'torque_watchdog = blf_dsc_controller.cli.main:torque_watchdog',
            'arm_view = blf_dsc_controller.cli.main:arm_view',
        ],
    },
    # The cache of compiled kernels is keyed by a digest of the source files on disk.
    zip_safe=False,
)

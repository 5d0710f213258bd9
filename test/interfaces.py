# SPDX-License-Identifier: Apache-2.0
"""Builds a package of ROS interfaces from its definitions, with the generators of ROS.

They come with the wheels of the message packages. CMake's part, to compile what they write, is a
few calls of the C compiler here.
"""

from __future__ import annotations

import hashlib
import importlib.util
import io
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from contextlib import redirect_stdout, suppress
from pathlib import Path

import numpy as np

from blf_dsc_controller.compiled import kernel_cache

# of a message: for the middleware, and for its description of the type
_SUPPORTS = ('rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_introspection_c')
_LIBRARIES = (
    'fastcdr',
    'rcutils',
    'rmw',
    'rosidl_runtime_c',
    'rosidl_typesupport_c',
    'rosidl_typesupport_fastrtps_c',
    'rosidl_typesupport_fastrtps_cpp',
    'rosidl_typesupport_introspection_c',
)
_PARTS = (
    'rosidl_generator_c',
    'rosidl_generator_py',
    'rosidl_typesupport_c',
    *_SUPPORTS,
)
_APART = 'introspection'
_FRONT = 'rosidl_typesupport_c'
_USED = (
    'action_msgs',
    'builtin_interfaces',
    'geometry_msgs',
    'service_msgs',
    'std_msgs',
    'trajectory_msgs',
    'unique_identifier_msgs',
)


def why_not() -> str:
    """Return what is missing to build interfaces; empty if nothing is."""
    for module in ('rosidl_generator_py', 'rosidl_adapter', 'catkin_pkg'):
        if importlib.util.find_spec(module) is None:
            return f'no {module}'
    if not Path(sysconfig.get_path('include'), 'Python.h').is_file():
        return "no headers of Python's: apt install python3-dev"
    missing = [each for each in ('gcc', 'g++') if shutil.which(each) is None]
    return f'no {missing[0]}' if missing else ''


def built(definitions: Path) -> Path:
    """Return a folder for PYTHONPATH with the package in `definitions`, named as that folder.

    It is built once and kept beside the compiled kernels, for it takes 12 s of CPU time.
    """
    cache = kernel_cache.place()
    folder = cache / f'{definitions.name}-{_digest(definitions)}'
    if not folder.exists():
        with tempfile.TemporaryDirectory(dir=cache) as fresh:
            build(definitions, Path(fresh, 'built'))
            with suppress(OSError):  # another process was faster
                Path(fresh, 'built').rename(folder)
    return folder


def _digest(definitions: Path) -> str:
    """Return what tells builds apart: definitions, generators and libraries, Python and numpy."""
    found = hashlib.sha256(f'{sys.version} {sys.prefix} {np.__version__}'.encode())
    for path in (Path(__file__), *sorted(definitions.rglob('*'))):
        if path.is_file():
            found.update(path.name.encode() + b'\0' + path.read_bytes())
    for each in _LIBRARIES:
        library = Path(sys.prefix, 'lib', f'lib{each}.so').stat()
        found.update(f'{each} {library.st_size} {library.st_mtime_ns}'.encode())
    return found.hexdigest()[:16]


def build(definitions: Path, folder: Path) -> None:
    """Build the package into a folder that may be moved afterwards."""
    name = definitions.name
    package = folder / name
    package.mkdir(parents=True)
    _generate(name, definitions, package)
    (package / '__init__.py').touch()
    described = folder / _APART
    for_python = [*package.glob('*/*_s.c'), package / f'_{name}_s.ep.{_FRONT}.c']
    others = [each for each in _sources(package) if each not in for_python]
    # What ROS opens by name at run time is there already: the library for Python needs both.
    libraries = [folder / f'lib{name}__{each}.so' for each in _SUPPORTS]
    _compile(folder, others, libraries[0])
    _compile(folder, _sources(described), libraries[1], libraries[0])
    module = f'{name}_s__{_FRONT}{sysconfig.get_config_var("EXT_SUFFIX")}'
    _compile(folder, for_python, package / module, *libraries)


def _sources(folder: Path) -> list[Path]:
    return [*folder.rglob('*.c'), *folder.rglob('*.cpp')]


def _generate(name: str, definitions: Path, package: Path) -> None:
    """Write the sources, as `rosidl generate` would if it found each generator only once."""
    os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)  # where they have templates
    from rosidl_cli.command.hash.api import generate_type_hashes
    from rosidl_cli.command.translate.api import translate
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import (
        GenerateIntrospectionCTypesupport,
    )

    include = [f'{Path(sys.prefix, "share")}']
    kinds = ('*.msg', '*.srv', '*.action')
    found = sorted(each for kind in kinds for each in definitions.rglob(kind))
    files = [f'{definitions}:{each.relative_to(definitions)}' for each in found]
    given = {'package_name': name, 'include_paths': include, 'output_path': package}
    with redirect_stdout(io.StringIO()):
        given['interface_files'] = translate(
            interface_files=files, output_format='idl', **given
        )
        hashes = generate_type_hashes(**given)
        GenerateC('c').generate(type_description_files=hashes, **given)
        GenerateFastRTPSCTypesupport('fastrtps_c').generate(**given)
        supports = {'typesupport_implementations': [*_SUPPORTS]}
        GenerateCTypesupport('c', **supports).generate(**given)
        supports = {'typesupport_implementations': [_FRONT]}
        GeneratePython('py', **supports).generate(**given)
        # whose files have names of the others
        given['output_path'] = package.parent / _APART / name
        given['output_path'].mkdir(parents=True)
        GenerateIntrospectionCTypesupport('introspection_c').generate(**given)


def _compile(folder: Path, sources: list[Path], library: Path, *needed: Path) -> None:
    """Compile sources into a library that needs others beside those of ROS."""
    prefix = Path(sys.prefix)
    headers = [
        folder,
        folder / _APART,
        sysconfig.get_path('include'),
        np.get_include(),
        prefix / 'include',
        *(each for each in (prefix / 'include').iterdir() if each.is_dir()),
    ]
    options = ['-c', '-fPIC', '-O0', '-w', *(f'-I{each}' for each in headers)]
    c, cpp = shutil.which('gcc'), shutil.which('g++')
    objects = []
    for source in sources:
        compiler = c if source.suffix == '.c' else cpp
        objects.append(source.with_suffix(f'{source.suffix}.o'))
        subprocess.run([compiler, *options, source, '-o', objects[-1]], check=True)
    of_ros = [*_LIBRARIES, *(f'{each}__{part}' for each in _USED for part in _PARTS)]
    links = [
        f'-Wl,-soname,{library.name},--no-as-needed,-rpath,$ORIGIN:$ORIGIN/..',
        *needed,
        f'-L{prefix / "lib"}',
        *(f'-l{each}' for each in of_ros),
    ]
    subprocess.run([cpp, '-shared', *objects, *links, '-o', library], check=True)

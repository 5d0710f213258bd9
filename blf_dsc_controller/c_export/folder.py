# SPDX-License-Identifier: Apache-2.0
"""The files of an exported law: its objects, settings with initial state, and the C around them.

Each vector that the kernels `update` and `advance` take is a part of one array, which is the
file of settings.  The C code has the places of these parts, and passes them by numba's calling
convention.
"""

from __future__ import annotations

import hashlib
import re
import zlib
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite.binding import get_host_cpu_name
from numba.core import config as numba_config

from blf_dsc_controller import __version__
from blf_dsc_controller.c_export.object_file import without_python
from blf_dsc_controller.compiled.jit import SLOW
from blf_dsc_controller.configuration import law_file
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law import check_state
from blf_dsc_controller.law.controller import Controller
from blf_dsc_controller.law.state import sample_of, state_of
from blf_dsc_controller.law.step import advance, update
from blf_dsc_controller.reference.terms import pack, spline_term
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.recent_motion import shortest_gap
from blf_dsc_controller.warnings.table import refuse

if not SLOW:
    from blf_dsc_controller.compiled.linked import object_file_of

_FLAGS = (
    'SUSPECT',
    'OUTSIDE',
    'INVALID',
    'NO_EFFECT',
    'CONTRADICTION',
    'OSCILLATES',
    'NOT_SENSORS',
)


def export(config: ControllerConfig, folder: Path) -> None:
    """Write the law of a configuration into an existing folder.

    Raises:
        StartError: no arm is stable with the gains.
        BlfDscError: it cannot be exported.
        OSError: a file cannot be written.
    """
    _check(config)
    refuse(config)
    law = Guard(config).controller  # with the limits of its checks
    n = law.settings.n
    # a piece of a spline, which begins at each sample with what the caller gives
    law.reference_vector = pack(n, [spline_term(np.zeros(1), np.zeros((1, n, 6)))])
    of_update, code = _object(update, *law.arguments, 0.0, 0.0)
    of_advance, learns = _object(advance, *law.arguments_after)
    texts = {'SYMBOL': of_update, 'ADVANCE_SYMBOL': of_advance}
    texts |= _places(law) | _numbers(config)
    digest = hashlib.sha256(code + learns + repr(texts).encode()).hexdigest()
    values = np.concatenate([np.ravel(each) for each in _flat(law.arguments)])
    settings = digest.encode() + values.astype('<f8').tobytes()
    texts |= {
        'DIGEST': digest,
        'VALUES': f'{values.size}',
        'MEGABYTES': f'{1e-6 * values.nbytes:.2g}',
    }
    (folder / 'blf_dsc_update.o').write_bytes(code)
    (folder / 'blf_dsc_advance.o').write_bytes(learns)
    checksum = zlib.crc32(settings).to_bytes(4, 'little')
    (folder / 'blf_dsc_law.bin').write_bytes(settings + checksum)
    for file in files(__package__).joinpath('files').iterdir():
        text = re.sub('@([A-Z_]+)@', lambda name: texts[name[1]], file.read_text())
        (folder / file.name).write_text(text)


def _object(kernel: Any, *arguments: Any) -> tuple[str, bytes]:
    """Return the symbol of a kernel for these arguments, and the object that has it."""
    symbol, code = object_file_of(kernel, *arguments)
    if code is None:
        raise BlfDscError(
            'the machine code is not in the cache: let NUMBA_CACHE_DIR be a folder that you '
            'can write'
        )
    return symbol, without_python(code)


def _check(config: ControllerConfig) -> None:
    """Raise BlfDscError if C cannot do what a configuration asks for."""
    for cannot, text in (
        (SLOW, SLOW),
        (numba_config.DISABLE_JIT, 'NUMBA_DISABLE_JIT is set, and nothing is compiled'),
        (
            law_file.has_file(config.law),
            f'law is {config.law}: only blf_dsc can be called from C',
        ),
        (
            config.contact.enabled,
            'contact.enabled: contacts are found in Python alone; set it to false',
        ),
        (
            config.safety.velocity == 'estimated',
            'safety.velocity is estimated, in Python alone: set measured, and give C velocities',
        ),
    ):
        if cannot:
            raise BlfDscError(text)


def _numbers(config: ControllerConfig) -> dict[str, str]:
    """Return what the texts say about a configuration."""
    T = config.sample_time
    gap = min(shortest_gap(T), T + config.safety.state_timeout)
    return {
        'VERSION': __version__,
        'N': f'{len(config.joints)}',
        'JOINTS': ', '.join(config.joints),
        'SAMPLE_TIME': f'{T!r}',
        'GAP': f'{gap!r}',
        'PROCESSOR': numba_config.CPU_NAME or get_host_cpu_name(),
        **{name: f'{getattr(check_state, name)}' for name in _FLAGS},
    }


def _places(law: Controller) -> dict[str, str]:
    """Return the arguments of the kernels in C, and the places of what C writes and reads.

    `advance` takes the first of those that `update` takes.
    """
    types, arguments, begins = [], [], []
    at = 0
    for each in _flat(law.arguments):
        begins.append(at)
        if isinstance(each, np.ndarray):
            (size,) = each.shape
            types.append('ARRAY')
            arguments.append(f'VECTOR({at}, {size})')
            at += size
        else:
            types.append('int64_t' if isinstance(each, int) else 'double')
            arguments.append(f'now[{at}]')
            at += 1
    *_, state, _, sample, checks, measurement, _ = begins
    shared = begins.index(checks)
    indices = np.arange(float(at))
    last_torque = state_of(indices, law.settings).torque[0]
    torque = sample_of(indices, law.settings).torque[0]
    return {
        'TYPES': ', '.join(types),
        'ARGUMENTS': ', '.join(arguments),
        'ADVANCE_TYPES': ', '.join(types[:shared]),
        'ADVANCE_ARGUMENTS': ', '.join(arguments[:shared]),
        'MEASUREMENT': f'{measurement}',
        'KNOT': f'{at - 6 * law.settings.n - 1}',
        'TORQUE': f'{sample + int(torque)}',
        'LAST_TORQUE': f'{state + int(last_torque)}',
    }


def _flat(arguments: Any) -> Iterator[Any]:
    """Yield the numbers and vectors of arguments in the order in which a kernel takes them."""
    for each in arguments:
        if isinstance(each, tuple):
            yield from _flat(each)
        else:
            yield each

# SPDX-License-Identifier: Apache-2.0
"""The object file of a kernel, for programs without Python.

Beside a kernel, numba compiles a function by which Python calls it, and whose symbols no other
program has.  Here they become weak: a linker leaves them open, and nobody calls that function.
"""

from __future__ import annotations

import numpy as np

from blf_dsc_controller.errors import BlfDscError

_ELF_64_LITTLE = b'\x7fELF\x02\x01'
_FOR_PYTHON = b'_ZN7cpython'  # how the name of that function begins
_OF_C = {b'', b'memset', b'memcpy', b'memmove'}  # what a kernel may call
_WEAK = 2 << 4
_SYMBOLS, _RELOCATIONS = 2, 4  # kinds of sections
_HEADER = np.dtype(
    {'names': ['at', 'count'], 'formats': ['<u8', '<u2'], 'offsets': [40, 60]}
)
_SECTION = np.dtype(
    [
        ('name', '<u4'),
        ('kind', '<u4'),
        ('flags', '<u8'),
        ('address', '<u8'),
        ('at', '<u8'),
        ('size', '<u8'),
        ('link', '<u4'),
        ('info', '<u4'),
        ('rest', '<u8', 2),
    ]
)
_SYMBOL = np.dtype(
    [
        ('name', '<u4'),
        ('info', 'u1'),
        ('other', 'u1'),
        ('section', '<u2'),
        ('value', '<u8'),
        ('size', '<u8'),
    ]
)
_RELOCATION = np.dtype(
    [('at', '<u8'), ('kind', '<u4'), ('symbol', '<u4'), ('rest', '<i8')]
)


def without_python(code: bytes) -> bytes:
    """Return the object file of a kernel with weak symbols of Python.

    Raises BlfDscError if it is not that of Linux, or if the kernel itself calls something.
    """
    if not code.startswith(_ELF_64_LITTLE):
        raise BlfDscError(
            'the machine code of this computer is no ELF object of 64 bits: export on Linux'
        )
    linked = bytearray(code)
    (header,) = np.frombuffer(linked, _HEADER, 1)
    sections = np.frombuffer(linked, _SECTION, header['count'], header['at'])
    (table,) = sections[sections['kind'] == _SYMBOLS]
    symbols = _entries(linked, table, _SYMBOL)
    texts = code[sections[table['link']]['at'] :]
    names = [texts[at : texts.index(b'\0', at)] for at in symbols['name']]
    missing = symbols['section'] == 0
    missing &= [name not in _OF_C for name in names]
    (wrapper,) = symbols[[name.startswith(_FOR_PYTHON) for name in names]]
    for section in sections[sections['kind'] == _RELOCATIONS]:
        used = _entries(linked, section, _RELOCATION)
        is_wrapper = section['info'] == wrapper['section']
        is_wrapper &= used['at'] - wrapper['value'] < wrapper['size']
        for symbol in used['symbol'][missing[used['symbol']] & ~is_wrapper]:
            raise BlfDscError(
                f'the law calls {names[symbol].decode()}, which programs without Python lack'
            )
    symbols['info'][missing] = _WEAK
    return bytes(linked)


def _entries(code: bytearray, section: np.void, kind: np.dtype) -> np.ndarray:
    """Return the entries of a section, to be written."""
    return np.frombuffer(code, kind, section['size'] // kind.itemsize, section['at'])

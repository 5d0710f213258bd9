# SPDX-License-Identifier: Apache-2.0
"""Decompression of a bag within a limit: a few kilobytes can unpack to gigabytes."""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterable
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

from lz4.frame import LZ4FrameDecompressor
from zstandard import ZstdDecompressor

from blf_dsc_controller.errors import BlfDscError

MAX_UNPACKED: ContextVar[float] = ContextVar('MAX_UNPACKED', default=1e9)
"""Bytes that a bag may unpack to; set by `--max-unpacked`, in GB."""

LARGEST_CHUNK = 1 << 29  # bytes, unpacked
_EXPECTED = 100  # multiple of the size of its files that any bag may unpack to
_STEP = 1 << 17  # bytes


class Unpacker:
    """Decompressor for one bag of these `files`, with a limit on the total size."""

    def __init__(self, files: Iterable[Path]) -> None:
        files = list(files)
        packed = sum(file.stat().st_size for file in files)
        self._name = str(files[0].parent if len(files) > 1 else files[0])
        self._limit = self._left = max(int(MAX_UNPACKED.get()), _EXPECTED * packed)

    def unpack(self, data: bytes, compression: str, announced: int = LARGEST_CHUNK) -> bytes:
        """Unpack `data`.

        Raises:
            BlfDscError: the bag unpacks to more than its limit.
            ValueError: `data` holds more than announced.
            Exception: from the compression library, if `data` is damaged.
        """
        largest = min(announced, LARGEST_CHUNK)
        unpacked = _UNPACK[compression](data, min(largest, self._left))
        self.count(len(unpacked))
        if len(unpacked) > largest:
            raise ValueError(f'more than {largest} bytes, unpacked')
        return unpacked

    def unpack_file(self, source: BinaryIO, target: BinaryIO) -> None:
        """Unpack a file compressed with zstd; errors as in `unpack`."""
        stream = ZstdDecompressor().stream_reader(source, read_across_frames=True)
        while part := stream.read(_STEP):
            self.count(len(part))
            target.write(part)

    def count(self, size: int) -> None:
        """Count unpacked bytes; BlfDscError if there are too many."""
        self._left -= size
        if self._left < 0:
            raise BlfDscError(
                f'{self._name} unpacks to more than {self._limit / 1e9:.3g} GB, which is '
                'unusual for a recording: if you trust it, raise --max-unpacked'
            )


def _zstd(data: bytes, most: int) -> bytes:
    parts, size = [], 0
    for part in ZstdDecompressor().read_to_iter(data):
        parts.append(part)
        size += len(part)
        if size > most:
            break
    return b''.join(parts)


_UNPACK: dict[str, Callable[[bytes, int], bytes]] = {
    '': lambda data, _: data,
    'none': lambda data, _: data,  # of ROS 1
    'bz2': lambda data, most: bz2.BZ2Decompressor().decompress(data, most + 1),
    'lz4': lambda data, most: LZ4FrameDecompressor().decompress(data, most + 1),
    'zstd': _zstd,
}

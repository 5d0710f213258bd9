# SPDX-License-Identifier: Apache-2.0
"""Unpacking of compressed data from a bag, which is not trusted, up to a limit."""

from __future__ import annotations

from io import BytesIO

from lz4.frame import LZ4FrameDecompressor
from zstandard import ZstdDecompressor

LARGEST = 1 << 27
"""Bytes that a chunk, or any other record that is read, may have, unpacked."""


def unpacked(data: bytes, compression: str, limit: int = LARGEST) -> bytes:
    """Return what was compressed by `zstd`, `lz4` or not at all (empty).

    The sizes that the compressed data state are not believed.

    Raises:
        ValueError: it is more than `limit` bytes, or of another compression.
    """
    if compression == '':
        found = data
    elif compression == 'zstd':
        with ZstdDecompressor().stream_reader(BytesIO(data)) as stream:
            found = stream.read(limit + 1)
    elif compression == 'lz4':
        found = LZ4FrameDecompressor().decompress(data, limit + 1)
    else:
        raise ValueError(f'unknown compression {compression[:20]!r}')
    if len(found) > limit:
        raise ValueError(f'it unpacks to more than {limit} bytes')
    return found

# SPDX-License-Identifier: Apache-2.0
"""Unpacking of compressed data from a bag, which is not trusted, up to a limit."""

from __future__ import annotations

from io import BytesIO

from lz4.frame import LZ4FrameDecompressor
from zstandard import ZstdDecompressor, frame_content_size

LARGEST = 1 << 27
"""Bytes that a chunk, or any other record that is read, may have, unpacked."""


def unpacked(data: bytes, compression: str, limit: int = LARGEST) -> bytes:
    """Return what was compressed by `zstd`, `lz4` or not at all (empty).

    The sizes that the compressed data state are not believed.

    Raises:
        ValueError: it is more than `limit` bytes, cut off, or of another compression.
    """
    is_whole = True
    if compression == '':
        found = data
    elif compression == 'zstd':
        with ZstdDecompressor().stream_reader(BytesIO(data)) as stream:
            found = stream.read(limit + 1)
        is_whole = len(found) > limit or _is_whole_zstd(data, len(found))
    elif compression == 'lz4':
        frame = LZ4FrameDecompressor()
        found = frame.decompress(data, limit + 1)
        is_whole = frame.eof
    else:
        raise ValueError(f'unknown compression {compression[:20]!r}')
    if len(found) > limit:
        raise ValueError(f'it unpacks to more than {limit} bytes')
    if not is_whole:
        raise ValueError(f'it is cut off after {len(found)} bytes, unpacked')
    return found


def _is_whole_zstd(data: bytes, size: int) -> bool:
    """Whether a frame ends where it has unpacked to so many bytes."""
    stated = frame_content_size(data)
    if stated >= 0:
        return bool(size == stated)
    frame = ZstdDecompressor().decompressobj()
    frame.decompress(data)
    return bool(frame.eof)

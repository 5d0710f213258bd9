# SPDX-License-Identifier: Apache-2.0
"""A std_msgs/String to bytes and back, without the library of bags."""

from __future__ import annotations

from struct import Struct

from blf_dsc_controller.messages.errors import MessageError

_LITTLE_ENDIAN = b'\x00\x01\x00\x00'
_HEAD = Struct('<4sI')  # encapsulation, and length with the closing zero


def encode_string(text: str) -> bytes:
    """Return the serialised std_msgs/String of a text."""
    content = text.encode() + b'\0'
    return _HEAD.pack(_LITTLE_ENDIAN, len(content)) + content


def decode_string(raw: bytes | bytearray) -> str:
    """Return the text of a serialised std_msgs/String.

    Raises:
        MessageError: `raw` is not plain CDR, or is cut off.
        UnicodeDecodeError: it is not UTF-8.
    """
    if len(raw) < _HEAD.size or bytes(raw[:2]) != _LITTLE_ENDIAN[:2]:
        raise MessageError(
            f'got {len(raw)} bytes, which begin with {bytes(raw[:2]).hex(" ")}: expected plain '
            'CDR, little-endian'
        )
    _, length = _HEAD.unpack_from(raw)
    content = bytes(raw[_HEAD.size : _HEAD.size + length])
    if len(content) < length:
        raise MessageError(
            f'message of {len(raw)} bytes is cut off: '
            f'its contents need at least {_HEAD.size + length} bytes'
        )
    return content.removesuffix(b'\0').decode()

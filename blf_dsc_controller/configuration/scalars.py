# SPDX-License-Identifier: Apache-2.0
"""What a word in a parameter file means to ROS, whose rules are not those of a YAML library.

`1e-5` is a number and `1_000` a text to ROS; PyYAML has it the other way round. `yes` is a bool,
`010` is eight, `null` a text. Source: get_value() in rcl_yaml_param_parser.
"""

from __future__ import annotations

import math
import re
import sys

_TRUE = ('Y', 'y', 'yes', 'Yes', 'YES', 'true', 'True', 'TRUE', 'on', 'On', 'ON')
_FALSE = ('N', 'n', 'no', 'No', 'NO', 'false', 'False', 'FALSE', 'off', 'Off', 'OFF')

_INTEGER = re.compile(r'[+-]?(?:0[xX](?P<hex>[0-9a-fA-F]+)|(?P<octal>0[0-7]*)|[1-9][0-9]*)')
_DECIMAL = re.compile(r'[+-]?(?P<digits>[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?')
_HEXADECIMAL = re.compile(
    r'[+-]?0[xX](?:[0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)(?:[pP][+-]?[0-9]+)?'
)
_SPECIAL = re.compile(r'[+-]?(?:inf|infinity|nan)', re.IGNORECASE)
_DOTTED = re.compile(r'[+-]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)')

_LARGEST_INTEGER = 2**63 - 1


def meaning(word: str) -> bool | int | float | str:
    """The value that ROS reads in a word written without quotes."""
    if word in _TRUE or word in _FALSE:
        return word in _TRUE
    integer = _integer(word)
    if integer is not None:
        return integer
    number = _double(word)
    return word if number is None else number


def _integer(word: str) -> int | None:
    match = _INTEGER.fullmatch(word)
    if match is None:
        return None
    base = 16 if match['hex'] else 8 if match['octal'] else 10
    value = int(word, base)
    return value if -_LARGEST_INTEGER - 1 <= value <= _LARGEST_INTEGER else None


def _double(word: str) -> float | None:
    if _SPECIAL.fullmatch(word) or _DOTTED.fullmatch(word):
        return float(word.replace('.', ''))
    if _HEXADECIMAL.fullmatch(word):
        return float.fromhex(word)
    match = _DECIMAL.fullmatch(word)
    if match is None:
        return None
    value = float(word)
    underflow = abs(value) < sys.float_info.min and match['digits'].strip('0.') != ''
    return None if math.isinf(value) or underflow else value

# SPDX-License-Identifier: Apache-2.0
"""Scalars of a parameter file are read as ROS reads them."""

from __future__ import annotations

import math

import pytest

from blf_dsc_controller.configuration.files import parse_scalar


@pytest.mark.parametrize(
    ('word', 'value'),
    [
        ('1e-5', 1e-5),  # a string to PyYAML
        ('1E3', 1000.0),
        ('.5', 0.5),
        ('5.', 5.0),
        ('+1.5', 1.5),
        ('12', 12),
        ('-7', -7),
        ('0x1F', 31),
        ('-0x10', -16),
        ('017', 15),
        ('08', 8.0),  # not octal, so it is a double
        ('0x1p3', 8.0),
        ('9223372036854775807', 2**63 - 1),
        ('-9223372036854775808', -(2**63)),
        ('9223372036854775808', 2.0**63),
        ('1e400', '1e400'),
        ('1e-400', '1e-400'),
        ('0e0', 0.0),
        ('yes', True),
        ('n', False),
        ('tRue', 'tRue'),
        ('1_000', '1_000'),  # a number to PyYAML
        ('1:30', '1:30'),  # ninety to PyYAML
        ('2020-01-01', '2020-01-01'),
        ('null', 'null'),
        ('.inf', math.inf),
        ('-.INF', -math.inf),
        ('infinity', math.inf),
        ('1 2', '1 2'),
        ('e5', 'e5'),
        ('.', '.'),
    ],
)
def test_scalar_has_the_value_ros_gives_it(word, value):
    assert parse_scalar(word) == value
    assert type(parse_scalar(word)) is type(value)


@pytest.mark.parametrize('word', ['nan', '.NaN', '-nan', 'NAN'])
def test_nan_is_a_double(word):
    assert math.isnan(parse_scalar(word))

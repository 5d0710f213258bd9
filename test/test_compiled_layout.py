# SPDX-License-Identifier: Apache-2.0
"""Layouts of flat vectors: nested tuples, lengths from other objects, Python and kernels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Annotated, NamedTuple

import numba
import numpy as np
import pytest

from blf_dsc_controller.compiled import jit
from blf_dsc_controller.compiled.layout import Array, Cell, Fixed, pack, size_of, sizes_of, view_of


class Motor(NamedTuple):
    limit: Annotated[Array, 'n']
    delay: int


class Settings(NamedTuple):
    n: int
    period: float
    motor: Motor
    gains: Annotated[Array, 2, 'n + 1']


class State(NamedTuple):
    count: Cell
    ring: Annotated[Array, 'motor.delay', 'n']
    motor: Motor


settings_of = view_of(Settings)
state_of, state_size = view_of(State), size_of(State)

SETTINGS = Settings(3, 0.5, Motor([1.0, 2.0, 3.0], 4), [[5.0, 6.0, 7.0, 8.0], [9.0, 0.0, 1.0, 2.0]])


def total(settings_vector, state_vector):
    settings = settings_of(settings_vector)
    state = state_of(state_vector, settings)
    state.count[0] += settings.period
    state.ring[settings.motor.delay - 1, settings.n - 1] = settings.gains[1, 0]
    return settings.gains.sum() + settings.motor.limit.sum()


def test_view_is_the_inverse_of_pack():
    settings = settings_of(pack(SETTINGS))
    assert (settings.n, settings.period, settings.motor.delay) == (3, 0.5, 4)
    np.testing.assert_array_equal(settings.motor.limit, SETTINGS.motor.limit)
    np.testing.assert_array_equal(settings.gains, SETTINGS.gains)


def test_views_cover_the_whole_vector_once():
    sizes = SimpleNamespace(n=2, motor=SimpleNamespace(delay=3))
    vector = np.arange(float(state_size(sizes)))
    assert vector.size == 1 + 6 + 3
    state = state_of(vector, sizes)
    assert state.ring.shape == (3, 2)
    np.testing.assert_array_equal(pack(state), vector)


def test_kernels_and_python_agree():
    vector = pack(SETTINGS)
    results = []
    for function in (total, numba.njit(total)):
        state = np.zeros(state_size(settings_of(vector)))
        results.append((function(vector, state), *state))
    assert results[0] == results[1]
    assert results[0][0] == 44.0
    assert results[0][1] == 0.5
    assert results[0][1 + 12] == 9.0


class Sized(NamedTuple):
    joints: Fixed
    columns: Fixed
    count: int
    gains: Annotated[Array, 'joints', 'columns + 1']


sized_of = view_of(Sized)


@jit.kernel
def lengths(vector, sizes, out):
    sized = sized_of(vector, sizes)
    out[0], out[1], out[2] = sized.joints, sized.columns, sized.count
    out[3] = sized.gains[sized.joints - 1, sized.columns]


@pytest.mark.parametrize(('joints', 'columns'), [(1, 0), (2, 3), (7, 300)])
def test_fixed_numbers_reach_kernels_beside_the_vector(joints, columns):
    gains = np.arange(float(joints * (columns + 1))).reshape(joints, columns + 1)
    sized = Sized(joints, columns, 5, gains)
    vector, out = pack(sized), np.zeros(4)
    assert vector.size == 1 + gains.size
    lengths(vector, sizes_of(sized), out)
    assert out.tolist() == [joints, columns, 5, gains[-1, -1]]
    view = sized_of(vector, sizes_of(sized))
    assert view[:3] == (joints, columns, 5)
    np.testing.assert_array_equal(view.gains, gains)


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
def test_kernels_are_compiled_for_their_fixed_numbers():
    before = len(lengths.signatures)
    for joints, count in ((11, 1), (11, 2), (12, 1)):
        sized = Sized(joints, 0, count, np.zeros((joints, 1)))
        lengths(pack(sized), sizes_of(sized), np.zeros(4))
    assert len(lengths.signatures) == before + 2

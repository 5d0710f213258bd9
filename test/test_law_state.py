# SPDX-License-Identifier: Apache-2.0
"""State, signals and settings as flat vectors: exact layouts, save and restore, no allocation."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from arbitrary_case import arbitrary_settings
from closed_loop_case import (
    REFERENCE,
    START,
    closed_loop,
    controller,
    plant,
    quick,
    recommended,
    record,
)
from numba.core.runtime import _nrt_python, rtsys

from blf_dsc_controller.compiled.layout import pack, sizes_of
from blf_dsc_controller.law.controller import update
from blf_dsc_controller.law.settings import Settings, settings_of
from blf_dsc_controller.law.state import (
    sample_of,
    sample_size,
    signals_of,
    signals_size,
    state_of,
    state_size,
)

SHAPES = [(1, 1), (2, 3), (3, 4), (6, 30)]
SIZES = ('n', 'p', 'm', 'tones', 'drive', 'drive_size', 'model')


def distinct_settings(n, p):
    """Settings whose numbers are all distinct, except for the sizes."""
    settings = arbitrary_settings(np.random.default_rng(0), n, p)
    number = iter(range(1000, 10_000))
    values = {}
    for name, value in settings._asdict().items():
        if name in SIZES:
            continue
        if isinstance(value, np.ndarray):
            values[name] = np.reshape([float(next(number)) for _ in range(value.size)], value.shape)
        else:
            values[name] = next(number) + (0 if isinstance(value, int) else 0.5)
    return settings._replace(**values)


@pytest.mark.parametrize(('n', 'p'), SHAPES)
def test_settings_survive_packing_and_unpacking(n, p):
    settings = distinct_settings(n, p)

    unpacked = settings_of(pack(settings), sizes_of(settings), settings.model)

    for name in Settings._fields:
        np.testing.assert_array_equal(
            getattr(unpacked, name), getattr(settings, name), err_msg=name
        )
        assert isinstance(getattr(unpacked, name), type(getattr(settings, name))), name


@pytest.mark.parametrize(('n', 'p'), SHAPES)
def test_views_cover_their_vectors_exactly_once(n, p):
    settings = arbitrary_settings(np.random.default_rng(0), n, p)
    sizes = state_size(settings), signals_size(settings), sample_size(settings)
    state, signals, sample = (np.arange(float(size)) for size in sizes)

    for views, size in zip(
        (
            state_of(state, settings),
            signals_of(signals, settings),
            sample_of(sample, settings),
        ),
        sizes,
        strict=True,
    ):
        np.testing.assert_array_equal(
            np.sort(np.concatenate([part.ravel() for part in views])), np.arange(size)
        )


def assert_shapes(view, shapes):
    for shape, names in shapes.items():
        for name in names.split():
            assert getattr(view, name).shape == shape, name


def test_state_has_the_documented_shapes():
    n, p, m, N = 3, 4, 7, 8
    settings = arbitrary_settings(np.random.default_rng(0), n, p)
    assert_shapes(
        state_of(np.zeros(state_size(settings)), settings),
        {
            (1,): 'samples cursor rows latched latch_time lambda_min',
            (n,): 'alpha2 torque disturbance',
            (m,): 'estimate b solution anchor min_eigenvector',
            (n, p): 'momentum',
            (n, m): 'rest',
            (n, m + 1): 'filter1 filter2',
            (m + 1, m + 1): 'running fresh half',
            (m, m): 'Phi factor',
            (N, n, m + 1): 'ring',
        },
    )


def test_signals_have_the_documented_shapes():
    n, p, m = 3, 4, 7
    settings = arbitrary_settings(np.random.default_rng(0), n, p)
    assert_shapes(
        signals_of(np.zeros(signals_size(settings)), settings),
        {
            (n,): 'qr dqr ddqr xi1 beta2 dalpha2 xi2 demand torque unit',
            (n, p): 'momentum',
            (n, m): 'H rest',
            (n, m + 1): 'row',
            (n, n): 'inertia',
            (m, m): 'Phi factor',
            (m,): 'b rate work',
        },
    )


def test_sample_contains_what_the_update_computed():
    law = controller(quick(sigma=-1.0))
    record(law, plant(), 1.3)
    assert law.state.latched[0] == 1.0
    for part, name in (
        *((law.signals, name) for name in ('qr', 'dqr', 'xi1', 'xi2', 'torque')),
        *((law.state, name) for name in ('disturbance', 'estimate', 'lambda_min', 'latched')),
    ):
        np.testing.assert_array_equal(getattr(law.sample, name), getattr(part, name), err_msg=name)
        assert np.all(getattr(law.sample, name) != 0.0), name


def test_restored_loop_continues_bit_for_bit():
    """The state vector is the complete state, so another controller can continue from it too."""
    law, arm = controller(quick()), plant(noise=1e-5, differenced=True, delay=2)
    record(law, arm, 1.337)
    saved, saved_arm = law.save(), arm.save()

    def rest_of(law):
        arm.restore(saved_arm)
        torques = []
        for k in range(1337, 2000):
            torques.append(law.update(k * 1e-3, 1e-3, arm.measure()).copy())
            arm.step(torques[-1])
        return np.array(torques)

    first = rest_of(law)
    law.restore(saved)
    other = controller(quick())
    other.restore(saved)

    np.testing.assert_array_equal(rest_of(law), first)
    np.testing.assert_array_equal(rest_of(other), first)
    assert np.any(saved != law.state_vector)


@numba.njit
def many_updates(model, sizes, settings, law, state, signals, measurement, sample, checks, count):
    for k in range(count):
        t = k * 1e-3
        update(model, sizes, settings, law, state, signals, t, 1e-3, measurement, sample, checks)


def test_updates_in_a_compiled_loop_allocate_nothing():
    """Passing the vectors allocates a little, independently of the number of updates."""
    law = controller(quick(window=50, learning_start=0.01, sigma=-1.0))
    measurement = np.array([*START, *np.zeros(4)])
    vectors = (
        law.settings.model,
        law.sizes,
        law.settings_vector,
        REFERENCE,
        law.state_vector,
        law.signals_vector,
    )
    arguments = (*vectors, measurement, law.sample_vector, law.checks_vector)
    many_updates(*arguments, 1)
    allocations = []
    _nrt_python.memsys_enable_stats()
    try:
        for count in (100, 5000):
            before = rtsys.get_allocation_stats()
            many_updates(*arguments, count)
            after = rtsys.get_allocation_stats()
            allocations.append((after.alloc - before.alloc, after.mi_alloc - before.mi_alloc))
    finally:
        _nrt_python.memsys_disable_stats()

    assert law.state.latched[0] == 1.0
    assert allocations[0] == allocations[1]


INTERPRETED = """
from closed_loop_case import controller, plant, quick, record
settings = quick(window=100, learning_start=0.2, sigma=-1.0)
print(*record(controller(settings), plant(), 0.4).torque[-1])
"""


def test_interpreted_kernels_compute_the_same_torque():
    """Without numba's compiler only the last bits differ (its libm, its order of operations)."""
    here = Path(__file__).parent
    environment = os.environ | {
        'NUMBA_DISABLE_JIT': '1',
        'PYTHONPATH': os.pathsep.join([str(here), str(here.parent)]),
    }
    run = subprocess.run(
        [sys.executable, '-c', INTERPRETED],
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )
    law = controller(quick(window=100, learning_start=0.2, sigma=-1.0))
    torque = record(law, plant(), 0.4).torque[-1]

    assert law.state.latched[0] == 1.0
    np.testing.assert_allclose(np.array(run.stdout.split(), dtype=float), torque, rtol=1e-9)


def test_first_update_starts_the_filter_at_the_virtual_control():
    """alpha2(0) = beta2(0) is set by the first sample, not by the constructor's warm-up."""
    law = controller(recommended())
    next(closed_loop(law, plant(), 1.0))
    np.testing.assert_array_equal(law.signals.dalpha2, 0.0)
    assert law.state.samples[0] == 1.0

# SPDX-License-Identifier: Apache-2.0
"""What the kernels compute with: accurate, and the same bits on every processor."""

import hashlib
import math
import os
import platform
import sys
from dataclasses import replace
from pathlib import Path

import mpmath
import numpy as np
import pytest
from command import OLDER, finished

from blf_dsc_controller.compiled import elementary
from blf_dsc_controller.compiled.algebra import independent_columns, inverse, product
from blf_dsc_controller.compiled.jit import kernel
from blf_dsc_controller.compiled.layout import pack
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.reference.terms import cubics, minimum_jerk
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.supervision.safe_torque import friction_torque, model_torque
from sim_plant.plant import plant_settings

PATH = os.pathsep.join(map(str, (Path(__file__).parent, Path(__file__).parents[1])))
RANDOM = np.random.default_rng(0)
FAR = 1.6e6  # rad, up to which sine and cosine are as accurate as near zero
ANGLES = np.concatenate(
    (
        RANDOM.uniform(-4.0, 4.0, 3000),
        RANDOM.uniform(-FAR, FAR, 3000),
        [float(k * mpmath.pi / 2) for k in RANDOM.integers(-1_000_000, 1_000_000, 3000).tolist()],
        np.ldexp(RANDOM.uniform(size=1000), RANDOM.integers(-1000, 0, 1000)),
        [0.0, math.pi / 4.0, math.pi / 2.0, math.pi, 5.706674932067741e5],
    )
)
"""Also those nearest to multiples of a right angle, where the most digits cancel."""
SMALL = np.concatenate(
    (RANDOM.uniform(-4.0, 4.0, 5000), np.ldexp(RANDOM.uniform(size=500), -np.arange(500)))
)
ARGUMENTS = {
    'sin': ANGLES,
    'cos': ANGLES,
    'exp': np.concatenate((SMALL, RANDOM.uniform(-708.0, 709.78, 5000))),
    'tanh': np.concatenate((SMALL, RANDOM.uniform(0.5, 0.6, 5000), [-30.0, 19.9, 20.1])),
}


@pytest.mark.parametrize('name', ARGUMENTS)
def test_functions_are_within_nine_tenths_of_a_unit_of_the_last_place(name):
    own, exact = getattr(elementary, name), getattr(mpmath, name)
    with mpmath.workprec(200):
        for x in map(float, ARGUMENTS[name]):
            expected = exact(mpmath.mpf(x))
            assert abs(own(x) - expected) <= 0.9 * math.ulp(float(expected)), x


def test_functions_at_the_ends_of_their_range():
    sin, cos, exp, tanh = (getattr(elementary, name) for name in ARGUMENTS)
    assert (sin(0.0), cos(0.0), exp(0.0), tanh(0.0)) == (0.0, 1.0, 1.0, 0.0)
    assert (exp(-math.inf), exp(-1e4), exp(710.0), exp(math.inf)) == (0.0, 0.0, math.inf, math.inf)
    assert (tanh(-math.inf), tanh(math.inf)) == (-1.0, 1.0)
    for function in (sin, cos):
        assert math.isnan(function(math.inf))
        assert function(2.0**50) == function(-1e300) == function(0.0)
        # Past 1.6e6 rad: of an angle at most a unit of the last place away.
        for x in (1e7, 1e10, 1e15):
            true = getattr(math, function.__name__)(x)
            assert function(x) == pytest.approx(true, abs=math.ulp(x))
    assert all(math.isnan(function(math.nan)) for function in (sin, cos, exp, tanh))


@kernel
def fill_all(x, out):
    for i in range(x.size):
        out[0, i] = elementary.sin(x[i])
        out[1, i] = elementary.cos(x[i])
        out[2, i] = elementary.exp(x[i])
        out[3, i] = elementary.tanh(x[i])
        out[4, i] = x[i] * out[0, i] + out[1, i]  # no fused operation, which would round once


def test_compiled_functions_give_the_bits_of_python():
    x = np.concatenate((ANGLES, ARGUMENTS['exp'], [math.inf, -math.inf, math.nan, 1e300]))
    compiled, interpreted = np.zeros((2, 5, x.size))
    fill_all(x, compiled)
    fill_all.py_func(x, interpreted)
    np.testing.assert_array_equal(compiled.view(np.int64), interpreted.view(np.int64))


def test_products_and_inverses_are_those_of_numpy():
    A, B = RANDOM.normal(size=(3, 5, 8)), RANDOM.normal(size=(3, 8, 4))
    np.testing.assert_allclose(product(A, B), A @ B, rtol=1e-13, atol=1e-14)
    M = A @ np.swapaxes(A, 1, 2)
    np.testing.assert_allclose(inverse(M) @ M, np.tile(np.eye(5), (3, 1, 1)), atol=1e-12)


def test_dependent_columns_are_sums_of_those_before_them():
    a, b, c = RANDOM.normal(size=(3, 20))
    Y = np.column_stack((a, b, a + 2.0 * b, c, 0.0 * a, 3.0 * c - b))
    kept, X = independent_columns(Y, 1e-6)
    assert kept.tolist() == [0, 1, 3]
    sums = [[1, 0, 1, 0, 0, 0], [0, 1, 2, 0, 0, -1], [0, 0, 0, 1, 0, 3]]
    np.testing.assert_allclose(X, sums, atol=1e-13)


def digests():
    """Return lines with digests of what is computed, from the parameters to closed loops."""
    lines, random = [], np.random.default_rng(1)

    def show(what, *arrays):
        digest = hashlib.sha256(np.concatenate([np.ravel(a) for a in arrays]).tobytes())
        lines.append(f'{what} {digest.hexdigest()}')

    x = np.concatenate(list(ARGUMENTS.values()))
    out = np.zeros((5, x.size))
    fill_all(x, out)
    show('functions', out)
    times, points = np.cumsum(random.uniform(0.1, 2.0, 30)), random.normal(size=(2, 30, 7))
    pieces = cubics(np.diff(times), points[:, :-1], points[:, 1:])
    show('references', minimum_jerk(times, points[0]).content, pieces)
    for preset in ('recommended', 'panda'):
        loop = load_loop(preset)
        lines.append(f'{preset} {flatten(loop.controller)}')
        record = simulate(loop.controller, replace(loop.plant, duration=0.2))
        controller = record.controller
        settings, P = controller.settings, controller.state.estimate
        show('parameters', controller.settings_vector, pack(plant_settings(loop.plant)))
        show('run', record.measurements, record.samples, record.truths, controller.state_vector)
        q, dq, ddq = random.normal(size=(3, settings.n))
        safe = model_torque(settings, P, q, dq, ddq), friction_torque(settings, P, dq)
        show('safe torque', *safe)
    return lines


PROCESSORS = {
    'older': OLDER,
    'newer': {'OPENBLAS_CORETYPE': 'SkylakeX'},
    'oldest': {'NUMBA_CPU_NAME': 'x86-64', 'NUMBA_CPU_FEATURES': ''},
}


@pytest.mark.skipif(platform.machine() != 'x86_64', reason='names processors of this kind')
@pytest.mark.parametrize(
    'processor', ['older', 'newer', pytest.param('oldest', marks=pytest.mark.nightly)]
)
def test_every_processor_computes_the_same_bits(processor):
    """With the versions of libm, BLAS and numpy's loops for other processors, and their code."""
    here = digests()  # compiles what the other process runs, too
    program = 'from test_compiled_numbers import digests; print(*digests(), sep="\\n")'
    environment = os.environ | {'PYTHONPATH': PATH} | PROCESSORS[processor]
    other = finished(sys.executable, '-c', program, env=environment)
    assert len(here) == 10
    assert other.stdout.splitlines() == here, other.stderr

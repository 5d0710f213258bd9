# SPDX-License-Identifier: Apache-2.0
"""Kernels: layouts of vectors, compilation, and a cache that tracks the files they depend on."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from pathlib import Path
from typing import Annotated, NamedTuple

import numba
import numpy as np
import pytest
from command import finished
from numba.core.errors import UnsupportedError
from shaken_arm import _shake

import blf_dsc_controller
from blf_dsc_controller.arms import batch
from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.compiled import jit
from blf_dsc_controller.compiled.layout import Array, Cell, Fixed, pack, size_of, sizes_of, view_of
from blf_dsc_controller.law.controller import update
from blf_dsc_controller.simulation.loop import run_loop
from sim_plant.kernels import step_plant

PACKAGE = Path(blf_dsc_controller.__file__).resolve().parent
LAW = {f'{PACKAGE.name}/law/{name}.py' for name in ('barrier', 'prediction', 'step', 'settings')}
PLANT = {f'sim_plant/{name}.py' for name in ('arm', 'drives', 'kernels', 'motion')}
REFERENCE = {f'{PACKAGE.name}/reference/terms.py'}
ALWAYS = {f'{PACKAGE.name}/{name}.py' for name in ('compiled/layout', 'arms/two_link')}


def names(kernel):
    return {str(path.relative_to(PACKAGE.parent)) for path in jit.dependencies(kernel)[0]}


def test_kernel_depends_on_the_files_and_constants_it_is_compiled_from():
    """Changing the plant does not recompile the law; changing the configuration, no kernel."""
    assert names(update) >= LAW | REFERENCE | ALWAYS
    assert names(run_loop) >= LAW | REFERENCE | PLANT | ALWAYS
    assert names(step_plant) >= PLANT | ALWAYS
    assert not names(update) & PLANT
    assert not names(step_plant) & (LAW | REFERENCE)
    assert not any('configuration' in name for name in names(run_loop))
    assert {'SUSPECT=1', 'OUTSIDE=2', 'LINEAR=1'} <= jit.dependencies(update)[1]
    outside = {path.name for path in jit.dependencies(_shake)[0]}  # a kernel of these tests
    assert outside >= {'shaken_arm.py', 'rigid_body.py', 'cholesky.py'}
    assert 'step.py' not in outside


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is cached')
@pytest.mark.parametrize('kernel', [update, run_loop, step_plant])
def test_cache_folder_of_a_kernel_follows_from_its_dependencies(kernel):
    """A kernel must be defined after what it calls, or edits would run stale machine code."""
    assert str(jit.cache_folder(kernel)) in kernel._cache.cache_path


COMPILE = """
import sys
import numpy as np
from blf_dsc_controller.arms import batch
from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.compiled.jit import announced_compilation

with announced_compilation(lambda text: print(text, file=sys.stderr)):
    H = batch.regressors_at(TwoLink(10.0), *np.full((4, 1, 2), 0.5))
print(float(H[0, 0, 0]), *(sum(batch._fill_regressors.stats[k].values()) for k in (1, 2)))
"""


def compiled_in(checkout, cache, **target):
    """Return an entry of a regressor, and how often its kernel was found and was compiled."""
    environment = {**os.environ, 'PYTHONPATH': str(checkout), 'NUMBA_CACHE_DIR': str(cache)}
    environment |= target
    run = finished(sys.executable, '-c', COMPILE, cwd=checkout, env=environment)
    entry, found, compiled = map(float, run.stdout.split())
    return entry, found, compiled


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
def test_second_checkout_finds_the_kernels_of_the_first_and_never_those_of_other_sources(tmp_path):
    first, second, cache = (tmp_path / name for name in ('first', 'second', 'cache'))
    for checkout in (first, second):
        for package in (PACKAGE, PACKAGE.parent / 'sim_plant'):
            unwanted = shutil.ignore_patterns('__pycache__')
            shutil.copytree(package, checkout / package.name, ignore=unwanted)
    entry, *counts = compiled_in(first, cache)
    assert counts == [0, 1]
    assert compiled_in(second, cache) == (entry, 1, 0)

    called = second / PACKAGE.name / 'arms/two_link.py'  # in another file than the kernel
    called.write_text(called.read_text().replace('H[0, 0] = a[0] +', 'H[0, 0] = 1.0 + a[0] +'))
    assert compiled_in(second, cache) == (pytest.approx(entry + 1.0), 0, 1)
    assert compiled_in(first, cache) == (entry, 1, 0)


@pytest.mark.skipif(platform.machine() != 'x86_64', reason='names processors of this kind')
@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
def test_code_for_a_named_processor_is_found_again_and_not_loaded_elsewhere(tmp_path):
    """As an image does that is compiled once for many computers."""
    checkout, named = PACKAGE.parent, {'NUMBA_CPU_NAME': 'x86-64', 'NUMBA_CPU_FEATURES': ''}
    entry, *counts = compiled_in(checkout, tmp_path, **named)
    assert counts == [0, 1]
    assert compiled_in(checkout, tmp_path, **named) == (entry, 1, 0)
    assert compiled_in(checkout, tmp_path) == (entry, 0, 1)


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
def test_kernels_compile_without_the_private_parts_of_numba(tmp_path):
    """Other releases may lack them: then it is slower, which is said, with the same numbers."""
    without = """
import sys
import numba.core.caching, numba.core.codegen
del numba.core.codegen.JITCodeLibrary
if sys.argv[1] == 'cache':
    del numba.core.caching.CompileResultCacheImpl
"""
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)}
    for lacking in ('linking', 'cache'):
        runs = [
            finished(sys.executable, '-c', without + COMPILE, lacking, env=environment)
            for _ in range(2)
        ]
        outputs = [[float(word) for word in run.stdout.split()] for run in runs]
        assert [counts for _, *counts in outputs] == [[0, 1], [1, 0]], runs
        slow = f'numba {numba.__version__} lacks what this package uses'
        assert [run.stderr.count(slow) for run in runs] == [1, 0]
        entry, *_ = outputs[0]
        H = batch.regressors_at(TwoLink(10.0), *np.full((4, 1, 2), 0.5))
        assert entry == H[0, 0, 0]


@jit.inner
def root(x):
    if x < 0.0:
        raise ValueError('no root of a negative number')
    return np.sqrt(x)


@jit.called
def sum_of_roots(values):
    total = 0.0
    for value in values:
        total += root(value)
    return total


@jit.kernel
def mean_root(values):
    return sum_of_roots(values) / values.size


def test_linked_functions_compute_and_raise():
    assert mean_root(np.array([1.0, 9.0])) == 2.0
    with pytest.raises(ValueError, match='no root of a negative number'):
        mean_root(np.array([1.0, -9.0]))


@jit.kernel
def allocating(x):
    return np.zeros(3)[0] + x


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='Python may allocate')
def test_kernel_that_allocates_an_array_is_rejected():
    with pytest.raises(UnsupportedError, match='the kernel allocating allocates an array'):
        allocating(1.0)


@jit.kernel
def fill_with_noise(rng, out):
    for i in range(out.size):
        out[i] = rng.standard_normal()


def test_kernel_releases_references_to_its_arguments():
    arguments = np.random.default_rng(1), np.zeros(3)
    fill_with_noise(*arguments)
    before = [sys.getrefcount(argument) for argument in arguments]
    for _ in range(3):
        fill_with_noise(*arguments)
    assert [sys.getrefcount(argument) for argument in arguments] == before


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


SHOW = """
from blf_dsc_controller.cli import run
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.law.controller import update
from blf_dsc_controller.reference.terms import _sample
from sim_plant.kernels import KERNELS

if __name__ == '__main__':  # the command has processes of its own
    config = load_loop('recommended')
    run._compile_law(config.controller)
    run._compile_plant(config.plant)
    for kernel in (update, _sample, *KERNELS):
        print(kernel.__name__, len(kernel.signatures))
    assert main(['precompile', '--config', 'recommended']) == 0
"""


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')
def test_command_compiles_every_kernel_that_a_node_calls():
    *kernels, said = finished(sys.executable, '-c', SHOW).stdout.splitlines()
    assert len(kernels) == 5
    assert all(int(line.split()[1]) >= 1 for line in kernels), kernels
    assert 'recommended: the kernels are compiled' in said

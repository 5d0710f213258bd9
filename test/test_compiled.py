# SPDX-License-Identifier: Apache-2.0
"""Kernels: their vectors, compilation and cache.

Accuracy, and the same bits everywhere.
"""

from __future__ import annotations

import hashlib
import math
import os
import pickle
import platform
import runpy
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import mpmath
import numba
import numpy as np
import plants
import pytest
from closed_loop_case import closed_loop, controller, quick
from command import OLDER, finished
from numba.core import event
from numba.core.errors import UnsupportedError
from planted import Planted
from random_arm import fill_states, random_urdf

import blf_dsc_controller
from blf_dsc_controller import BlfDscError, load_loop, simulate
from blf_dsc_controller.arms import model
from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.compiled import (
    announcement,
    dependencies,
    entry,
    jit,
    kernel_cache,
)
from blf_dsc_controller.compiled.layout import (
    Array,
    Cell,
    Passed,
    pack,
    size_of,
    view_of,
)
from blf_dsc_controller.configuration import nodes
from blf_dsc_controller.configuration.law_file import load_law
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.control import arm_controller
from blf_dsc_controller.law import called_law
from blf_dsc_controller.law.laws import for_law
from blf_dsc_controller.law.step import update
from blf_dsc_controller.numerics import elementary
from blf_dsc_controller.numerics.algebra import independent_columns, inverse, product
from blf_dsc_controller.reference.terms import cubics, minimum_jerk
from blf_dsc_controller.simulation import loop
from blf_dsc_controller.studies.laws import COMPUTED_TORQUE
from blf_dsc_controller.supervision.model_torque import friction_torque, model_torque
from sim_plant.kernels import run_plant
from sim_plant.settings import plant_settings

PACKAGE = Path(blf_dsc_controller.__file__).resolve().parent


def sources(*names):
    return {f'{PACKAGE.name}/{name}.py' for name in names}


LAW = sources(
    'law/barrier', 'law/prediction', 'law/step', 'law/state', 'reference/terms'
)
PLANT = {f'sim_plant/{name}.py' for name in ('arm', 'kernels', 'motion')}
ALWAYS = sources('compiled/layout', 'arms/two_link')


def names(kernel):
    return {
        str(path.relative_to(PACKAGE.parent))
        for path in dependencies.dependencies(kernel)[0]
    }


compiling = pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')


def test_kernel_depends_on_the_files_and_constants_it_is_compiled_from():
    """Changing the plant does not recompile the law.

    Changing the configuration, no kernel.
    """
    for kernel, needed, foreign in (
        (update, LAW, PLANT),
        (run_plant, PLANT, LAW),
    ):
        assert names(kernel) >= needed | ALWAYS
        assert not names(kernel) & foreign
    assert not any('configuration' in name for name in names(update))
    assert {'SUSPECT=1', 'OUTSIDE=2', 'LEVEL_CUT=1.0'} <= dependencies.dependencies(
        update
    )[1]
    # a kernel of these tests
    outside = {path.name for path in dependencies.dependencies(fill_states)[0]}
    assert outside >= {'random_arm.py', 'arm.py', 'algebra.py'}
    assert 'controller.py' not in outside


class OwnLaw(NamedTuple):
    gain: float

    def compute_demand(self, _settings, _state, signals, _t, _dt):
        signals.demand[:] = -self.gain * signals.xi1

    def finish(self, *_):
        pass


def test_kernel_of_a_law_depends_on_its_file_and_on_no_other_law(monkeypatch):
    """Whatever laws were loaded before: each would else be compiled again."""
    monkeypatch.setattr(kernel_cache, 'KERNELS', [])
    function = update.py_func
    packaged = kernel_cache.cache_folder(function)
    own = kernel_cache.cache_folder(function, OwnLaw)
    assert Path(__file__) not in dependencies.dependencies(function)[0]
    assert Path(__file__) in dependencies.dependencies(function, OwnLaw)[0]
    for_law(update, load_law(COMPUTED_TORQUE)(1.0, 1.0, 1.0))
    assert str(own) in for_law(update, OwnLaw(1.0))._cache.cache_path
    assert kernel_cache.cache_folder(function) == packaged
    assert kernel_cache.cache_folder(function, OwnLaw) == own
    for method in called_law._methods(OwnLaw, 'gains[0]'):
        own = kernel_cache.cache_folder(method.py_func, OwnLaw)
        assert str(own) in method._cache.cache_path
        files, _ = dependencies.dependencies(method.py_func, OwnLaw)
        assert Path(__file__) in files
        assert names(method) >= sources('law/state', 'law/called_law')


FOLDERS = """
from blf_dsc_controller.compiled import kernel_cache
from blf_dsc_controller.law.step import update
from blf_dsc_controller.law.perception import weigh
from sim_plant.kernels import run_plant

assert {update, weigh, run_plant} <= {*kernel_cache.KERNELS}
for kernel in kernel_cache.KERNELS:
    assert str(kernel_cache.cache_folder(kernel)) in kernel._cache.cache_path, kernel
"""


@compiling
def test_cache_folders_of_kernels_follow_from_their_dependencies():
    """A kernel must be defined after what it calls, or edits would run stale machine code."""
    checked = finished(sys.executable, '-c', FOLDERS)
    assert checked.returncode == 0, checked.stderr


COMPILE = """
import sys
import numpy as np
from blf_dsc_controller.arms import model
from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.compiled import announcement, kernel_cache

with announcement.announced_compilation(lambda text: print(text, file=sys.stderr)):
    H = model.regressors_at(TwoLink(10.0), *np.full((4, 1, 2), 0.5))
(filled,) = [k for k in kernel_cache.KERNELS if k.__name__ == '_fill_regressors']
print(float(H[0, 0, 0]), *(sum(filled.stats[k].values()) for k in (1, 2)))
"""


def compiled_in(checkout, cache, ending=''):
    """Return an entry of a regressor, and how often its kernel was found and was compiled.

    Only what is compiled needs the part of numba that knows how to.
    """
    paths = {'PYTHONPATH': str(checkout), 'NUMBA_CACHE_DIR': str(cache)}
    environment = os.environ | paths
    code = f"{COMPILE}{ending}\nprint('numba.np.npyimpl' in sys.modules)"
    run = finished(sys.executable, '-c', code, cwd=checkout, env=environment)
    *numbers, loaded = run.stdout.split()
    entry, found, compiled = map(float, numbers)
    assert loaded == str(compiled > 0), run.stderr
    return entry, found, compiled


@compiling
def test_kernels_of_another_checkout_or_of_the_package_are_found_and_never_of_other_sources(
    tmp_path,
):
    first, second, cache, unused = (
        tmp_path / name for name in ('first', 'second', 'a', 'b')
    )
    for checkout in (first, second):
        for package in (PACKAGE, PACKAGE.parent / 'sim_plant'):
            unwanted = shutil.ignore_patterns('__pycache__', 'kernels')
            shutil.copytree(package, checkout / package.name, ignore=unwanted)
    entry, *counts = compiled_in(first, cache, ending='kernel_cache.ship()')
    assert counts == [0, 1]
    assert compiled_in(second, cache) == (entry, 1, 0)
    shipped = first / PACKAGE.name / 'compiled/kernels'
    before = sorted(shipped.rglob('*'))
    assert compiled_in(first, unused) == (entry, 1, 0)
    assert not list(unused.rglob('*.nb?'))

    # there are kernels of the sources before in the package and in the cache
    other = pytest.approx(entry + 1.0)
    called = first / PACKAGE.name / 'arms/two_link.py'  # not the kernel's own file
    called.write_text(
        called.read_text().replace('H[0, 0] = a[0] +', 'H[0, 0] = 1.0 + a[0] +')
    )
    assert compiled_in(first, cache) == (other, 0, 1)
    assert compiled_in(first, cache) == (other, 1, 0)
    assert sorted(shipped.rglob('*')) == before


@compiling
@pytest.mark.parametrize(
    ('module', 'name'),
    [
        (numba.core.codegen, 'JITCodeLibrary'),
        (numba.core.caching, 'CompileResultCacheImpl'),
        (numba, None),
    ],
    ids=['library', 'cache', 'release'],
)
def test_whatever_is_not_known_of_numba_is_one_import_error(module, name, monkeypatch):
    """So that nothing is compiled by half of its private parts: see the next test."""
    if name:
        monkeypatch.delattr(module, name, raising=False)
    else:
        other = numba.version_info._replace(short=(9, 0))
        monkeypatch.setattr(numba, 'version_info', other)
    with pytest.raises(ImportError):
        runpy.run_path(Path(jit.__file__).with_name('linked.py'))


SAMPLE = """
from blf_dsc_controller.reference.terms import minimum_jerk, pack, sampled

motion = minimum_jerk(np.array([0.0, 1.0]), np.array([[0.0], [1.0]]))
print(*sampled(pack(1, [motion]), np.array([0.5])).ravel().tolist())
"""


@compiling
def test_kernels_compile_without_the_private_parts_of_numba(tmp_path):
    """Other releases may lack them: then it is slower, which is said, with the same numbers."""
    H = model.regressors_at(TwoLink(10.0), *np.full((4, 1, 2), 0.5))
    slow = f'numba {numba.__version__} lacks what this package uses'
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)}
    lacking = 'import numba.core.codegen\ndel numba.core.codegen.JITCodeLibrary\n'
    for counts, said in (([0, 1], 1), ([1, 0], 0)):
        run = finished(
            sys.executable, '-c', lacking + COMPILE + SAMPLE, env=environment
        )
        entries, motion = run.stdout.splitlines()
        assert [float(word) for word in entries.split()] == [H[0, 0, 0], *counts]
        # half of the way, at 15/8 of the mean velocity, without acceleration
        halfway = pytest.approx([0.5, 1.875, 0.0], abs=1e-14)
        assert [float(word) for word in motion.split()] == halfway
        assert run.stderr.count(slow) == said


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
def sum_of_means(mean, rows):
    total = 0.0
    for i in range(rows.shape[0]):
        total += entry.invoke(mean, rows[i])
    return total


def test_kernel_calls_a_kernel_by_its_address():
    """It computes the same as in Python, and raises what the kernel raises."""
    rows = np.array([[1.0, 9.0], [4.0, 16.0]])
    mean = entry.Entry(mean_root, rows[0])
    assert sum_of_means(mean, rows) == 5.0
    assert sum_of_means.py_func(mean, rows) == 5.0
    with pytest.raises(ValueError, match='no root of a negative number'):
        sum_of_means(mean, -rows)


def test_kernels_of_two_laws_with_the_same_name_are_told_apart():
    """Or the loop of the first would be called with the second, whose type it rejects."""
    laws = [NamedTuple('Law', [('gain', float)]) for _ in range(2)]
    first, other = (
        entry.EntryType(numba.types.none(numba.typeof(law(1.0)))) for law in laws
    )
    assert str(first) == str(other)
    assert first != other
    assert first == entry.EntryType(numba.types.none(numba.typeof(laws[0](2.0))))


@jit.kernel
def allocating(x):
    return np.zeros(3)[0] + x


@compiling
def test_kernel_that_allocates_an_array_is_rejected():
    with pytest.raises(
        UnsupportedError, match='the kernel allocating allocates an array'
    ):
        allocating(1.0)


@jit.kernel
def copy(given, out):
    for i in range(out.size):
        out[i] = given[i]


def test_kernel_releases_references_to_its_arguments():
    arguments = np.ones(3), np.zeros(3)
    copy(*arguments)
    before = [sys.getrefcount(argument) for argument in arguments]
    for _ in range(3):
        copy(*arguments)
    assert [sys.getrefcount(argument) for argument in arguments] == before


class Motor(NamedTuple):
    limit: Annotated[Array, 'joints']
    delay: int


class Sized(NamedTuple):
    joints: Passed
    columns: int
    period: float
    count: int
    motor: Motor
    gains: Annotated[Array, 'joints', 'columns + 1']
    delayed: Annotated[Array, 'motor.delay']


class State(NamedTuple):
    count: Cell
    ring: Annotated[Array, 'motor.delay', 'joints']
    motor: Motor


sized_of = view_of(Sized)
state_of = view_of(State)
state_size = size_of(State)


def advance(vector, joints, state_vector):
    settings = sized_of(vector, joints)
    state = state_of(state_vector, settings)
    state.count[0] += settings.period
    state.ring[settings.motor.delay - 1, settings.joints - 1] = settings.gains[
        0, settings.columns
    ]
    return settings.motor.limit.sum() + settings.count + settings.delayed.sum()


compiled_advance = jit.kernel(advance)


def test_kernels_and_python_see_the_same_layout_of_every_size():
    """One compiled kernel serves all sizes."""
    for joints, columns, count in [(1, 0, 5), (2, 3, 5), (2, 3, 6), (7, 300, 5)]:
        gains = np.arange(1.0, 1.0 + joints * (columns + 1)).reshape(
            joints, columns + 1
        )
        sized = Sized(
            joints, columns, 0.5, count, Motor(np.arange(joints), 4), gains, np.ones(4)
        )
        vector = pack(sized)
        assert vector.size == 4 + joints + gains.size + 4
        view = sized_of(vector, joints)
        assert view[:4] == (joints, columns, 0.5, count)
        np.testing.assert_array_equal(view.gains, gains)
        np.testing.assert_array_equal(view.delayed, np.ones(4))
        for function in (advance, compiled_advance):
            state = np.zeros(state_size(view))
            assert function(vector, joints, state) == sum(range(joints)) + count + 4
            last = 1 + 4 * joints - 1
            assert (state[0], state[last]) == (0.5, columns + 1.0)
            assert np.count_nonzero(state) == 2
    assert len(compiled_advance.signatures) == (0 if numba.config.DISABLE_JIT else 1)


SHOW = """
import sys
from pathlib import Path
from blf_dsc_controller.cli import compilation as run
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.compiled import kernel_cache
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.law.step import update
from sim_plant.kernels import run_plant

if __name__ == '__main__':  # the command has processes of its own
    config = load_loop('recommended')
    run.compile_kernels(config.controller)
    run.compile_kernels(config.plant)
    named = {each.__name__: each for each in kernel_cache.KERNELS}
    for kernel in (update, run_plant, named['_read'], named['_sample']):
        print(kernel.__name__, len(kernel.signatures))
    kernel_cache.SHIPPED = Path(sys.argv[1])
    assert main(['doctor', '--compile', 'package']) == 0
    run._compile_side_by_side = lambda *_: None  # it was seen to work
    assert main(['doctor', '--compile', '--config', 'recommended']) == 0
    for kernel in (update, run_plant):
        assert list(kernel_cache.SHIPPED.glob(f'*/*.{kernel.__name__}-*.nbc')), kernel
"""


ANY_ARM = """
import sys
import numpy as np
import blf_dsc_controller as blf
from blf_dsc_controller.cli import compilation as run
from blf_dsc_controller.compiled import kernel_cache
from sim_plant.kernels import run_plant

def signatures():
    kernels = kernel_cache.KERNELS
    return {(each.__name__, found) for each in kernels for found in each.signatures}

first, *others = (blf.load_loop(path) for path in sys.argv[1:])
run.compile_kernels(first.controller)
run.compile_kernels(first.plant)
known = signatures()
assert len(known) >= 7, known
for arm in (first, *others):
    n = len(arm.controller.joints)
    run.compile_kernels(arm.plant)
    with blf.ArmController(arm.controller) as controller:
        for k in range(200):
            controller.update(0.001 * k, np.full(n, 0.3), np.zeros(n), np.zeros(n))
    print(n, sorted(signatures() - known))
"""
ARM = """
/**:
  ros__parameters:
    robot: {{urdf: {urdf}, tip: tip, lag: 0.005{drive}}}
/**/blf_dsc_controller:
  ros__parameters:
    joints: {joints}
    barrier: {{bound: {bound}}}
/**/sim_plant:
  ros__parameters:
    joints: {joints}
"""


@compiling
def test_kernels_of_one_urdf_are_those_of_every_other_arm(tmp_path):
    """So that a package with the kernels of a Panda compiles nothing for an arm never seen."""
    paths = []
    for n, drive in ((2, ''), (9, f', viscous: {[1.0] * 9}, payload: 0.0')):
        text, joints = random_urdf(n, seed=n)
        urdf = tmp_path / f'{n}.urdf'
        urdf.write_text(text)
        values = {'joints': [*joints], 'bound': [0.1] * n, 'drive': drive}
        paths.append(tmp_path / f'{n}.yaml')
        paths[-1].write_text(ARM.format(urdf=urdf, **values))
    run = finished(sys.executable, '-c', ANY_ARM, 'panda_rigid', 'ur5e_rigid', *paths)
    assert run.stdout.splitlines() == [f'{n} []' for n in (7, 6, 2, 9)], run.stderr


SHARED = """
import os
os.umask(0o002)  # as on Ubuntu: what is made, the group can write
from blf_dsc_controller.compiled import jit

@jit.kernel
def twice(x):
    return 2.0 * x

assert twice(1.0) == 2.0
print(*(sum(twice.stats[k].values()) for k in (1, 2)))
"""


@pytest.fixture
def found_and_compiled(tmp_path):
    """Run a kernel, cached in `tmp_path`; return how often it is found and compiled."""
    script = tmp_path / 'shared.py'
    script.write_text(SHARED)
    paths = {'NUMBA_CACHE_DIR': str(tmp_path / 'cache')}
    environment = os.environ | paths | {'PYTHONPATH': str(PACKAGE.parent)}

    def found_and_compiled():
        run = finished(sys.executable, script, env=environment)
        assert run.returncode == 0, run.stderr
        return run.stdout.split()

    return found_and_compiled


@compiling
@pytest.mark.parametrize(
    'content',
    [pickle.dumps(numba.__version__) + b'cblf_dsc_controller.errors\nGone\n.', b''],
    ids=['type of another release', 'cut'],
)
def test_index_that_cannot_be_read_is_replaced(tmp_path, found_and_compiled, content):
    assert found_and_compiled() == ['0', '1']
    (index,) = tmp_path.glob('cache/*/*twice*.nbi')
    index.write_bytes(content)
    assert found_and_compiled() == ['0', '1']
    assert found_and_compiled() == ['1', '0']


@compiling
def test_machine_code_is_stored_with_its_symbols_alone_and_replaced_if_it_is_cut(
    tmp_path, found_and_compiled
):
    assert found_and_compiled() == ['0', '1']
    (stored,) = tmp_path.glob('cache/*/*twice*.nbc')
    whole = stored.read_bytes()
    assert b'is called by its Entry alone' in whole
    stored.write_bytes(whole[: len(whole) // 2])
    assert found_and_compiled() == ['0', '1']
    assert found_and_compiled() == ['1', '0']


@compiling
def test_machine_code_that_others_could_write_is_not_read_but_replaced(
    tmp_path, found_and_compiled
):
    assert found_and_compiled() == ['0', '1']
    (index,) = tmp_path.glob('cache/*/*twice*.nbi')
    assert index.parent.stat().st_mode & 0o777 == 0o700
    mark = tmp_path / 'was read'
    index.parent.chmod(0o770)
    index.write_bytes(pickle.dumps(numba.__version__) + pickle.dumps(Planted(mark)))
    assert found_and_compiled() == ['0', '1']
    assert found_and_compiled() == ['1', '0']
    assert not mark.exists()


def test_machine_code_is_loaded_only_from_a_folder_that_nobody_else_can_write(
    tmp_path, monkeypatch
):
    for place in ('XDG_CACHE_HOME', 'TMPDIR'):
        monkeypatch.setenv(place, str(tmp_path / place))
    (tmp_path / 'TMPDIR').mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', None)
    own = tmp_path / 'own'
    everybodys = tmp_path / 'everybodys'
    everybodys.mkdir()
    everybodys.chmod(0o1777)
    base = kernel_cache._base.__wrapped__
    inside = everybodys / f'blf_dsc_controller-{os.getuid()}'
    assert (base(str(own)), base(str(everybodys))) == (own, inside)
    assert inside.stat().st_mode & 0o777 == 0o700
    inside.chmod(0o770)
    users = tmp_path / 'XDG_CACHE_HOME' / 'blf_dsc_controller'
    assert base(str(everybodys)) == users

    # Everything there so far is another user's.
    uid = os.getuid() + 1
    monkeypatch.setattr(os, 'getuid', lambda: uid)
    (everybodys / f'blf_dsc_controller-{uid}').mkdir(mode=0o700)
    elsewhere = base(str(everybodys))
    assert not elsewhere.is_relative_to(everybodys)
    assert not elsewhere.is_relative_to(tmp_path / 'XDG_CACHE_HOME')


@compiling
def test_command_compiles_every_kernel_that_a_node_calls(tmp_path):
    *kernels, copied, said = finished(
        sys.executable, '-c', SHOW, tmp_path
    ).stdout.splitlines()
    assert len(kernels) == 4
    assert all(int(line.split()[1]) >= 1 for line in kernels), kernels
    assert 'recommended: the kernels are compiled' in said
    assert copied.startswith(f'recommended: the kernels are in {tmp_path}')


PATH = os.pathsep.join(map(str, (Path(__file__).parent, Path(__file__).parents[1])))
RANDOM = np.random.default_rng(0)
FAR = 1.6e6  # rad, up to which sine and cosine are as accurate as near zero
ANGLES = np.concatenate(
    (
        RANDOM.uniform(-4.0, 4.0, 3000),
        RANDOM.uniform(-FAR, FAR, 3000),
        [
            float(k * mpmath.pi / 2)
            for k in RANDOM.integers(-1_000_000, 1_000_000, 3000).tolist()
        ],
        np.ldexp(RANDOM.uniform(size=1000), RANDOM.integers(-1000, 0, 1000)),
        [0.0, math.pi / 4.0, math.pi / 2.0, math.pi, 5.706674932067741e5],
    )
)
"""Also those nearest to multiples of a right angle, where the most digits cancel."""
SMALL = np.concatenate(
    (
        RANDOM.uniform(-4.0, 4.0, 5000),
        np.ldexp(RANDOM.uniform(size=500), -np.arange(500)),
    )
)
ARGUMENTS = {
    'sin': ANGLES,
    'cos': ANGLES,
    'exp': np.concatenate((SMALL, RANDOM.uniform(-708.0, 709.78, 5000))),
    'tanh': np.concatenate(
        (SMALL, RANDOM.uniform(0.5, 0.6, 5000), [-30.0, 19.9, 20.1])
    ),
}


@pytest.mark.parametrize('name', ARGUMENTS)
def test_functions_are_within_nine_tenths_of_a_unit_of_the_last_place(name):
    own = getattr(elementary, name)
    exact = getattr(mpmath, name)
    with mpmath.workprec(200):
        for x in map(float, ARGUMENTS[name]):
            expected = exact(mpmath.mpf(x))
            assert abs(own(x) - expected) <= 0.9 * math.ulp(float(expected)), x


def test_functions_at_the_ends_of_their_range():
    sin, cos, exp, tanh = (getattr(elementary, name) for name in ARGUMENTS)
    assert (sin(0.0), cos(0.0), exp(0.0), tanh(0.0)) == (0.0, 1.0, 1.0, 0.0)
    assert (exp(-math.inf), exp(-1e4), exp(710.0), exp(math.inf)) == (
        0.0,
        0.0,
        math.inf,
        math.inf,
    )
    assert (tanh(-math.inf), tanh(math.inf)) == (-1.0, 1.0)
    for function in (sin, cos):
        assert math.isnan(function(math.inf))
        assert function(2.0**50) == function(-1e300) == function(0.0)
        # Past 1.6e6 rad: of an angle at most a unit of the last place away.
        for x in (1e7, 1e10, 1e15):
            true = getattr(math, function.__name__)(x)
            assert function(x) == pytest.approx(true, abs=math.ulp(x))
    assert all(math.isnan(function(math.nan)) for function in (sin, cos, exp, tanh))


@jit.kernel
def fill_all(x, out):
    for i in range(x.size):
        out[0, i] = elementary.sin(x[i])
        out[1, i] = elementary.cos(x[i])
        out[2, i] = elementary.exp(x[i])
        out[3, i] = elementary.tanh(x[i])
        # no fused operation, which would round once
        out[4, i] = x[i] * out[0, i] + out[1, i]


def test_compiled_functions_give_the_bits_of_python():
    x = np.concatenate(
        (ANGLES, ARGUMENTS['exp'], [math.inf, -math.inf, math.nan, 1e300])
    )
    compiled, interpreted = np.zeros((2, 5, x.size))
    fill_all(x, compiled)
    fill_all.py_func(x, interpreted)
    np.testing.assert_array_equal(compiled.view(np.int64), interpreted.view(np.int64))


def test_products_and_inverses_are_those_of_numpy():
    A = RANDOM.normal(size=(3, 5, 8))
    B = RANDOM.normal(size=(3, 8, 4))
    np.testing.assert_allclose(product(A, B), A @ B, rtol=1e-13, atol=1e-14)
    M = A @ np.swapaxes(A, 1, 2)
    np.testing.assert_allclose(
        inverse(M) @ M, np.tile(np.eye(5), (3, 1, 1)), atol=1e-12
    )


def test_dependent_columns_are_sums_of_those_before_them():
    a, b, c = RANDOM.normal(size=(3, 20))
    Y = np.column_stack((a, b, a + 2.0 * b, c, 0.0 * a, 3.0 * c - b))
    kept, X = independent_columns(Y, 1e-6)
    assert kept.tolist() == [0, 1, 3]
    sums = [[1, 0, 1, 0, 0, 0], [0, 1, 2, 0, 0, -1], [0, 0, 0, 1, 0, 3]]
    np.testing.assert_allclose(X, sums, atol=1e-13)


def learned_torque():
    """Return the last torque of a loop that learns, with every imperfection of the plant."""
    law = controller(quick(window=100, learning_start=0.2, sigma=-1.0))
    list(closed_loop(law, plants.plant(**plants.FULL), 0.4))
    assert law.state.latch.latched[0] == 1.0
    return law.signals.torque.tolist()


def test_interpreted_kernels_compute_the_same():
    """Without numba's compiler only the last bits differ (its libm, its order of operations)."""
    program = 'from test_compiled import learned_torque; print(*learned_torque())'
    environment = os.environ | {'NUMBA_DISABLE_JIT': '1', 'PYTHONPATH': PATH}
    interpreted = finished(
        sys.executable, '-c', program, env=environment
    ).stdout.split()
    np.testing.assert_allclose(
        np.array(interpreted, float), learned_torque(), rtol=1e-9
    )


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
    times = np.cumsum(random.uniform(0.1, 2.0, 30))
    points = random.normal(size=(2, 30, 7))
    pieces = cubics(np.diff(times), points[:, :-1], points[:, 1:])
    show('references', minimum_jerk(times, points[0]).content, pieces)
    for preset in ('recommended', 'panda_rigid'):
        loop = load_loop(preset)
        lines.append(f'{preset} {flatten(loop.controller)}')
        record = simulate(loop.controller, replace(loop.plant, duration=0.2))
        controller = record.controller
        settings = controller.settings
        P = controller.state.estimate
        show('parameters', controller.settings_vector, pack(plant_settings(loop.plant)))
        show(
            'run',
            record.measurements,
            record.samples,
            record.truths,
            controller.state_vector,
        )
        q, dq, ddq = random.normal(size=(3, settings.n))
        tau = model_torque(settings, P, q, dq, ddq)
        show('safe torque', tau, friction_torque(settings, P, dq, tau))
    return lines


# OpenBLAS runs code for another processor as it is told to: AVX-512 ends a process without it.
_HAS_AVX512 = 'avx512f' in Path('/proc/cpuinfo').read_text(encoding='utf-8').split()
NEWER = ('newer',) if _HAS_AVX512 else ()
PROCESSORS = {
    'older': OLDER,
    'newer': {'OPENBLAS_CORETYPE': 'SkylakeX'},
    'oldest': {'NUMBA_CPU_NAME': 'x86-64', 'NUMBA_CPU_FEATURES': ''},
}


@pytest.mark.skipif(
    platform.machine() != 'x86_64', reason='names processors of this kind'
)
@pytest.mark.parametrize(
    'processor',
    ['older', *NEWER, pytest.param('oldest', marks=pytest.mark.nightly)],
)
def test_every_processor_computes_the_same_bits(processor):
    """With the versions of libm, BLAS and numpy's loops for other processors, and their code."""
    here = digests()  # compiles what the other process runs, too
    program = 'from test_compiled import digests; print(*digests(), sep="\\n")'
    environment = os.environ | {'PYTHONPATH': PATH} | PROCESSORS[processor]
    other = finished(sys.executable, '-c', program, env=environment)
    assert len(here) == 10
    assert other.stdout.splitlines() == here, other.stderr


@pytest.mark.skipif(
    numba.config.CPU_NAME != 'x86-64-v3', reason='another processor, or one is named'
)
def test_kernels_are_for_the_same_processors_when_numba_reads_its_environment_again(
    monkeypatch,
):
    """Before each compilation, if it has changed: kernels in the cache would not be found."""
    monkeypatch.setenv('NUMBA_HIGHLIGHT_DUMPS', '0')
    numba.config.reload_config()
    assert numba.config.CPU_NAME == 'x86-64-v3'


@pytest.mark.parametrize(
    ('module', 'first', 'name', 'arguments'),
    [
        (nodes, '_load_all', 'load_loop', ('recommended',)),
        (loop, 'plant_of', 'simulate', ()),
        (arm_controller, 'GuardedLoop', 'ArmController', ('recommended',)),
    ],
)
def test_log_tells_a_caller_from_python_what_is_compiled(
    module, first, name, arguments, monkeypatch, caplog
):
    """Nothing else would tell why a first call takes a minute."""
    if name == 'simulate':
        given = load_loop('recommended')
        arguments = given.controller, given.plant
    kernel = kernel_cache.KERNELS[0]

    def compiles(*_given, **_named):
        with event.trigger_event('numba:compile', data={'dispatcher': kernel}):
            raise BlfDscError('compiled')

    monkeypatch.setattr(module, first, compiles)
    with pytest.raises(BlfDscError, match='compiled'):
        getattr(module, name)(*arguments)
    (record,) = caplog.records
    assert record.levelname == 'WARNING'
    assert record.getMessage().startswith('compiling kernel 1 of at most ')

    caplog.clear()
    notices = []
    with (
        announcement.announced_compilation(notices.append),
        pytest.raises(BlfDscError, match='compiled'),
    ):
        getattr(module, name)(*arguments)
    assert len(notices) == 1
    assert not caplog.records


RACE = """
import sys, time
from blf_dsc_controller.compiled import announcement, jit

@jit.kernel
def slow(x):
    total = 0.0
    for k in range(3):
        total += x ** k
    return total

notices = []
with announcement.announced_compilation(notices.append):
    print('ready', flush=True)
    sys.stdin.readline()
    slow(1.0)
print(len([text for text in notices if text.startswith(announcement.COMPILING)]))
"""


@compiling
def test_of_processes_that_need_a_kernel_at_once_one_compiles_it(tmp_path):
    script = tmp_path / 'race.py'
    script.write_text(RACE)
    environment = os.environ | {
        'NUMBA_CACHE_DIR': str(tmp_path / 'cache'),
        'PYTHONPATH': str(Path(__file__).parents[1]),
    }
    processes = [
        subprocess.Popen(
            [sys.executable, script],
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        for _ in range(3)
    ]
    for each in processes:
        assert each.stdout.readline() == 'ready\n'
    for each in processes:
        each.stdin.write('go\n')
        each.stdin.flush()
    compiled = [int(each.communicate(timeout=300)[0]) for each in processes]
    assert sorted(compiled) == [0, 0, 1]

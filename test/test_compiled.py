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
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import mpmath
import numba
import numpy as np
import pytest
from command import OLDER, finished
from nights import at_night
from numba.core.errors import UnsupportedError
from planted import Planted
from random_arm import random_urdf

import blf_dsc_controller
from blf_dsc_controller import load_loop, simulate
from blf_dsc_controller.compiled import (
    jit,
    kernel_cache,
)
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.numerics import elementary

PACKAGE = Path(blf_dsc_controller.__file__).resolve().parent


compiling = pytest.mark.skipif(numba.config.DISABLE_JIT, reason='nothing is compiled')


FOLDERS = """
from blf_dsc_controller.compiled import kernel_cache
from blf_dsc_controller.law.step import update
from blf_dsc_controller.law.perception import estimate_payload
from sim_plant.kernels import run_plant

assert {update, estimate_payload, run_plant} <= {*kernel_cache.KERNELS}
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


WAIT = """
import fcntl
import numpy as np
from blf_dsc_controller.arms import model
from blf_dsc_controller.arms.two_link import TwoLink
from blf_dsc_controller.compiled import announcement, kernel_cache

(kernel,) = [k for k in kernel_cache.KERNELS if k.__name__ == '_fill_regressors']
folder = kernel_cache.cache_folder(kernel)
folder.mkdir(mode=0o700, parents=True)
held = (folder / '_fill_regressors.lock').open('ab')
fcntl.flock(held, fcntl.LOCK_EX)

def say(text):
    print(text)
    held.close()

with announcement.announced_compilation(say):
    model.regressors_at(TwoLink(10.0), *np.full((4, 1, 2), 0.5))
"""


@compiling
def test_who_waits_for_kernels_of_another_process_says_so(tmp_path):
    environment = os.environ | {'NUMBA_CACHE_DIR': str(tmp_path)}
    run = finished(sys.executable, '-c', WAIT, env=environment)
    assert run.stdout.splitlines() == [
        'compiling kernel fill regressors in another process: waiting for it',
        'compiling kernel fill regressors, once for this version and kind of arm',
    ], run.stderr


SAMPLE = """
from blf_dsc_controller.reference.terms import minimum_jerk, pack, sampled

motion = minimum_jerk(np.array([0.0, 1.0]), np.array([[0.0], [1.0]]))
print(*sampled(pack(1, [motion]), np.array([0.5])).ravel().tolist())
"""


@compiling
def test_kernels_compile_without_the_private_parts_of_numba(tmp_path):
    """Other releases may lack them: then it is slower, which is said, with the same numbers."""
    entry = pytest.approx(0.5 + 10.0 * math.cos(0.5), abs=1e-14)
    slow = f'numba {numba.__version__} lacks what this package uses'
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(tmp_path)}
    lacking = 'import numba.core.codegen\ndel numba.core.codegen.JITCodeLibrary\n'
    for counts, said in (([0, 1], 1), ([1, 0], 0)):
        run = finished(
            sys.executable, '-c', lacking + COMPILE + SAMPLE, env=environment
        )
        entries, motion = run.stdout.splitlines()
        assert [float(word) for word in entries.split()] == [entry, *counts]
        # half of the way, at 15/8 of the mean velocity, without acceleration
        halfway = pytest.approx([0.5, 1.875, 0.0], abs=1e-14)
        assert [float(word) for word in motion.split()] == halfway
        assert run.stderr.count(slow) == said


@jit.kernel
def allocating(x):
    return np.zeros(3)[0] + x


@compiling
def test_kernel_that_allocates_an_array_is_rejected():
    with pytest.raises(
        UnsupportedError, match='the kernel allocating allocates an array'
    ):
        allocating(1.0)


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
    [
        pickle.dumps(numba.__version__) + b'cblf_dsc_controller.errors\nGone\n.',
        *at_night(b''),
    ],
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


def digests():
    """Return lines with digests of what is computed, from the parameters to closed loops."""
    lines = []

    def show(what, *arrays):
        digest = hashlib.sha256(np.concatenate([np.ravel(a) for a in arrays]).tobytes())
        lines.append(f'{what} {digest.hexdigest()}')

    x = np.concatenate(list(ARGUMENTS.values()))
    out = np.zeros((5, x.size))
    fill_all(x, out)
    show('functions', out)
    for preset in ('recommended', 'panda_rigid'):
        loop = load_loop(preset)
        lines.append(f'{preset} {flatten(loop.controller)}')
        record = simulate(loop.controller, replace(loop.plant, duration=0.2))
        runs = record.measurements, record.samples, record.truths
        show('run', *runs, record.controller.state_vector)
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
    ['older', *NEWER, *at_night('oldest')],
)
def test_every_processor_computes_the_same_bits(processor):
    """With the versions of libm, BLAS and numpy's loops for other processors, and their code."""
    here = digests()  # compiles what the other process runs, too
    program = 'from test_compiled import digests; print(*digests(), sep="\\n")'
    environment = os.environ | {'PYTHONPATH': PATH} | PROCESSORS[processor]
    other = finished(sys.executable, '-c', program, env=environment)
    assert len(here) == 5
    assert other.stdout.splitlines() == here, other.stderr


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
print(len([text for text in notices if 'in another process' not in text]))
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

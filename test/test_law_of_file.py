# SPDX-License-Identifier: Apache-2.0
"""A law of a user's file runs wherever the package's laws do, bit for bit the same."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from command import closed_loop, finished
from numba import config as numba_config

import blf_dsc_controller as blf
from benchmark.studies import path_of
from blf_dsc_controller import (
    BlfDscError,
    ConfigurationError,
    ControllerConfig,
    StartError,
    change,
    controller_of,
    load_loop,
    load_study,
    run_chunk,
)
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.compiled.jit import SLOW
from blf_dsc_controller.configuration.nodes import locate
from blf_dsc_controller.configuration.schema import build, flatten
from blf_dsc_controller.studies.laws import COMPUTED_TORQUE

LAW = COMPUTED_TORQUE


METHODS = """\
class LAW(NamedTuple):
    k: Annotated[float, positive(1.0, 'gain')]

    def compute_demand(self, settings, state, signals, t, dt):
        pass

    def finish(self, settings, state, signals, dt, saturated):
        pass
"""
IMPORTS = (
    'from typing import Annotated, NamedTuple\n'
    'from blf_dsc_controller.configuration.schema import parameter, positive\n'
)


def law_file(path, text):
    """Write the file of a law with the text, and return its path."""
    path.write_text(IMPORTS + text + '    has_barrier = False\n', encoding='utf-8')
    return str(path)


def made(law, **gains):
    """Return the controller of the default arm with the law of a file."""
    given = {f'gains.{name}': value for name, value in gains.items()}
    return controller_of(build(ControllerConfig, {'law': law} | given))


def demanded(law, **gains):
    """Return the first torque (2,) [N m] of the law of a file."""
    return made(law, **gains).update(0.0, 1e-3, np.zeros(6)).tolist()


compiling = pytest.mark.skipif(numba_config.DISABLE_JIT, reason='nothing is compiled')
checking = pytest.mark.skipif(
    numba_config.DISABLE_JIT or bool(SLOW), reason='unchecked'
)


@pytest.mark.parametrize(
    ('line', 'problem'),
    [
        ('signals.alpha2[0]', 'signals has no alpha2: it is state.alpha2'),
        ('signals.demands[0]', 'signals has no demands: did you mean signals.demand?'),
        ('self.kk', 'LAW has no gain kk: did you mean self.k?'),
        ('k', 'k is not defined: write self.k'),
        ('signals.H[0]', 'array(float64, 1d, C)): these shapes or types do not fit'),
        ('np.zeros(3)[0]', 'a law must not create arrays'),
        ('(signals.q - signals.qr)[0]', 'a law must not create arrays'),
        ("f'{t:.1f}'", 'it cannot be compiled: format spec in f-strings'),
        ('np.absolut(t)', 'numpy has no absolut'),
        ('doubled(1.0)', 'the function doubled is not compiled: put @inner above it'),
        (
            'state.memory.sum_of[0]',
            'an array has no sum_of: read what the law keeps as',
        ),
        ('signals', 'these shapes or types do not fit'),
        ('memory_of(state.memory, settings).sums[0]', 'did you mean memory.sum?'),
        ('memory_of(state.memory).sum[0]', 'memory_of takes settings only where'),
        ('settings.model.mass_of(t)', 'TwoLink has no mass_of'),
        ('np.clip(t, 0.0, 1.0)', 'a number has no shape: of numbers, use min, max'),
        ('self.n', 'LAW has no gain n: it is settings.n'),
        (
            'self.has_barrier',
            'the method has_barrier is not compiled: make it a function',
        ),
    ],
)
def test_mistake_that_cannot_be_compiled_is_told_with_its_line(line, problem, tmp_path):
    path = tmp_path / 'law.py'
    helper = 'import numpy as np\n\n\ndef doubled(x):\n    return x\n\n\n'
    helper += "MEMORY = NamedTuple('MEMORY', [('sum', Annotated[np.ndarray, 'n'])])\n"
    helper += 'from blf_dsc_controller.compiled.layout import view_of\n'
    helper += 'memory_of = view_of(MEMORY)\n'
    mistaken = METHODS.replace('pass', f'signals.demand[0] += {line}', 1)
    law = law_file(path, helper + mistaken)
    with pytest.raises(BlfDscError) as raised:
        made(law)
    (told,) = str(raised.value).splitlines()
    number = (
        path.read_text(encoding='utf-8')
        .splitlines()
        .index(f'        signals.demand[0] += {line}')
    )
    assert told.startswith(f'{path}, line {number + 1}: ')
    assert problem in told


@compiling
@pytest.mark.parametrize('line', ['self.k += t', 'signals.demand = signals.q'])
def test_what_cannot_be_set_is_told_with_its_line(line, tmp_path):
    path = tmp_path / 'law.py'
    law = law_file(path, METHODS.replace('pass', line, 1))
    with pytest.raises(BlfDscError, match=r'law\.py, line 7: \w+ cannot be set'):
        made(law)


COUNTING = """\
class LAW(NamedTuple):
    gain: Annotated[float, parameter(0.5, 'gain')]
    count: Annotated[int, parameter(2, 'joints')]
    inverted: Annotated[bool, parameter(True, 'sign')]

    def compute_demand(self, settings, state, signals, t, dt):
        for i in range(settings.n):
            signals.demand[i] = 0.0
        for k in range(self.count):
            signals.demand[self.count - 1 - k] = -self.gain if self.inverted else self.gain

    def finish(self, settings, state, signals, dt, saturated):
        pass

"""


def test_law_is_called_with_its_gains_as_they_are_declared(tmp_path):
    """A count as an integer, a switch as that."""
    law = law_file(tmp_path / 'law.py', COUNTING)
    assert demanded(law) == [-0.5, -0.5]
    assert demanded(law, gain=0.25, count=1, inverted=False) == [0.25, 0.0]


RUN_LAWS = """\
import sys
from test_law_of_file import demanded

print(*[demanded(law)[0] for law in sys.argv[1:]])
"""


@compiling
def test_laws_that_other_processes_compiled_are_not_taken_for_one_another(tmp_path):
    """Numba's symbols of their methods were the same: the first became the second."""
    one, two = (
        law_file(tmp_path / f'{gain}.py', COUNTING.replace('0.5', gain))
        for gain in ('1.5', '2.5')
    )
    folder = Path(__file__).parent
    paths = os.pathsep.join(map(str, (folder, folder.parent)))
    environment = os.environ | {'PYTHONPATH': paths}

    def run(*laws):
        done = finished(sys.executable, '-c', RUN_LAWS, *laws, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    assert [*run(one), *run(two)] == ['-1.5', '-2.5']
    assert run(one, two, one) == ['-1.5', '-2.5', '-1.5']


@pytest.mark.parametrize(
    ('has_barrier', 'learns', 'problem'),
    [
        (True, True, ''),
        (False, True, 'barrier.tool_bound: the law .* keeps no bound: choose blf_dsc'),
        (True, False, 'contact.enabled: .* needs a law that learns, such as blf_dsc'),
    ],
)
def test_bound_at_the_tool_needs_a_barrier_and_contacts_a_law_that_learns(
    has_barrier, learns, problem, tmp_path
):
    """Whatever its name: a law of a file says what it does."""
    path = tmp_path / 'law.py'
    says = f'    has_barrier = {has_barrier}\n    learns = {learns}\n'
    path.write_text(IMPORTS + METHODS + says, encoding='utf-8')
    given = {'barrier.bound': None, 'barrier.tool_bound': 0.003, 'law': str(path)}
    given |= {'contact.enabled': True}
    if not problem:
        load_loop('panda_rigid', {'blf_dsc_controller': given})
        return
    with pytest.raises(ConfigurationError, match=problem):
        load_loop('panda_rigid', {'blf_dsc_controller': given})


@pytest.mark.parametrize(
    ('preset', 'bound'), [('recommended', 0.1), ('panda_rigid', 0.01)]
)
def test_law_tracks_and_keeps_its_memory_in_the_state(preset, bound):
    """Its integral removes the constant part of what its model lacks."""
    given = {'blf_dsc_controller': {'law': LAW}, 'sim_plant': {'duration': 3.0}}
    loop = blf.load_loop(preset, given)
    record = blf.simulate(loop.controller, loop.plant)
    errors = np.abs(record.true_errors())
    assert errors[2000:].max() < bound
    controller = record.controller
    integral = controller.state.memory
    assert integral.size == len(loop.controller.joints)
    samples = record.run().error
    np.testing.assert_allclose(
        integral, 1e-3 * samples.sum(axis=0), rtol=1e-6, atol=1e-6
    )


def computed_torque_with(path, statement):
    """Return the file of a law that first executes a statement, and the line of this."""
    first = '        memory = memory_of(state.memory, settings)\n'
    before, _, after = Path(LAW).read_text(encoding='utf-8').partition(first)
    path.write_text(f'{before}        {statement}\n{first}{after}', encoding='utf-8')
    return str(path), before.count('\n') + 1


@pytest.mark.parametrize(
    ('right', 'supervised'),
    [('t < 0.005', True), ('t < 0.005', False), ('t > 0.0', True)],
)
def test_error_of_a_law_is_told_with_its_line(right, supervised, tmp_path):
    """In a run, and in the sample that a controller computes when it is made."""
    statement = f'assert {right}, "wrong time"'
    law, line = computed_torque_with(tmp_path / 'law.py', statement)
    loop = blf.load_loop('recommended', {'blf_dsc_controller': {'law': law}})
    plant = change(loop.plant, {'duration': 0.01})
    with pytest.raises(BlfDscError) as raised:
        blf.simulate(loop.controller, plant, supervised=supervised)
    assert str(raised.value) == f'{law}, line {line}: AssertionError: wrong time'


@checking
def test_index_past_the_end_is_told_before_anything_moves(tmp_path):
    """In the first sample; it would overwrite what follows the array."""
    statement = 'signals.demand[settings.n] = 0.0'
    law, _ = computed_torque_with(tmp_path / 'law.py', statement)
    loop = blf.load_loop('recommended', {'blf_dsc_controller': {'law': law}})
    with pytest.raises(BlfDscError, match=r'law\.py: an index is past the end of'):
        controller_of(loop.controller)


def test_law_without_a_first_torque_does_not_start(tmp_path):
    """Simulated, and over ROS: the arm would wait for ever for its first torque."""
    statement = 'signals.xi1[0] = float("nan")'
    law, _ = computed_torque_with(tmp_path / 'law.py', statement)
    given = {'law': law, 'barrier.bound': [0.1, 0.1]}
    loop = blf.load_loop('recommended', {'blf_dsc_controller': given})
    with pytest.raises(StartError, match='the demanded torque is not finite'):
        blf.simulate(loop.controller, loop.plant)
    pytest.importorskip('rclpy', reason='needs ROS 2')
    file = tmp_path / 'loop.yaml'
    file.write_text(f'blf_dsc_controller:\n  ros__parameters: {json.dumps(given)}\n')
    run = closed_loop('--config', file, '--mode', 'lockstep', '--out', tmp_path / 'out')
    assert run.returncode == 5, run.stderr  # it stopped
    assert 'torque not finite: the demanded torque is not finite' in run.stdout


def section_of_all_nodes(folder, entries):
    file = folder / 'all.yaml'
    text = f'/**:\n  ros__parameters: {{law: {LAW}, {entries}}}\n'
    file.write_text(text, encoding='utf-8')
    return file


def test_gains_may_be_in_the_section_of_all_nodes(tmp_path):
    file = section_of_all_nodes(tmp_path, 'gains: {velocity: 80.0}')
    assert flatten(blf.load_loop(file).controller)['gains.velocity'] == 80.0
    file = section_of_all_nodes(tmp_path, 'gains: {velocty: 80.0}')
    with pytest.raises(ConfigurationError) as raised:
        blf.load_loop(file)
    (problem,) = raised.value.problems
    assert problem == (
        'blf_dsc_controller: line 2: gains.velocty: unknown parameter, '
        'did you mean gains.velocity?'
    )


def named(law):
    """The file of a law, as the user of a replay names it."""
    return f'{law}@{hashlib.sha256(Path(law).read_bytes()).hexdigest()}'


def test_replay_repeats_a_change_of_its_gains(tmp_path):
    loop = blf.load_loop('recommended', {'blf_dsc_controller': {'law': LAW}})
    bag = tmp_path / 'bag'
    with blf.ArmController(loop.controller, record=bag) as controller:
        for step in range(6):
            if step == 3:
                softer = change(controller.guard.config, {'gains.velocity': 50.0})
                controller.guard.retune(softer)
            controller.update(1.0 + step * 1e-3, loop.plant.initial.position, [0.0] * 2)
    result = blf.verify(bag, law=named(LAW))
    assert result.difference is None
    assert result.compared == 1.0


def remarks_on_a_change(folder):
    """Print what a replay remarks on the law of a bag, then on one that has changed since."""
    law = Path(folder, 'my_law.py')
    law.write_bytes(Path(LAW).read_bytes())
    loop = blf.load_loop('recommended', {'blf_dsc_controller': {'law': str(law)}})
    bag = Path(folder, 'bag')
    with blf.ArmController(loop.controller, record=bag) as controller:
        for step in range(3):
            controller.update(1.0 + step * 1e-3, loop.plant.initial.position, [0.0] * 2)
    print(*blf.verify(bag, law=named(law)).remarks)  # noqa: T201
    law.write_text(law.read_text(encoding='utf-8') + '# changed', encoding='utf-8')
    print(*blf.verify(bag, law=named(law)).remarks)  # noqa: T201


def test_replay_remarks_that_the_file_of_the_law_has_changed(tmp_path):
    """A bag holds the digest of the file, not the file.

    It runs as plain Python: to compile both files takes a hundred times as long.
    """
    program = 'import sys, test_law_of_file as t; t.remarks_on_a_change(sys.argv[1])'
    paths = os.pathsep.join(filter(None, sys.path))
    environment = os.environ | {'NUMBA_DISABLE_JIT': '1', 'PYTHONPATH': paths}
    ended = finished(sys.executable, '-c', program, tmp_path, env=environment)
    assert ended.returncode == 0, ended.stderr
    unchanged, changed = ended.stdout.splitlines()
    assert unchanged == ''
    law = tmp_path / 'my_law.py'
    assert changed.startswith(f'{law} is another file than the one recorded')


@pytest.mark.skipif(importlib.util.find_spec('rclpy') is None, reason='needs ROS 2')
@pytest.mark.usefixtures('blank_pictures')
def test_node_offline_run_and_replay_compute_the_same_bits(tmp_path):
    file = section_of_all_nodes(tmp_path, 'gains: {velocity: 80.0}')
    common = ['run', '--config', str(file), '--duration', '1.0', '--out']
    assert main([*common, str(tmp_path / 'offline'), '--offline']) == 0
    assert main([*common, str(tmp_path / 'ros'), '--mode', 'lockstep']) == 0
    offline, ros = (
        blf.read_run(tmp_path / name / 'bag') for name in ('offline', 'ros')
    )
    np.testing.assert_array_equal(offline.error, ros.error)
    np.testing.assert_array_equal(offline.torque, ros.torque)
    assert blf.verify(tmp_path / 'ros' / 'bag', law=named(LAW)).difference is None


@pytest.mark.parametrize('base', ['monte_carlo', path_of('monte_carlo_panda')])
def test_random_study_runs_it(base, tmp_path):
    """On two links and on a Panda, with its own results."""
    file = tmp_path / 'study.yaml'
    file.write_text(
        f'/**/blf_dsc_controller:\n  ros__parameters:\n    law: {LAW}\n'
        f'monte_carlo:\n  ros__parameters: {{base: {base}, runs: 2, seed: 1}}\n',
        encoding='utf-8',
    )
    study = load_study(file)
    assert study.controller.law == LAW
    largest = f'max_error_ratio.{study.controller.joints[0]}'
    (mine,) = run_chunk(study, 0, 1)[largest]
    (of_package,) = run_chunk(load_study(locate(base)), 0, 1)[largest]
    assert 0.0 < mine < 10.0
    assert mine != of_package

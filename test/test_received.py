# SPDX-License-Identifier: Apache-2.0
"""What a stranger's bag, journal or topic names is not read, and does not run."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import pickle
import py_compile
import sys
from pathlib import Path

import numpy as np
import pytest
import recorded_run
from command import finished
from planted import Planted
from random_arm import random_urdf

from blf_dsc_controller import (
    ArmController,
    BlfDscError,
    ControllerConfig,
    change,
    load_loop,
    read_run,
    simulate,
    verify,
)
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.law_file import load_law
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.control.goal_messages import decode as decode_goal
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import EventType, Journal, decode
from blf_dsc_controller.simulation.loop import write_bag
from blf_dsc_controller.studies.laws import COMPUTED_TORQUE

ROS = pytest.mark.skipif(
    importlib.util.find_spec('rclpy') is None, reason='needs ROS 2'
)
ARM = """
/**:
  ros__parameters:
    joints: [j1, j2, j3]
    robot: {{urdf: {urdf}, tip: tip}}
"""


class Law:
    """The file of a law that leaves a mark when it runs."""

    def __init__(self, folder):
        self.path = folder / 'mine.py'
        self.mark = folder / 'has run'
        leaves = f"\nopen({str(self.mark)!r}, 'w').close()\n"
        self.path.write_text(Path(COMPUTED_TORQUE).read_text() + leaves)
        self.digest = digest_of(self.path)

    @property
    def has_run(self):
        return self.mark.exists()


def digest_of(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


@pytest.fixture
def law(tmp_path):
    return Law(tmp_path)


def renamed(bag, path, **parameters):
    """Copy a bag with other recorded parameters; a dot is written as `__`."""
    entries = recorded_run.messages(bag)
    first = recorded_run.of(entries, topics.JOURNAL)[0]
    event = decode(first[3])
    given = {name.replace('__', '.'): value for name, value in parameters.items()}
    event.content['parameters'].update(given)
    first[3] = event.encode()
    return recorded_run.write(path, entries)


def urdf_loop(folder):
    """Return the configuration of an arm from a URDF, and its file."""
    urdf = folder / 'arm.urdf'
    urdf.write_text(random_urdf(3, seed=5)[0])
    file = folder / 'arm.yaml'
    file.write_text(ARM.format(urdf=urdf))
    return load_loop(file, {'sim_plant': {'duration': 0.05}}), urdf


@pytest.fixture(params=['two links', 'URDF'])
def bag(request, law, tmp_path):
    """A bag whose controller had the law of a file."""
    loop = recorded_run.loop_config(0.05)
    if request.param == 'URDF':
        loop, _ = urdf_loop(tmp_path)
    write_bag(tmp_path / 'own', simulate(loop.controller, loop.plant), loop.plant)
    theirs = {'law': str(law.path), 'gains__velocity': 80.0}
    return renamed(tmp_path / 'own', tmp_path / 'bag', **theirs)


# A bag.


@pytest.mark.usefixtures('blank_pictures')
def test_law_that_a_bag_names_does_not_run_where_a_bag_is_read(bag, law, tmp_path):
    bag, out = str(bag), tmp_path / 'out'
    assert main(['report', bag, '--out', str(out.with_suffix('.html'))]) == 0
    assert main(['export', bag, '--out', str(out.with_suffix('.csv'))]) == 0
    assert main(['report', bag, '--png', str(out)]) == 0
    assert not law.has_run


def test_replay_does_not_run_the_law_that_a_bag_names(bag, law, capsys):
    assert main(['replay', str(bag)]) == 1
    said = capsys.readouterr().err
    assert str(law.path) in said
    assert '--law FILE@SHA256' in said
    for wrong in ('', '@', f'@{"0" * 64}', f'@{law.digest[:11]}'):
        assert main(['replay', str(bag), '--law', f'{law.path}{wrong}']) == 1
    assert not law.has_run


@pytest.mark.parametrize('digest', ['', f'@{"0" * 64}'])
def test_law_that_may_not_run_is_refused_before_the_bag_is_read(digest, law, tmp_path):
    with pytest.raises(BlfDscError, match=law.digest):  # the remedy
        verify(tmp_path / 'no bag', law=f'{law.path}{digest}')


def test_replay_runs_the_law_that_its_user_names_by_path_and_digest(tmp_path):
    """Which may be elsewhere by now."""
    loop = load_loop('recommended', {'blf_dsc_controller': {'law': COMPUTED_TORQUE}})
    q = np.array(loop.plant.initial.position)
    with ArmController(loop.controller, record=tmp_path / 'own') as controller:
        for step in range(20):
            controller.update(1.0 + step * 1e-3, q, 0.0 * q)
    bag = renamed(tmp_path / 'own', tmp_path / 'bag', law='/elsewhere/mine.py')
    digest = digest_of(COMPUTED_TORQUE)
    for given in (digest, digest[:12]):
        result = verify(bag, law=f'{COMPUTED_TORQUE}@{given}')
        assert result.difference is None
        assert result.samples == 20
        assert result.remarks == ()


def test_bytecode_beside_a_law_does_not_run(law):
    """Python would take it for the file's own, by time and size."""
    odd = law.path.read_bytes()
    py_compile.compile(str(law.path))
    times = law.path.stat()
    law.path.write_bytes(odd.replace(b"'w'", b"'r'"))  # reads the mark: there is none
    os.utime(law.path, ns=(times.st_atime_ns, times.st_mtime_ns))
    with pytest.raises(BlfDscError, match='No such file'):
        load_law(str(law.path))
    assert not law.has_run


INCLUDED = '<mujoco><include file="{file}"/></mujoco>'


@pytest.mark.parametrize('given', ['{file}', INCLUDED])
def test_file_that_a_bag_names_as_its_arm_is_not_read(given, tmp_path):
    """Its name may be that of any file here, which MuJoCo would read as well."""
    loop, urdf = urdf_loop(tmp_path)
    whole = tmp_path / 'whole'
    write_bag(whole, simulate(loop.controller, loop.plant), loop.plant)
    bag = renamed(whole, tmp_path / 'bag', robot__urdf=given.format(file=urdf))
    assert read_run(whole).arm is not None
    assert read_run(bag).arm is None
    assert read_content(bag).unknown_parameters == []
    with pytest.raises(BlfDscError, match='files that a bag or a topic names are not'):
        verify(bag)


@pytest.mark.parametrize('name', ['law', 'robot.urdf'])
def test_file_that_a_change_of_parameters_names_does_not_run(name, law, tmp_path):
    """It is fixed at the start, so no controller has recorded such a change."""
    loop = recorded_run.loop_config(0.1)
    q = np.array(loop.plant.initial.position)
    with ArmController(loop.controller, record=tmp_path / 'own') as controller:
        for step in range(3):
            controller.update(1.0 + step * 1e-3, q, 0.0 * q)
        config = change(controller.guard.config, {'safety.error_ratio': 0.9})
        controller.guard.retune(config)
        controller.update(1.003, q, 0.0 * q)
    assert verify(tmp_path / 'own').difference is None
    entries = recorded_run.messages(tmp_path / 'own')
    for entry in recorded_run.of(entries, topics.JOURNAL):
        event = decode(entry[3])
        if event.type is EventType.PARAMETERS:
            given = event.content['parameters']
            assert given == {'safety.error_ratio': 0.9}
            given[name] = str(law.path)
            entry[3] = event.encode()
    bag = recorded_run.write(tmp_path / 'bag', entries)
    with pytest.raises(BlfDscError, match=f'fixed at the start: {name};'):
        verify(bag)
    assert not law.has_run


# A goal, by the process of the action.


def test_pickle_from_the_process_of_the_action_does_not_run(tmp_path):
    mark = tmp_path / 'has run'
    with pytest.raises(ValueError, match='decode'):
        decode_goal(pickle.dumps(Planted(mark)))
    assert not mark.exists()


# A journal, live.


@ROS
def test_law_that_a_journal_names_does_not_run_in_view_and_watchdog(ros, law):
    """They need none: the watchdog is ready to hold the arm, the view shows it."""
    from std_msgs.msg import String

    from blf_dsc_controller.nodes.watchdog_node import WatchdogNode

    watchdog = ros.add(WatchdogNode)
    views = []
    if importlib.util.find_spec('viser'):
        from blf_dsc_controller.view.node import ViewNode

        views.append(ros.add(ViewNode, port=18480))
    publisher = ros.publisher(topics.JOURNAL)
    ros.until(lambda: publisher.get_subscription_count() == 1 + len(views))
    journal = Journal()
    given = {**flatten(ControllerConfig()), 'law': str(law.path), 'gains.velocity': 1.0}
    journal.note(EventType.CONFIGURE, parameters=given)
    publisher.publish(String(data=json.dumps(journal.pending[0]._asdict())))
    ros.until(lambda: watchdog.watchdog is not None)
    ros.until(lambda: all(view.config is not None for view in views))
    assert not law.has_run
    for view in views:
        view.close()


# The folder of a bag, as the current one.

CONSOLE = """
import sys
sys.path.remove('')  # as the command has it
from blf_dsc_controller.cli.main import main
sys.exit(main())
"""


@ROS
@pytest.mark.parametrize('middleware', ['rmw_fastrtps_cpp', 'rmw_absent_cpp'])
def test_modules_in_the_current_folder_do_not_run(middleware, tmp_path):
    """Neither in the nodes of a run nor in the process that tries the middleware."""
    mark = tmp_path / 'has run'
    for name in ('rclpy', 'runpy', 'numpy', 'json'):
        (tmp_path / f'{name}.py').write_text(f'open({str(mark)!r}, "w").close()')
    options = ('--mode', 'lockstep', '--duration', '0.05')
    path = os.pathsep.join(filter(None, sys.path))
    given = {'PYTHONPATH': path, 'RMW_IMPLEMENTATION': middleware}
    ran = finished(
        sys.executable,
        '-c',
        CONSOLE,
        'run',
        *options,
        cwd=tmp_path,
        env=os.environ | given,
    )
    assert ran.returncode == (1 if middleware == 'rmw_absent_cpp' else 0), ran.stderr
    assert not mark.exists()

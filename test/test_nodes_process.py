# SPDX-License-Identifier: Apache-2.0
"""Processes of the nodes: how they end, what they ask of the system, how they are launched."""

from __future__ import annotations

import ctypes
import os
import runpy
import socket
import subprocess
import sys
from operator import itemgetter
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs ROS 2')

import rclpy
from command import finished
from own_domain import own_domain

import blf_dsc_controller as blf
from blf_dsc_controller.cli import domains
from blf_dsc_controller.cli.isolation import localhost_environment
from blf_dsc_controller.configuration.nodes import dump
from blf_dsc_controller.configuration.robot import Realtime
from blf_dsc_controller.control.realtime import request_realtime
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.recorder_node import BagRecorderNode
from blf_dsc_controller.nodes.watchdog_node import WatchdogNode

BROKEN = """
from pathlib import Path
import rclpy
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.nodes.process import run

class Broken(PlantNode):
    def _on_poll(self):
        self.finished = True

    def close(self):
        raise OSError('the middleware is gone')

code = run(Broken)
names = [(task / 'comm').read_text().strip() for task in Path('/proc/self/task').iterdir()]
print(code, rclpy.ok(), [name for name in names if name.startswith('dds.')])
"""


def test_middleware_ends_with_the_node_even_if_its_shutdown_fails():
    """And not only with the process: otherwise its threads may crash at the end."""
    process = finished(sys.executable, '-c', BROKEN)
    assert process.stdout == '0 False []\n', process.stderr
    assert process.stderr.endswith(
        ' could not shut down cleanly: the middleware is gone\n'
    )
    assert 'Traceback' not in process.stderr


def test_real_time_is_requested_for_all_threads(monkeypatch):
    """Whether the system refuses depends on the user, so it is replaced here."""
    scheduled, lines = set(), []

    def schedule(thread, policy, parameters):
        scheduled.add((thread, policy, parameters.sched_priority))

    def mlockall(flags):
        assert flags == 1 | 2  # MCL_CURRENT | MCL_FUTURE of Linux
        return 0

    library = SimpleNamespace(mlockall=mlockall)
    monkeypatch.setattr(os, 'sched_setscheduler', schedule)
    monkeypatch.setattr(ctypes, 'CDLL', lambda *_, **__: library)
    request_realtime(Realtime(), lines.append)
    assert (scheduled, lines) == (set(), [])
    request_realtime(Realtime(priority=50), lines.append)
    threads = {int(name) for name in os.listdir('/proc/self/task')}  # noqa: PTH208
    assert scheduled == {(thread, os.SCHED_FIFO, 50) for thread in threads}
    assert lines == []


# The environment of the nodes of a run: the middleware's settings, domains, numpy's
# threads.

MULTIPLY = """
import os, sys
from blf_dsc_controller.cli import main
code = getattr(main, sys.argv.pop(1))()
import numpy as np
np.ones((500, 500)) @ np.ones((500, 500))
print(code, len(os.listdir('/proc/self/task')))
"""
OTHERS = {  # of a shell, which other nodes of its user use
    'FASTRTPS_DEFAULT_PROFILES_FILE': 'own.xml',
    'ROS_STATIC_PEERS': '192.0.2.1',
    'ROS_DISCOVERY_SERVER': '192.0.2.1:11811',
    'FASTDDS_ENVIRONMENT_FILE': 'own.json',
    'ROS_LOCALHOST_ONLY': '0',
}


def test_nodes_of_a_run_look_for_nobody_elsewhere_whatever_the_shell_names(monkeypatch):
    for name, value in OTHERS.items():
        monkeypatch.setenv(name, value)
    own = localhost_environment()
    assert own.keys() >= OTHERS.keys()
    assert own['FASTRTPS_DEFAULT_PROFILES_FILE'].endswith('config/fastdds.xml')
    monkeypatch.setattr(
        rclpy, 'get_rmw_implementation_identifier', lambda: 'rmw_cyclonedds_cpp'
    )
    limited = localhost_environment()
    assert limited['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    for environment in (own, limited):
        named = OTHERS.keys() & environment.keys() - {'FASTRTPS_DEFAULT_PROFILES_FILE'}
        assert {environment[name] for name in named} == {''}


def test_libraries_start_no_threads_unless_the_environment_asks_for_them():
    """Such a thread would spin beside the nodes, and at the priority of a real-time node."""
    command = ('blf_dsc_controller', '--ros-args', '--params-file', '/none')
    outputs = []
    for given in ({}, {'OPENBLAS_NUM_THREADS': '2'}):
        kept = {
            name: value
            for name, value in os.environ.items()
            if 'NUM_THREADS' not in name
        }
        run = finished(sys.executable, '-c', MULTIPLY, *command, env=kept | given)
        outputs.append([int(number) for number in run.stdout.split()])
    (code, threads), more = outputs
    assert more == [code, threads + (len(os.sched_getaffinity(0)) > 1)]


def test_domain_is_held_until_the_last_node_of_a_run_has_ended(monkeypatch):
    mine = 1000 + os.getpid()  # that no other test claims
    monkeypatch.setattr(domains, 'DOMAINS', (mine,))
    with domains.own_domain():
        node = subprocess.Popen(
            [sys.executable, '-c', 'input()'], stdin=subprocess.PIPE, close_fds=False
        )
    with (
        pytest.raises(blf.BlfDscError, match='no ROS domain is free'),
        domains.own_domain(),
    ):
        pass
    node.communicate(b'\n')
    with domains.own_domain() as domain:
        assert domain == mine


PARTICIPANT = """
import rclpy
rclpy.init(args=[])
node = rclpy.create_node('stranger')
print('ready', flush=True)
input()
"""


@pytest.fixture
def participant():
    """Return a function that lets another process enter a domain."""
    started = []

    def start(domain, **variables):
        variables['ROS_DOMAIN_ID'] = str(domain)
        process = subprocess.Popen(
            [sys.executable, '-c', PARTICIPANT],
            env={k: value for k, value in (os.environ | variables).items() if value},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        started.append(process)
        assert process.stdout.readline() == b'ready\n'

    yield start
    for process in started:
        process.communicate(b'\n')


PROFILE = {  # with sockets and shared memory as others' nodes have them
    'FASTRTPS_DEFAULT_PROFILES_FILE': '',
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
}


def test_run_does_not_claim_a_domain_in_which_somebody_is(participant, monkeypatch):
    taken, free = own_domain(), own_domain()
    monkeypatch.setattr(domains, 'claimed', lambda _: socket.socket(socket.AF_UNIX))
    monkeypatch.setattr(domains, 'DOMAINS', (taken, free))
    participant(taken, **PROFILE)
    with domains.own_domain() as domain:
        assert domain == free
    monkeypatch.setenv('ROS_DOMAIN_ID', str(free))
    with (
        pytest.raises(blf.BlfDscError, match='no ROS domain is free'),
        domains.own_domain(),
    ):
        pass


# The launch file and the command line: which parameters reach the nodes. `launch` comes
# only with a ROS installation: here stand-ins replace the few classes needed, and the
# real nodes get the arguments that `launch_ros` would pass to their processes.

ROOT = Path(__file__).resolve().parents[1]
NODES = {
    'sim_plant': PlantNode,
    'blf_dsc_controller': ControllerNode,
    'bag_recorder': BagRecorderNode,
    'torque_watchdog': WatchdogNode,
}


@pytest.fixture
def launched(monkeypatch):
    """Return a function from launch arguments to what the launch file starts, in order."""
    stand_ins = {
        'launch': {'LaunchContext': dict, 'LaunchDescription': list},
        'launch.actions': {
            'DeclareLaunchArgument': lambda name, **options: SimpleNamespace(
                name=name, **options
            ),
            'OpaqueFunction': SimpleNamespace,
            'Shutdown': SimpleNamespace,
        },
        'launch.substitutions': {
            'LaunchConfiguration': lambda name: SimpleNamespace(
                perform=itemgetter(name)
            )
        },
        'launch_ros': {},
        'launch_ros.actions': {'Node': SimpleNamespace},
    }
    for name, content in stand_ins.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)

    def launch(**arguments):
        code = runpy.run_path(str(ROOT / 'launch/closed_loop.launch.py'))
        *declared, start = code['generate_launch_description']()
        context = {argument.name: argument.default_value for argument in declared}
        assert arguments.keys() <= context.keys()
        return start.function(context | arguments)

    return launch


def arguments_of(node, folder):
    """Command line of a node, as `launch_ros` writes it."""
    full = f'{"/" + node.namespace if node.namespace else ""}/{node.name}'
    argv = [node.executable, '--ros-args', '-r', f'__node:={node.name}']
    argv += ['-r', f'__ns:=/{node.namespace}']
    for number, parameters in enumerate(node.parameters):
        path = parameters
        if isinstance(parameters, dict):
            path = folder / f'{node.name}{number}.yaml'
            dump(path, {full: parameters})
        argv += ['--params-file', str(path)]
    return argv


@pytest.fixture
def start(monkeypatch):
    """Start nodes of the package as processes with these arguments would."""
    contexts, nodes = [], []

    def node(*argv):
        monkeypatch.setattr(sys, 'argv', list(map(str, argv)))
        contexts.append(rclpy.Context())
        rclpy.init(args=sys.argv, context=contexts[-1], domain_id=own_domain())
        nodes.append(NODES[argv[0]](context=contexts[-1]))
        return nodes[-1]

    yield node
    for started in nodes:
        started.close()
        started.destroy_node()
    for context in contexts:
        rclpy.try_shutdown(context=context)


def test_launch_arguments_override_the_parameter_file(launched, start, tmp_path):
    """A section `/**/NODE` of the preset takes precedence over one for any node."""
    namespace = 'left'
    bag, file = tmp_path / 'run1', tmp_path / 'my.yaml'
    given = '{mode: lockstep, wait_for_subscribers: 0}'
    file.write_text(f'/**/sim_plant:\n  ros__parameters: {given}\n')
    nodes = launched(config=str(file), bag=str(bag), namespace=namespace)
    by_name = {node.name: node for node in nodes}
    assert by_name.keys() == NODES.keys()
    plant = start(*arguments_of(by_name['sim_plant'], tmp_path))
    assert (plant.config.mode, plant.config.wait_for_subscribers) == ('lockstep', 1)
    assert plant.get_namespace() == f'/{namespace}'
    recorder = start(*arguments_of(by_name['bag_recorder'], tmp_path))
    assert bag.is_dir()
    assert recorder._config.clock == 'plant'
    assert {'output': 'run1', 'clock': 'wall'} in launched(bag='run1')[0].parameters


def test_no_end_of_another_node_ends_what_holds_an_arm(launched):
    """The watchdog outlives the controller, and both the recorder, as on a full disk."""
    nodes = {node.executable: node for node in launched(driver='ur5e', bag='run1')}
    assert nodes.keys() == NODES.keys() - {'sim_plant'}
    assert not any(node.on_exit for node in nodes.values())
    assert (
        'blf_dsc_controller/commands',
        'forward_effort_controller/commands',
    ) in nodes['torque_watchdog'].remappings


def test_command_line_parameter_overrides_a_file(start, tmp_path):
    """Whose section for the node, after one for all nodes, would take precedence in ROS."""
    path = tmp_path / 'my.yaml'
    own = '{mode: realtime, arm.l2: 0.5, initial.position: [2.0, 1.0], seed: 0}'
    sections = {'/**': '{sample_time: 0.001}', '/**/sim_plant': own}
    path.write_text(
        ''.join(f'{k}:\n  ros__parameters: {v}\n' for k, v in sections.items())
    )
    argv = ('sim_plant', '--ros-args', '--params-file', path)
    given = (
        '-p',
        'mode:=lockstep',
        '-p',
        'arm.l2:=0.7',
        '-p',
        'initial.position:=[2.29, 1.69]',
    )
    config = start(*argv, *given, '-p', 'elsewhere:seed:=3').config
    assert (config.mode, config.arm.l2) == ('lockstep', 0.7)
    assert config.initial.position == (2.29, 1.69)
    assert config.seed == 0


def test_section_that_does_not_match_the_node_is_an_error(start, tmp_path):
    path = tmp_path / 'my.yaml'
    argv = ('sim_plant', '--ros-args', '-r', '__ns:=/left', '--params-file', path)
    right = '/right/sim_plant:\n  ros__parameters: {seed: 1}\n'
    path.write_text(right)
    with pytest.raises(blf.ConfigurationError) as caught:
        start(*argv)
    remedy = '/right/sim_plant does not match /left/sim_plant: write /**/sim_plant'
    assert [
        found.startswith(f'line 2: {remedy}') for found in caught.value.problems
    ] == [True]
    # for two arms
    path.write_text(right + right.replace('right', 'left').replace('1', '2'))
    assert start(*argv).config.seed == 2

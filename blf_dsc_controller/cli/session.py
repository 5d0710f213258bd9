# SPDX-License-Identifier: Apache-2.0
"""One run over ROS: its processes, their isolation, and their progress.

Plant and controller are one process in lock-step, and the recorder is another.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from importlib import metadata
from pathlib import Path

import rclpy
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState
from tqdm import tqdm

from blf_dsc_controller import child
from blf_dsc_controller.cli.domains import own_domain, strangers
from blf_dsc_controller.compiled.announcement import COMPILING
from blf_dsc_controller.configuration.files import share_folder
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    RECORDER,
    VIEW,
    LoopConfig,
)
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.topics import RATIO
from blf_dsc_controller.nodes.endpoints import qos_profile

_LOOP = 'loop'
# Started in this order and stopped in reverse, so that the recorder gets every message.
_MODULES = {
    RECORDER: 'blf_dsc_controller.nodes.recorder_node',
    CONTROLLER: 'blf_dsc_controller.nodes.controller_node',
    PLANT: 'blf_dsc_controller.nodes.plant_node',
    _LOOP: 'blf_dsc_controller.nodes.lockstep_loop',  # both, in lock-step
    VIEW: 'blf_dsc_controller.view.node',  # only on request, once the loop runs
}
_ENDING = 20.0  # s that a node may take to exit before it is killed
_UNHEARD = 1.0  # s likewise, while nobody records its messages
_TAIL = 12  # lines of a failed node's log that are shown
_MIN_FREE_SPACE = 1_000_000  # bytes; with less free space the disk counts as full
_PR_SET_PDEATHSIG = 1
_LIBC = ctypes.CDLL(None)  # loaded before there are threads
_PAGE = 'open http'  # in the log of the node that serves it
_BAR = '{desc} |{bar}| {n:.1f}/{total:g} s [{elapsed}<{remaining}]{postfix}'
_DISCOVERY = 0.5  # s, until the nodes of a domain have answered
_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_ENDED = 'the run has ended: its page replays it until Ctrl-C, then the results follow'
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_NO_OTHERS = {
    'ROS_LOCALHOST_ONLY': '',
    'ROS_STATIC_PEERS': '',
    'ROS_DISCOVERY_SERVER': '',
    'FASTDDS_ENVIRONMENT_FILE': '',
    'SKIP_DEFAULT_XML_FILE': '1',  # DEFAULT_FASTRTPS_PROFILES.xml in the current folder
}


def run_session(config: LoopConfig, out: Path, *, view: bool) -> bool:
    """Run recorder, controller and plant on `out/config.yaml` to the end.

    They run in a ROS domain of their own, and with a page if they should be viewed.
    Returns False if a signal to this process, or to another node than the plant, ended
    the run; raises BlfDscError if a node exited with an error, and KeyboardInterrupt,
    without a bag, if a signal came before the loop had begun.
    """
    logs = out / 'logs'
    logs.mkdir()
    try:
        return _run_alone(config, out / 'config.yaml', logs, view=view)
    except BlfDscError:
        if shutil.disk_usage(out).free < _MIN_FREE_SPACE:
            print(f'no space left on the disk of {out}', file=sys.stderr)
        bag = out / 'bag'
        if (bag / 'metadata.yaml').exists():
            print(f'the recording up to then is in {bag}', file=sys.stderr)
        elif bag.exists():
            print(f'blf_dsc recover {bag} saves what was recorded', file=sys.stderr)
        raise
    except KeyboardInterrupt:
        shutil.rmtree(out / 'bag', ignore_errors=True)  # empty, if it is there already
        raise


def _run_alone(
    config: LoopConfig, params_file: Path, logs: Path, *, view: bool
) -> bool:
    """Run the nodes in a domain in which nobody else is, also after it was entered."""
    left: list[int] = []
    while True:
        with own_domain(left) as domain:
            values = {'ROS_DOMAIN_ID': str(domain), 'ROS_LOG_DIR': str(logs / 'ros')}
            with (
                environment(values | localhost_environment()),
                closing(ProgressMonitor(config.plant.duration)) as monitor,
            ):
                if not monitor.others(domain):
                    return _run_nodes(config, monitor, params_file, logs, view=view)
            left.append(domain)


class NodeProcess:
    """A process of nodes, which does not outlive this one."""

    def __init__(
        self, name: str, params_file: Path, logs: Path, *arguments: str
    ) -> None:
        self.name = name
        self.patience = _ENDING  # s
        self._noticed = 0
        self._log = logs / f'{name}.log'
        module = _MODULES.get(name, name)  # of the benchmark, for instance
        command = [*child.running_module(module), '--ros-args', '--params-file']
        with self._log.open('wb') as output:
            # In its own session: Ctrl-C reaches only the parent, which stops the nodes
            # in order.
            self._process = subprocess.Popen(
                [*command, str(params_file), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **child.places(), 'PYTHONUNBUFFERED': '1'},
                start_new_session=True,
                # it holds the claim of the domain, which ends with the last node
                close_fds=False,
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - takes no lock that a thread could hold
            )

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether the process is alive."""
        return self._process.poll() is None

    def take_notices(self) -> list[str]:
        """Return what the node has reported of its kernels or its page since the last call."""
        lines = self._log.read_text(encoding='utf-8', errors='replace').splitlines()
        found = (re.search(f'({COMPILING}|{_PAGE}).*', line) for line in lines)
        notices = [each[0] for each in found if each]
        new = notices[self._noticed :]
        self._noticed = len(notices)
        return [f'{self.name}: {notice}' for notice in new]

    def check(self) -> None:
        """Raise BlfDscError, with the end of the log, if the node failed."""
        code = self._process.poll()
        if not code:
            return
        end = f'exited with code {code}'
        if code < 0:
            end = f'was terminated by {signal.Signals(-code).name}'
        lines = self._log.read_text(encoding='utf-8', errors='replace').splitlines()[
            -_TAIL:
        ]
        tail = ''.join(f'\n  {line}' for line in lines)
        raise BlfDscError(f'{self.name} {end}:{tail}\n(full log: {self._log})')

    def stop(self) -> None:
        """Interrupt the node and wait until it exits; kill it if it takes too long."""
        if self.is_running:
            self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(self.patience)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextmanager
def _kept_interrupts() -> Iterator[list[int]]:
    """Give the list of SIGINT and SIGTERM that come meanwhile; they end nothing."""
    interrupts: list[int] = []
    with ExitStack() as handlers:
        for number in (signal.SIGINT, signal.SIGTERM):
            before = signal.signal(number, lambda number, _: interrupts.append(number))
            handlers.callback(signal.signal, number, before)
        yield interrupts


def _run_nodes(
    config: LoopConfig,
    monitor: ProgressMonitor,
    params_file: Path,
    logs: Path,
    *,
    view: bool,
) -> bool:
    """Run the nodes until the plant has ended.

    Return False if something else ended the run; raise KeyboardInterrupt if it had not
    begun.
    """
    # stops the nodes in reverse, then restores the handlers
    with ExitStack() as ending:
        interrupts = ending.enter_context(_kept_interrupts())

        def started(name: str) -> NodeProcess:
            node = NodeProcess(name, params_file, logs)
            ending.callback(node.stop)
            return node

        is_lockstep = config.plant.mode == 'lockstep'
        loop = [_LOOP] if is_lockstep else [CONTROLLER, PLANT]
        nodes = [started(name) for name in (RECORDER, *loop)]

        def is_running() -> bool:
            return all(node.is_running for node in nodes) and not interrupts

        while is_running() and monitor.start is None:
            monitor.wait(0.1)
            _show_notices(nodes)
        # Only now, since the nodes wait for a subscriber, which must be the recorder.
        begun = view and monitor.start is not None
        pages = [started(VIEW)] if begun else []
        while is_running():
            monitor.wait(0.1)
            _show_notices(pages)
        if interrupts and monitor.start is None:
            _do_not_wait_for(nodes)  # they import, compile or wait for each other
            raise KeyboardInterrupt
        _hurry_without_recorder(*nodes)
        completed = not (interrupts or nodes[-1].is_running)
        if completed:
            monitor.show(config.plant.duration)
            _keep(pages, nodes[1:], monitor, interrupts)
    for node in nodes:
        node.check()
    return completed


def _show_notices(nodes: Iterable[NodeProcess]) -> None:
    """Print what nodes newly report, above the progress bar."""
    for node in nodes:
        for notice in node.take_notices():
            tqdm.write(notice, file=sys.stderr)


def _hurry_without_recorder(recorder: NodeProcess, *others: NodeProcess) -> None:
    """Do not wait long for the others if the recorder has ended.

    They notice its end late, and until then wait for it to take their last messages.
    """
    if recorder.is_running:
        return
    tqdm.write(f'{recorder.name} has ended: so does the run', file=sys.stderr)
    _do_not_wait_for(others)


def _do_not_wait_for(nodes: Iterable[NodeProcess]) -> None:
    for node in nodes:
        node.patience = _UNHEARD


def _keep(
    pages: Sequence[NodeProcess],
    loop: Sequence[NodeProcess],
    monitor: ProgressMonitor,
    interrupts: Sequence[int],
) -> None:
    """Keep the page of an ended loop until an interrupt, if there is a terminal."""
    if not (pages and sys.stderr.isatty()):
        return
    for node in reversed(loop):
        node.stop()  # so that the page says that they have finished
    tqdm.write(_ENDED, file=sys.stderr)
    while pages[0].is_running and not interrupts:
        _show_notices(pages)
        monitor.wait(0.1)


def _die_with_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGINT)


class ProgressMonitor:
    """Progress bar over simulated time of the loop, with max |xi1| / k_c."""

    def __init__(self, duration: float) -> None:
        """Wait for a loop of this simulated duration [s]."""
        self._duration = duration
        # Disabled (None) in a log, where a bar would be one long line.
        self._bar = tqdm(
            total=duration, desc='closed loop', bar_format=_BAR, disable=None
        )
        self.start: float | None = None  # s, stamp of the first message
        self._received: list[JointState] = []
        self._context = rclpy.Context()
        rclpy.init(
            context=self._context, signal_handler_options=rclpy.SignalHandlerOptions.NO
        )
        self._node = rclpy.create_node(
            'closed_loop', context=self._context, enable_rosout=False
        )
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._node.create_subscription(
            JointState,
            topics.MONITOR.relative,
            self._received.append,
            qos_profile(topics.MONITOR.offered),
        )

    def others(self, domain: int) -> list[str]:
        """Return who else is in this domain: discovered nodes, and bound ports."""
        time.sleep(_DISCOVERY)
        nodes = self._node.get_node_names_and_namespaces()
        names = [f'{space.rstrip("/")}/{name}' for name, space in nodes]
        names.remove(self._node.get_fully_qualified_name())
        return names + [f'UDP port {port}' for port in strangers(domain)]

    def wait(self, seconds: float) -> None:
        """Wait for a message and show it."""
        self._executor.spin_once(timeout_sec=seconds)
        if not self._received:
            return
        message = self._received[-1]
        self._received.clear()
        values = zip(message.name, message.position, strict=True)
        ratio = max(value for name, value in values if name.startswith(RATIO))
        self._bar.set_postfix_str(f'max|xi1|/bound {ratio:.2f}', refresh=False)
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        self.start = stamp if self.start is None else self.start
        self.show(stamp - self.start)

    def show(self, elapsed: float) -> None:
        """Show the simulated time [s]."""
        self._bar.update(min(elapsed, self._duration) - self._bar.n)

    def close(self) -> None:
        """Leave the ROS domain."""
        self._bar.close()
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)


def localhost_environment() -> dict[str, str]:
    """Return the environment in which nodes exchange messages on this computer only.

    Whatever else the shell names is overruled: a profile, peers or a server of other
    computers. Other middleware than Jazzy's Fast DDS looks for nobody elsewhere, but
    answers whoever finds it (doc/topics.md): the Fast DDS of Kilted rejects this
    package's profile, and would then find the whole network.
    """
    if not _is_jazzys_fast_dds():
        return {_RANGE: 'LOCALHOST', **_NO_OTHERS}
    # With LOCALHOST, rmw_fastrtps would add shared memory to the transports of the
    # profile.
    profiles = str(share_folder() / 'config/fastdds.xml')
    return {_RANGE: 'SYSTEM_DEFAULT', **_NO_OTHERS, _PROFILES: profiles}


def _is_jazzys_fast_dds() -> bool:
    name = rclpy.get_rmw_implementation_identifier()
    return 'fastrtps' in name and metadata.version('rclpy').startswith('7.')


@contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Temporarily change the environment of this process and its children.

    A caller in Python must not stay in a domain that the next run may claim.
    """
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)

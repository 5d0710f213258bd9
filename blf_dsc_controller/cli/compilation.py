# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc doctor --compile`: kernels are compiled before the first start of a node."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context, resource_tracker

from blf_dsc_controller.compiled.announcement import announced_compilation
from blf_dsc_controller.compiled.kernel_cache import ship
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.codecs import JointStateDecoder
from blf_dsc_controller.progress import print_notice
from blf_dsc_controller.supervision.guard import Guard
from blf_dsc_controller.supervision.torque_watchdog import TorqueWatchdog
from sim_plant.plant import plant_of

_ANY_TIMEOUT = 1.0  # s


def compile_ahead(given: str, *, into_package: bool) -> None:
    """Compile the kernels of controller, watchdog and plant, in two parallel processes."""
    config = load_loop(given)
    _compile_side_by_side(config.controller, config.plant)
    if into_package:
        print(f'{given}: the kernels are in {ship()}, for all who use this copy')
        return
    print(
        f'{given}: the kernels are compiled; the nodes of this user now start at once'
    )


def _compile_side_by_side(*configs: ControllerConfig | PlantConfig) -> None:
    """Compile the kernels of each configuration in a process of its own.

    The terminal sends Ctrl-C to all of them: only this process acts on it, and ends the others.
    """
    context = get_context('spawn')
    processes = [
        context.Process(target=_compile_aloud, args=(each,)) for each in configs
    ]
    resource_tracker.ensure_running()  # its start would unblock the signal again
    try:
        with _sigint_blocked():  # as long as they import, too: a mask is inherited
            for process in processes:
                process.start()
        for process in processes:
            process.join()
    finally:
        for process in processes:
            if process.is_alive():
                process.kill()
                process.join()
    if any(process.exitcode for process in processes):
        raise BlfDscError('the kernels were not compiled: the lines above say why')


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Delay Ctrl-C for this process; processes that it starts meanwhile never get it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _compile_aloud(config: ControllerConfig | PlantConfig) -> None:
    """Compile as `compile_kernels` does, and name each kernel."""
    with announced_compilation(print_notice):
        compile_kernels(config)


def compile_kernels(config: ControllerConfig | PlantConfig) -> None:
    """Compile what the nodes call: those of controller and watchdog, or that of the plant."""
    if isinstance(config, ControllerConfig):
        Guard(config)
        JointStateDecoder(config.joints)
        TorqueWatchdog(config, _ANY_TIMEOUT)  # rehearses
    else:
        plant_of(config).compile()

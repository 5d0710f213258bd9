# SPDX-License-Identifier: Apache-2.0
"""One run over ROS: arm, controller and recorder as processes, from their start to their end."""

from __future__ import annotations

import os
import time
from math import inf
from pathlib import Path

from blf_dsc_controller.cli.entry import require_ros
from blf_dsc_controller.cli.processes import NodeProcess
from blf_dsc_controller.cli.signals import Interruption
from blf_dsc_controller.configuration.nodes import CONTROLLER, PLANT, RECORDER
from blf_dsc_controller.configuration.plant import PlantConfig

# In the order in which they start. They end the other way round: the recorder last, since it is to
# have what the others say until their end.
_MODULES = {
    RECORDER: 'blf_dsc_controller.nodes.recorder_node',
    CONTROLLER: 'blf_dsc_controller.nodes.controller_node',
    PLANT: 'sim_plant.node',
}
_PATIENCE = 5.0  # s, at most, until a loop that runs is seen to do so, also on a busy machine


def run_session(plant: PlantConfig, out: Path, domain: int) -> bool:
    """Run the three nodes on `out/config.yaml` until the plant has ended.

    Returns:
        False if SIGINT or SIGTERM ended it before.

    Raises:
        NoRosError: rclpy is not installed.
        NodeFailedError: a node ended with an error.
    """
    require_ros()
    logs = out / 'logs'
    logs.mkdir()
    environment = {
        'ROS_DOMAIN_ID': str(domain),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_LOG_DIR': str(logs / 'ros'),
    }
    os.environ.update(environment)
    nodes: list[NodeProcess] = []
    remark = ''
    with Interruption() as interruption:
        try:
            for name, module in _MODULES.items():
                log = logs / f'{name}.log'
                nodes.append(NodeProcess(name, module, out / 'config.yaml', log, environment))
            remark = _watch(plant, nodes, interruption)
        finally:
            for node in reversed(nodes):
                node.stop()
        recorder, *loop = nodes
        for node in loop:
            node.check()
        recorder.check(remark)
        return not interruption.came


def _watch(plant: PlantConfig, nodes: list[NodeProcess], interruption: Interruption) -> str:
    """Watch over the nodes until the plant ends; return what is to be said of the recorder's end.

    A loop that has begun goes on without its recorder; its first sign may come a little later.
    """
    from blf_dsc_controller.cli.progress_watch import Watch

    recorder, *loop = nodes
    ended, said = inf, False
    with Watch(plant) as watch:
        while loop[-1].is_running and not interruption.came:
            for node in loop:
                node.check()
            if not recorder.is_running:
                ended = min(ended, time.monotonic())
                if watch.has_begun and not said:
                    said = True
                    watch.say(f'{recorder.name} has ended: the loop goes on and is not recorded')
                if not watch.has_begun and time.monotonic() > ended + _PATIENCE:
                    recorder.check()
            watch.wait(0.1)
    return '' if recorder.is_running else ' while the loop went on without it'

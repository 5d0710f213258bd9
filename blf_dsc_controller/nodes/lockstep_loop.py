# SPDX-License-Identifier: Apache-2.0
"""Controller and plant in one process, for lock-step.

These are the nodes of the two processes, with the same topics and messages. The
middleware hands a message to a node of the same process without the network, and no
process waits to be scheduled: in lock-step, where each waits for the other, a sample
takes a fraction of the time.
"""

from __future__ import annotations

import sys

from blf_dsc_controller.nodes import process
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode


def main() -> int:
    """Run both nodes until the plant has finished."""
    return process.run(ControllerNode, PlantNode)


if __name__ == '__main__':
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""The README's animation: the live view of a Panda that picks up 2 kg. `make pictures`.

Controller, arm and view are nodes of this process, and the loop is in lock-step: it
stands still while the browser draws.
"""

from __future__ import annotations

import io
import time
from pathlib import Path

import chromium
import numpy as np
from PIL import Image
from ros_rig import RosRig

from blf_dsc_controller import load_loop
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.nodes.controller_node import ControllerNode
from blf_dsc_controller.nodes.plant_node import PlantNode
from blf_dsc_controller.view.node import ViewNode

OUT = Path('doc/view.webp')
RATE = 8.0  # frames per second
TIMES = np.arange(17.0, 26.0, 0.25)  # s; it picks up 2 kg at 20 s
SETTLE = 1.5  # s, until the browser has drawn a frame without a GPU
WINDOW = (1200, 880)
NOTICE = (
    "document.querySelectorAll('[class*=Notification]').forEach(each => each.remove())"
)


def advance(ros, arm, view, end):
    """Let the loop run until this time [s], with as many snapshots as in real time."""
    while not view.past or view.past[-1].time < end:
        ros.run(arm, 33)
        view.update()


def pictures():
    """Yield screenshots of the page at each of `TIMES`."""
    ros, loop = RosRig(), load_loop('panda')
    try:
        view = ros.add(ViewNode, port=18380)
        arm = ros.add(PlantNode, flatten(loop.plant) | {'mode': 'lockstep'})
        ros.add(ControllerNode, flatten(loop.controller))
        advance(ros, arm, view, TIMES[0])
        with chromium.opened(*WINDOW, chromium.WEBGL) as (page, _):
            page.goto(view.page.url)
            page.wait_for_function(
                "(document.body?.innerText ?? '').includes('torque')"
            )
            time.sleep(10 * SETTLE)  # the page fades in
            page.evaluate(NOTICE)
            for at in TIMES:
                advance(ros, arm, view, at)
                view.page.plot(list(view.past))
                time.sleep(SETTLE)
                yield Image.open(io.BytesIO(page.screenshot())).convert('RGB')
    finally:
        ros.close()
        view.close()


def main():
    """Write an endless animation."""
    _, first, *others = pictures()  # at the first one the camera is not there yet
    duration = round(1000.0 / RATE)
    first.save(
        OUT,
        save_all=True,
        append_images=others,
        duration=duration,
        loop=0,
        quality=60,
        method=6,
    )
    print(f'{OUT}: {OUT.stat().st_size / 1e6:.2f} MB')


if __name__ == '__main__':
    main()

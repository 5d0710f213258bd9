# SPDX-License-Identifier: Apache-2.0
"""The README's animation: the live view of a Panda that picks up 2 kg. `make pictures`.

The run is offline and played from a bag, so that the animation does not depend on the computer.
"""

from __future__ import annotations

import argparse
import io
import tempfile
import time
from pathlib import Path

import chromium
import numpy as np
from PIL import Image

from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.simulation.bag import write_bag
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.view.bag import BagPlayer
from blf_dsc_controller.view.page import Page

TIMES = np.arange(17.0, 26.0, 0.25)  # s; it picks up 2 kg at 20 s
SETTLE = 1.5  # s, until the browser has drawn a frame without a GPU
RATE = 8.0  # frames per second
WINDOW = (1200, 880)
NOTICE = "document.querySelectorAll('[class*=Notification]').forEach(each => each.remove())"


def pictures(bag):
    """Yield screenshots of the page at each of `TIMES`."""
    served = Page('127.0.0.1', 18380)
    try:
        player = BagPlayer(served, bag)
        player.slider.value = TIMES[0]
        player.update(0.0)
        with chromium.opened(*WINDOW, chromium.WEBGL) as (page, _):
            page.goto(served.url)
            page.wait_for_function("(document.body?.innerText ?? '').includes('t = ')")
            time.sleep(10 * SETTLE)  # the page fades in
            page.evaluate(NOTICE)
            for at in TIMES:
                player.slider.value = float(at)
                player.update(0.0)
                time.sleep(SETTLE)
                yield Image.open(io.BytesIO(page.screenshot())).convert('RGB')
    finally:
        served.close()


def main():
    """Write the animation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--out', type=Path, default=Path('doc/view.webp'))
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        bag = folder / 'panda' / 'bag'
        bag.parent.mkdir()
        loop = load_loop('panda', {'sim_plant': {'duration': 27.0}})
        record = simulate(loop.controller, loop.plant)
        write_bag(bag, record, loop.controller, 'none', loop.plant)
        first, *others = pictures(bag)
        first.save(
            options.out,
            save_all=True,
            append_images=others,
            duration=round(1000.0 / RATE),
            loop=0,
            quality=60,
            method=6,
        )
    print(f'{options.out}: {options.out.stat().st_size / 1e6:.2f} MB')


if __name__ == '__main__':
    main()

# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc view`: serve the page of a running system or of a bag."""

from __future__ import annotations

import sys
from argparse import Namespace

from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.cli.main import require_ros
from blf_dsc_controller.view.address import LOCAL, open_to_others
from blf_dsc_controller.view.page import Page


def view(options: Namespace) -> int:
    """Serve the page until Ctrl-C."""
    if options.bag is None:
        require_ros()
        from blf_dsc_controller.view.node import main

        given = (f'host:={options.host}', f'port:={options.port}')
        words = [word for one in given for word in ('-p', one)]
        if options.namespace:
            words += ['-r', f'__ns:=/{options.namespace.strip("/")}']
        sys.argv[1:] = ['--ros-args', *words]
        return main()
    from blf_dsc_controller.view.bag import BagPlayer

    page = Page(options.host, options.port)
    try:
        player = BagPlayer(page, options.bag, options.namespace, NameMap.parse(options.map))
        print(f'{options.bag} is shown at {page.url}  (Ctrl-C to quit)', flush=True)
        if options.host not in LOCAL:
            print(f'warning: {open_to_others(options.host)}', file=sys.stderr)
        player.play()
    finally:
        page.close()
    return 0

# SPDX-License-Identifier: Apache-2.0
"""Run the command `blf_dsc` with `python -m blf_dsc_controller`."""

import sys

from blf_dsc_controller.cli.start import main

if __name__ == '__main__':
    sys.exit(main())

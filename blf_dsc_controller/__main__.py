# SPDX-License-Identifier: Apache-2.0
"""`python -m blf_dsc_controller` is the command `blf_dsc`."""

import sys

from blf_dsc_controller.cli.main import main

if __name__ == '__main__':
    sys.exit(main())

# SPDX-License-Identifier: Apache-2.0
"""The project's own tables, each by one command: `python -m benchmark` lists them."""

import sys
from pathlib import Path

# Some tables are of what the tests use: random arms, laws of friction, the law in plain Python.
sys.path.append(str(Path(__file__).parents[1] / 'test'))

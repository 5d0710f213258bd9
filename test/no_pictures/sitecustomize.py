# SPDX-License-Identifier: Apache-2.0
"""Empty pictures of commands in processes of their own, where no test looks at them.

Python runs this file where its folder is in PYTHONPATH: see `command.NO_PICTURES`. To
load matplotlib and to draw takes two thirds of a short run.
"""

import sys
from pathlib import Path
from types import ModuleType


def draw_panels(path, *_arguments, **_named):
    path.touch()


def draw(_run, folder, _metrics=None):
    path = Path(folder, 'tracking.png')
    draw_panels(path)
    return [path]


_FIGURES = 'blf_dsc_controller.analysis.figures'
sys.modules[_FIGURES] = ModuleType(_FIGURES)
sys.modules[_FIGURES].draw = draw
sys.modules[_FIGURES].draw_panels = draw_panels

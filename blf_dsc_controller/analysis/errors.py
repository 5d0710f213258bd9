# SPDX-License-Identifier: Apache-2.0
"""What can be missing to make a report."""

from __future__ import annotations

from blf_dsc_controller.errors import BlfDscError


class NoPlotlyError(BlfDscError):
    """The library that draws the page is not installed."""

    def __init__(self) -> None:
        super().__init__(
            'the page is drawn by plotly, which is not installed: '
            "pip install 'blf_dsc_controller[report]'"
        )

# SPDX-License-Identifier: Apache-2.0
"""The parameter file of a commissioning: what was found as its comment, and what was chosen."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from blf_dsc_controller import __version__
from blf_dsc_controller.commissioning import files, page
from blf_dsc_controller.commissioning.commissioned import Commissioned
from blf_dsc_controller.configuration.nodes import dump, load_loop, read
from sim_plant.settings import true_rotors

_WIDTH = 98


class Content(NamedTuple):
    """What is printed of a result, and written."""

    lines: list[str]  # wrapped
    nodes: Mapping[str, object]  # empty: no gains have the margin


class CommissionedFile(NamedTuple):
    """A parameter file to write."""

    path: Path
    source: Path  # the parameter file of the arm
    name: str  # of this file, as it was given
    command: str
    is_simulated: bool
    missing: tuple[str, ...] = ()  # sentences on what could not be measured

    def content(self, found: Commissioned) -> Content:
        """Return what was commissioned and when, the sentences of the page, and the parameters.

        What is missing comes last: it was said long before, and the file is to say it, too.
        """
        origin = (
            f'{self.name} commissioned on {found.date} by blf_dsc_controller {__version__}, with a '
            f'modulus margin of {found.choice.margin.value:.2g}'
        )
        found_out = page.sentences(found, is_simulated=self.is_simulated)
        lines = wrapped([origin, *found_out, *self.missing])
        if not found.has_margin:
            return Content(lines, {})
        rotors = None
        if self.is_simulated:
            rotors = true_rotors(load_loop(self.source).plant)
        return Content(lines, files.of_commissioned(read(self.source), found, rotors))

    def write(self, content: Content) -> None:
        """Write the file."""
        lines = [self.command, *content.lines]
        dump(self.path, content.nodes, ''.join(f'# {line}\n' for line in lines))


def wrapped(sentences: Sequence[str]) -> list[str]:
    """Return sentences as lines of the terminal's width."""
    return [line for each in sentences for line in textwrap.wrap(each, _WIDTH)]

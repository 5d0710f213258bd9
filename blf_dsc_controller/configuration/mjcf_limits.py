# SPDX-License-Identifier: Apache-2.0
"""Limits on what an MJCF asks of MuJoCo's compiler, which builds anything.

A line can ask for billions of elements: a height field, a texture, replicates within
replicates.  So texts and included files are counted before they are compiled.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from math import prod
from pathlib import Path

from blf_dsc_controller.arms.xml_text import XmlError, parse_xml
from blf_dsc_controller.configuration.files import read_text
from blf_dsc_controller.errors import BlfDscError

_MOST_ELEMENTS = 20_000  # after replication
_MOST_CELLS = 1 << 24  # of a height field, texture or grid
_MOST_FILES = 200  # that include each other
_FILES = ('include', 'model')  # elements that name another one
_COUNTS = ('count', 'cellcount')  # numbers of copies, or of cells along three axes
_GRIDS = (
    *(('nrow', 'ncol'), ('width', 'height'), *((key,) for key in _COUNTS)),
    *(('nkey',), ('nuserdata',), ('nuser_body',), ('nuser_jnt',), ('nuser_geom',)),
    *(('nuser_site',), ('nuser_cam',), ('nuser_tendon',), ('nuser_actuator',)),
    *(('nuser_sensor',), ('dim',)),
)


def check_size(text: str, folder: Path | None, name: str) -> None:
    """Raise BlfDscError if a text, or a file that it includes, asks for too much.

    Files are included from a `folder`; None: from nowhere.
    """
    total = _Counter(folder, name).count(text, 1)
    if total > _MOST_ELEMENTS:
        raise BlfDscError(
            f'{name}: has {total} elements, with what it replicates; at most {_MOST_ELEMENTS} are '
            'read: remove what is not part of the arm'
        )


class _Counter:
    """Count of the elements of a file and of all that it includes."""

    def __init__(self, folder: Path | None, name: str) -> None:
        self._folder = folder
        self._name = name
        self._files = 0

    def count(self, text: str, copies: int) -> int:
        """Return how many elements a text becomes, of which there are so many copies."""
        try:
            root = parse_xml(text)
        except XmlError as error:
            raise BlfDscError(f'{self._name} is not valid XML: {error}') from error
        return self._of(root, copies)

    def _of(self, element: ET.Element, copies: int) -> int:
        total = copies
        waiting = [(element, copies)]
        while waiting and total <= _MOST_ELEMENTS:
            parent, of_parent = waiting.pop()
            for child in parent:
                own = of_parent * self._copies(child)
                total += own
                if child.tag in _FILES:
                    total += self._included(child.get('file', ''), own)
                waiting.append((child, own))
        return total

    def _copies(self, element: ET.Element) -> int:
        """Return how many elements one becomes; raise BlfDscError if its cells are too many."""
        of_tag = (('size',),) if element.tag == 'numeric' else ()
        for grid in (*_GRIDS, *of_tag):
            cells = prod(max(_whole(element, key), 1) for key in grid)
            if cells > _MOST_CELLS:
                words = ' '.join(f'{key}="{element.get(key)}"' for key in grid)
                raise BlfDscError(
                    f'{self._name}: <{element.tag} {words}> asks for {cells} cells; at most '
                    f'{_MOST_CELLS} are read: remove it, an arm needs none'
                )
        if element.tag in ('replicate', 'composite', 'flexcomp'):
            return max(prod(max(_whole(element, key), 1) for key in _COUNTS), 1)
        return 1

    def _included(self, file: str, copies: int) -> int:
        """Return how many elements an included file becomes; none if it cannot be read."""
        self._files += 1
        if self._folder is None or self._files > _MOST_FILES:
            return 0
        try:
            return self.count(read_text(self._folder / file), copies)
        except (OSError, UnicodeDecodeError):
            return 0  # MuJoCo says so


def _whole(element: ET.Element, key: str) -> int:
    """Return the product of the whole numbers of an attribute; 1 if there are none."""
    words = element.get(key, '').split()
    numbers = [int(word) for word in words if word.isdigit() and len(word) < 12]
    return prod(numbers) if numbers else 1

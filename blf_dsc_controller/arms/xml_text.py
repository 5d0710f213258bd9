# SPDX-License-Identifier: Apache-2.0
"""XML as robots are described in: parsed as urdfdom does, without namespaces.

A prefix is a part of the name, and need not be declared; `xmlns` is an attribute like
any other.  Entities are not expanded: a few lines of them can become gigabytes.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from xml.parsers import expat

from blf_dsc_controller.errors import BlfDscError

_MARK = '\ufeff'  # byte order mark, with which some editors begin a file


class XmlError(BlfDscError):
    """A text that is no XML."""


def parse_xml(text: str) -> ET.Element:
    """Return the root element of a text.

    Raises:
        XmlError: it is not well formed, or has a <!DOCTYPE>.
    """
    builder = ET.TreeBuilder()
    parser = expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = _refuse_doctype
    try:
        parser.Parse(text.lstrip(_MARK), True)
    except (expat.ExpatError, UnicodeEncodeError) as error:
        raise XmlError(str(error)) from error
    return builder.close()


def _refuse_doctype(*_: object) -> None:
    raise XmlError('it must not have a <!DOCTYPE>: remove it, expand its entities')


def without_mark(text: str) -> str:
    """Return a text without a byte order mark."""
    return text.removeprefix(_MARK)

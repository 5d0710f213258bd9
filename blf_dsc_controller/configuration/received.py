# SPDX-License-Identifier: Apache-2.0
"""Parameters of a controller that somebody sent: in a bag, a journal or on a topic.

They are not trusted: no file that they name is read, and no code that they name runs.
A recorded controller holds the text of its URDF. Its law may be a file; only a replay
needs it, and runs the one that its user names by path and digest. All other readers
take the arm, the gains and the limits, which are the same whatever the law is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from blf_dsc_controller.configuration import law_file, mjcf
from blf_dsc_controller.errors import BlfDscError

_LAW = 'law'
_URDF = 'robot.urdf'
_SHOWN = 100  # characters of what was sent


def law_of(given: Mapping[str, Any]) -> str:
    """Return the file that received parameters name as their law; empty if none."""
    law = given.get(_LAW)
    return law if isinstance(law, str) and law_file.is_file(law) else ''


def without_law(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return received parameters without the law of a file and its gains."""
    if not law_of(given):
        return dict(given)
    gains = f'{law_file.GROUP}.'
    return {
        name: value
        for name, value in given.items()
        if name != _LAW and not name.startswith(gains)
    }


def without_files(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return received parameters without the law of a file, for `build`.

    Raises BlfDscError if they name a file with the arm.
    """
    check_arm(given)
    return without_law(given)


def with_law(given: Mapping[str, Any], law: str, digest: str) -> dict[str, Any]:
    """Return received parameters with the law that the user names as FILE@DIGEST.

    `digest` is the recorded one, to be read by the user; empty if unknown.

    Raises BlfDscError if a law of a file was received and the user names none, or the
    other way round, or if they name a file with the arm.
    """
    check_arm(given)
    received = law_of(given)
    if not received:
        if law:
            raise BlfDscError(
                f'got the law {law}, but the recorded one is of the package: leave it out'
            )
        return dict(given)
    if not law_file.is_pinned(law):
        raise BlfDscError(_refusal(received, digest))
    return {**given, _LAW: law_file.kept(law)}


def _refusal(received: str, digest: str) -> str:
    known = f' with the SHA-256 {digest[:_SHOWN]}' if digest else ''
    return (
        f'the recorded law is the file {received[:_SHOWN]!r}{known}. A file runs as code, '
        'and a bag may come from anybody: read the file, and if it may run, name it with its '
        'digest, --law FILE@SHA256 (sha256sum FILE prints it)'
    )


def check_arm(given: Mapping[str, Any]) -> None:
    """Raise BlfDscError unless the arm is the text of a URDF, or there is none."""
    arm = given.get(_URDF, '')
    is_text = isinstance(arm, str) and arm.lstrip().startswith('<')
    if arm and not (is_text and not mjcf.is_mjcf(arm)):
        raise BlfDscError(
            f'{_URDF}: got {str(arm)[:_SHOWN]!r}, but expected the text of a URDF, as controllers '
            'record it: files that a bag or a topic names are not read'
        )

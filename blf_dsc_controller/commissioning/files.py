# SPDX-License-Identifier: Apache-2.0
"""Parameter files with the motions of a commissioning, and with what was measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from blf_dsc_controller.commissioning.chosen import INTEGRAL
from blf_dsc_controller.commissioning.commissioned import Commissioned
from blf_dsc_controller.commissioning.planned import Planned
from blf_dsc_controller.configuration.files import Section
from blf_dsc_controller.configuration.nodes import CONTROLLER, DRIVE, PLANT, STUDY
from blf_dsc_controller.run import Floats

_Values = Mapping[str, object]


def of_motion(sections: Sequence[Section], planned: Planned) -> dict[str, _Values]:
    """Return the sections of a file with a motion in the place of its reference.

    A simulated arm begins in its posture and picks nothing up.  Motors get the torque alone, since
    it is what a bag records.
    """
    arm = {'initial.position': planned.posture.tolist(), 'duration': planned.duration}
    given = {f'/**/{CONTROLLER}': planned.values, f'/**/{PLANT}': arm}
    if any('feedback' in section.entries for section in sections):  # drive.feedback
        given[f'/**/{DRIVE}'] = {'feedback': 'host'}
    return _with(sections, given, removed=('reference.', 'events.'))


def of_commissioned(
    sections: Sequence[Section], found: Commissioned, rotors: Floats | None = None
) -> dict[str, _Values]:
    """Return the sections of a file with what was measured in the place of guesses.

    Gains of the law that the file gives are left out, since they follow; so is a factor on the
    rotors of the simulated arm, which those that were measured have.  An arm that was simulated
    keeps its `rotors` (n,) [kg m^2]: they may follow from the guesses.
    """
    chosen = found.parameters()
    of_robot = {
        name: value for name, value in chosen.items() if name.startswith('robot.')
    }
    own = {name: value for name, value in chosen.items() if name not in of_robot}
    given = {'/**': of_robot, f'/**/{CONTROLLER}': own}
    if rotors is not None:
        given[f'/**/{PLANT}'] = {'truth.rotor_inertia': rotors.tolist()}
    return _with(sections, given, removed=(INTEGRAL, 'truth.rotor_factor'))


def _with(
    sections: Iterable[Section],
    given: Mapping[str, _Values],
    removed: tuple[str, ...] = (),
) -> dict[str, _Values]:
    """Return sections as they are, but for the given values and names removed by their start."""
    names = {name for values in given.values() for name in values}
    nodes: dict[str, dict[str, object]] = {}
    for section in sections:
        if section.pattern.endswith(f'/{STUDY}'):
            continue
        kept = nodes.setdefault(section.pattern, {})
        kept |= {
            name: entry.value
            for name, entry in section.entries.items()
            if name not in names and not name.startswith(removed)
        }
    for pattern, values in given.items():
        nodes[pattern] = {**nodes.get(pattern, {}), **values}
    return dict(nodes)

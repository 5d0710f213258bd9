# SPDX-License-Identifier: Apache-2.0
"""The torque ripple in the result of a commissioning: a table, and how sure it is."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from blf_dsc_controller.commissioning.ripple import to_learn
from blf_dsc_controller.commissioning.slow_motion import (
    SECONDS,
    SlowMotion,
    slow_frequencies,
)
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.identification.ripple import Listed, Ripples
from blf_dsc_controller.identification.summary import table_of_ripples
from blf_dsc_controller.numerics.intervals import TWO_SIDED
from blf_dsc_controller.run import SLIDING

_FOLLOWS = (
    'torque ripple is not measured: the slow motion that shows it comes after these gains are '
    'written'
)
_TRUST = '. No other joint shows it: trust it if a second slow motion shows it, too'


def description(motion: SlowMotion) -> str:
    """Return in a sentence how long a slow motion takes, and where its joints go."""
    config = motion.config
    ranges = ', '.join(
        f'{joint} {low:.2f} to {high:.2f} {units.position}'
        for joint, units, low, high in zip(
            config.joints, config.units, *motion.ranges, strict=True
        )
    )
    return (
        f'slow motion, for {motion.duration:.0f} s: {ranges}. The joints meet at other positions '
        'than along the reference: keep all of this space free'
    )


def ripple_table(config: ControllerConfig, ripples: Sequence[Ripples]) -> str:
    """Return the torque ripple of each joint, with the columns of `blf_dsc identify`."""
    return table_of_ripples(config.robot.chain(config.joints).joints, ripples)


def of_ripple(
    config: ControllerConfig, ripples: Sequence[Ripples], *, follows: bool = False
) -> Iterator[str]:
    """Yield what is written and how sure it is.

    Without ripples, yield by which motion they are found, or that it follows.
    """
    if not ripples:
        yield from [_FOLLOWS] if follows else _of_motion(config)
        return
    listed = to_learn(ripples)
    if listed:
        yield (
            f'torque ripple is written as learning.ripple_cycles: '
            f'{_listed([each.cycles for each in listed])}, by which the law learns to compensate it'
        )
    else:
        known = _listed(config.learning.ripple_cycles)
        yield f'no torque ripple was found: learning.ripple_cycles stays {known}'
    for each in listed:
        yield _of_entry(config, each)
    little, repeated = [], []
    for joint, own in zip(config.joints, ripples, strict=True):
        if not own.is_known:
            little.append(joint)
        elif own.found and own.repeats:
            repeated.append(joint)
    if little:
        yield f'{", ".join(little)} moved too little to show a torque ripple'
    if repeated:
        yield (
            f'{", ".join(repeated)} repeated the same motion, in which friction looks like a '
            'ripple: what these joints show is not used'
        )


def _of_entry(config: ControllerConfig, entry: Listed) -> str:
    """Return how well an entry of the list is known, and by which joints."""
    unit = ' or '.join(
        dict.fromkeys(
            'rad/m' if config.units[j] == SLIDING else 'per turn' for j in entry.joints
        )
    )
    names = ', '.join(config.joints[j] for j in sorted(entry.joints))
    alone = len(entry.joints) == 1 < len(config.joints)
    return (
        f'{entry.cycles:g} {unit} is known to +- {TWO_SIDED * entry.deviation:.2g}; it shows in '
        f'both directions and both halves of the motion of {len(entry.joints)} of '
        f'{len(config.joints)} joints ({names}){_TRUST * alone}'
    )


def _of_motion(config: ControllerConfig) -> Iterator[str]:
    """Yield by which motion and command the torque ripple of the drives is found."""
    if config.learning.ripple_cycles:
        return
    slow = _listed(slow_frequencies(config))
    how = f', by reference.frequency: {slow} in a copy of the file' * (slow != '[]')
    yield (
        'torque ripple of the drives is not looked for: the arm moved too little. '
        f'{SECONDS:g} s of a slow motion that does not repeat show it{how}: give its bag to '
        'blf_dsc identify, and the learning.ripple_cycles that it prints to this file'
    )


def _listed(values: Iterable[float]) -> str:
    return f'[{", ".join(f"{each:g}" for each in values)}]'

# SPDX-License-Identifier: Apache-2.0
"""Every table by its name, with what it shows.

The module of a table is called as the table is.  Its `main` makes the table from the
options that its `arguments`, if it has any, adds to a parser.
"""

from __future__ import annotations

BENCH = 'bench'
"""Its peers run with the threads that they have elsewhere; all others with one."""

GROUPS = {
    'laws side by side': {
        'paper': "the paper's simulation with every law: claims, sweeps, pictures",
        'tuning': 'gains of the presets of two links, all laws tuned alike',
        'arms': 'laws on a Panda and a UR5e with wrong URDFs; parts of the bandwidth',
        'changes': '14,000 randomly changing arms, each with and without learning',
        'soft-pairs': 'changing arms with elastic gears, with and without learning',
        'random-arms': 'random arms with elastic gears: this law and its rivals',
        'many-arms': 'a thousand of them with this law: what is rare',
    },
    'gains': {
        'presets': 'errors of the presets, with and without learning',
        'pick-and-place': 'what the same box costs that comes again, announced or not',
        'commissioning': 'random arms, commissioned and put to work',
    },
    'time': {
        BENCH: 'the loop, the node and the wire against peers, into RESULTS.md',
    },
}
TABLES = {name: about for group in GROUPS.values() for name, about in group.items()}


def module_of(name: str) -> str:
    """Return the module of a table."""
    return f'benchmark.{name.replace("-", "_")}'

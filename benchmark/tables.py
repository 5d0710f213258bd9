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
        'robustness': 'what laws of equal gains bear: late torques, lighter drives',
        'composite': 'composite learning as published for a Panda, in a soft loop',
    },
    'gains': {
        'margins': 'margins of the default gains, and errors at a pick-up',
        'elastic': 'where the gains of the presets hold, by the stiffness of gears',
        'presets': 'what the presets err by, with and without learning',
        'soft-arms': 'errors at gains that gears bear, against goals and rivals',
        'measured-arms': 'the same arms, each commissioned by itself first',
        'two-encoders': 'what encoders at motors and links are worth together',
        'known-load': 'what it would be worth to know a load at once',
        'damping-lag': 'UR5es whose damping lags, and the same ones without',
        'notches': 'whether notch filters let gains grow more than lags',
        'stop-damping': 'how much of the damping of a stop a joint bears',
        'commissioning': 'random arms, commissioned and put to work',
        'gain-rules': 'gains that are measured, and gains by rules',
        'load-observer': 'what joint torque sensors are worth',
        'observer-poles': 'how fast the load observer may be',
        'chosen-poles': 'how fast commissioning makes it, and what that is worth',
        'motor-feedback': 'feedback through a bus, and inside motors',
        'holding': 'arms with soft drives, as users report them and under this law',
    },
    'bounds, loads and contacts': {
        'tool-bound': 'how tight and how safe a certified bound at the tool is',
        'contacts': 'how soon a push is found, with the learned model and the URDF',
        'touch': 'the interval of the external torque, and pushes in slow motion',
        'nothing-changes': 'changes and weights that are not there',
        'load-friction': 'loads weighed while gears lose torque or get warm',
        'first-window': 'changes of the arm before the first window is full',
        'wrong-load': 'a Franka Research 3 whose declared load is wrong',
    },
    'identification': {
        'identification': 'arms identified and loads weighed, at random',
        'intervals': 'whether the intervals hold where the model does not',
        'league': 'models of real and simulated robots by several methods',
        'stiffness': 'stiffness of gears from positions of motors and links',
        'ripple': 'periods of torque ripple that are found, or are not there',
    },
    'references': {
        'streams': 'how far behind and how smooth the reference of a stream is',
        'shaping': 'whether motions make elastic arms ring, and shaping them',
        'scaling': "how many of MoveIt's trajectories are stretched",
    },
    'time': {
        BENCH: 'the loop, the node and the wire against peers, into RESULTS.md',
    },
}
TABLES = {name: about for group in GROUPS.values() for name, about in group.items()}


def module_of(name: str) -> str:
    """Return the module of a table."""
    return f'benchmark.{name.replace("-", "_")}'

# SPDX-License-Identifier: Apache-2.0
"""`bag_replay`: the recorded states through the controller again, compared to the bit."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np

from blf_dsc_controller.bags.name_map import NameMap
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.configuration.params_file import load, locate
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.replay.open_loop import Answer, answer
from blf_dsc_controller.replay.recorded import Outcome, replay

DIFFERENT = 3
"""Exit code where the replay found other numbers than the bag holds."""


def parser() -> argparse.ArgumentParser:
    """Command-line options."""
    options = argparse.ArgumentParser(
        prog='bag_replay',
        description='Feed the joint states of a bag through the controller, with the recorded '
        'configuration, and compare what it says bit for bit.',
        epilog='Exit code: 0 bit-equal, 3 different, 1 an error.',
    )
    options.add_argument('bag', type=Path, help='folder of the bag, or its .mcap, .db3 or .bag')
    options.add_argument(
        '--config',
        help='another parameter file or preset: what it would have commanded (open loop)',
    )
    options.add_argument(
        '--map',
        action='append',
        default=[],
        metavar='OURS=THEIRS',
        help='what a topic or a joint is called in the bag, as in commands=/arm/torque or '
        'joint1=shoulder; with --config',
    )
    options.add_argument(
        '--namespace', default='', help='of the robot to look at, if the bag holds several'
    )
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parser().parse_args(arguments)
    begin = perf_counter()
    try:
        if options.config is None:
            outcome = replay(options.bag, options.namespace)
            lines = list(_told(outcome))
            code = 0 if outcome.difference is None else DIFFERENT
            seconds, samples = outcome.states.duration, outcome.states.stamp.size
        else:
            config = load(locate(options.config), CONTROLLER, ControllerConfig)
            names = NameMap.parse(options.map)
            found = answer(options.bag, config, options.namespace, names)
            lines = list(_answered(found))
            code = 0
            seconds, samples = found.states.duration, found.states.stamp.size
    except BlfDscError as error:
        print(f'bag_replay: {error}', file=sys.stderr)
        return 1
    took = perf_counter() - begin
    print(f'{samples} samples, {seconds:.3f} s in {took:.2f} s: {seconds / took:.0f}x real time')
    print('\n'.join(lines))
    return code


def _told(outcome: Outcome) -> Iterator[str]:
    for one in outcome.comparisons:
        verdict = 'bit-equal' if one.difference is None else 'DIFFERENT'
        left_out = f' (not compared: {one.left_out})' if one.left_out else ''
        yield f'{one.topic}: {one.values} values {verdict}{left_out}'
    if outcome.changes:
        yield f'{outcome.changes} changes of parameters replayed where they took effect'
    if outcome.states.passed_over:
        yield f'{outcome.states.passed_over} states passed over: the controller did not answer them'
    yield from (f'note: {remark}' for remark in outcome.remarks)
    if outcome.difference is None:
        yield 'bit-equal: the controller says again what the bag holds'
    else:
        yield f'DIFFERENT, first at {outcome.difference}'


def _answered(found: Answer) -> Iterator[str]:
    yield 'OPEN LOOP: the arm moved under the recorded torques and does not feel these'
    yield f'recorded torque: {found.source}'
    told = found.replayed.told
    limit = np.array(found.replayed.config.torque.limit)
    difference = found.difference
    for i, joint in enumerate(found.replayed.config.joints):
        known = difference[np.isfinite(difference[:, i]), i]
        apart = (
            f'differs from the recorded by rms {np.sqrt(np.mean(known**2)):.4g}, '
            f'max {np.abs(known).max():.4g} N m'
            if known.size
            else 'is not to be compared: no torque was recorded'
        )
        at_limit = np.mean(np.abs(told.torque[:, i]) >= limit[i])
        yield (
            f'{joint}: torque {apart}; at its limit {100 * at_limit:.3g} % of the time; '
            f'max |xi1| / bound {found.error_ratio[i]:.3g}'
        )


if __name__ == '__main__':
    sys.exit(main())

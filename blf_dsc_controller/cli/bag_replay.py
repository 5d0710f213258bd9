# SPDX-License-Identifier: Apache-2.0
"""`bag_replay`: the recorded states through the controller again, compared to the bit."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np

from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.bags.name_map import NameMap
from blf_dsc_controller.cli.entry import require_ros
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.configuration.params_file import load, locate
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.topics import COMMANDS
from blf_dsc_controller.replay.identify import Identification, identify
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
    options.add_argument(
        '--learn',
        action='store_true',
        help='identify the arm: only the learning, on the recorded states and torques',
    )
    playing = options.add_argument_group('playing over ROS')
    playing.add_argument('--play', action='store_true', help='publish the recorded topics')
    playing.add_argument('--rate', type=float, default=1.0, help='speed; 0: as fast as goes (1)')
    playing.add_argument('--clock', action='store_true', help="publish the bag's time on /clock")
    playing.add_argument('--loop', action='store_true', help='begin again at the end')
    playing.add_argument('--start-paused', action='store_true', help='wait for ~/resume')
    playing.add_argument(
        '--delay', type=float, default=1.0, help='time for subscribers to be found [s] (1)'
    )
    playing.add_argument(
        '--remap', action='append', default=[], metavar='FROM:=TO', help='as ROS remaps'
    )
    return options


def _learner(options: argparse.Namespace) -> tuple[Path, ControllerConfig, str, NameMap]:
    """Arguments of `identify`: the recorded configuration, unless another is named."""
    if options.config is None:
        config = read_context(options.bag).controller().config
    else:
        config = load(locate(options.config), CONTROLLER, ControllerConfig)
    return options.bag, config, options.namespace, NameMap.parse(options.map)


def _learned(found: Identification) -> Iterator[str]:
    yield f'torque: {found.source}; window from {found.begin:.3f} s to {found.end:.3f} s'
    width = max(len(name) for name in found.names)
    for name, value, deviation in zip(found.names, found.estimate, found.deviation, strict=True):
        if np.isnan(value):
            yield f'{name:{width}}  not to be told from the others: its column was refused'
        else:
            yield f'{name:{width}}  {value:10.6g} +- {2 * deviation:.2g} (95 %)'
    verdict = 'enough' if found.is_excited else 'NOT ENOUGH: do not trust these figures'
    yield (
        f'excitation {found.excitation:.3g}, asked for {found.threshold:.3g}: {verdict}; '
        f'left over {found.residual:.3g} N m rms'
    )


def _play(options: argparse.Namespace) -> None:
    require_ros()
    from blf_dsc_controller.nodes.player_node import play

    play(
        options.bag,
        options.rate,
        loop=options.loop,
        clock=options.clock,
        paused=options.start_paused,
        delay=options.delay,
        remaps=options.remap,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parser().parse_args(arguments)
    begin = perf_counter()
    try:
        if options.play:
            _play(options)
            return 0
        if options.learn:
            print('\n'.join(_learned(identify(*_learner(options)))))
            return 0
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
    yield from outcome.done
    if outcome.states.passed_over:
        yield f'{outcome.states.passed_over} states passed over: the controller did not answer them'
    yield from (f'note: {remark}' for remark in outcome.remarks)
    if outcome.difference is None:
        commands = [one for one in outcome.comparisons if one.topic.endswith(COMMANDS.leaf)]
        is_whole = not any(one.left_out for one in commands)
        held = 'what the bag holds' if is_whole else 'what could be compared, which is not all'
        yield f'bit-equal: the controller says again {held}'
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

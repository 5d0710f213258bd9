# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc replay`: run a bag through the controller again: verify, what-if, learn or play."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from time import perf_counter

import numpy as np

from blf_dsc_controller.bags.content import NameMap, read_content
from blf_dsc_controller.cli.main import require_ros
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.configuration.params_file import load, locate
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.messages.journal import EventType
from blf_dsc_controller.replay.learn import learn
from blf_dsc_controller.replay.verify import Verification, verify
from blf_dsc_controller.replay.what_if import WhatIf, what_if

DIFFERENT = 3
"""Exit code if the replay differs from the bag."""

PARTIAL = 4
"""Exit code if all compared outputs are equal, but some outputs could not be compared."""


def replay(options: Namespace) -> int:
    """Replay a bag in the mode selected by the options, and print the result."""
    if options.play and options.map:
        raise BlfDscError('--map has no effect on --play: rename topics with --remap')
    if options.play:
        require_ros()
        from blf_dsc_controller.cli.play import play

        play(options)
        return 0
    config = None
    if options.config is not None:
        config = load(locate(options.config), CONTROLLER, ControllerConfig)
    names = NameMap.parse(options.map)
    begin = perf_counter()
    if options.learn:
        _learn(options, config, names)
    elif config is None:
        result = verify(options.bag, options.namespace, names)
        _print_speed(result.samples, result.duration, perf_counter() - begin)
        print('\n'.join(_verification(result)))
        if result.difference is not None:
            return DIFFERENT
        return PARTIAL if result.compared < 1.0 else 0
    else:
        found = what_if(options.bag, config, options.namespace, names)
        run = found.run
        _print_speed(run.stamp.size, run.duration, perf_counter() - begin)
        print('\n'.join(_open_loop(found, config)))
    return 0


def _learn(options: Namespace, config: ControllerConfig | None, names: NameMap) -> None:
    config = config or read_content(options.bag, options.namespace, names).controller_config()
    found = learn(options.bag, config, options.namespace, names)
    print(f'torque: {found.source}; window from {found.begin:.3f} s to {found.end:.3f} s')
    width = max(len(name) for name in found.names)
    for name, value, deviation in zip(found.names, found.estimate, found.deviation, strict=True):
        if np.isnan(value):
            print(f'{name:{width}}  unidentifiable: its column is rejected')
        else:
            print(f'{name:{width}}  {value:10.6g} +- {2 * deviation:.2g} (95 %)')
    verdict = 'enough' if found.is_excited else 'NOT ENOUGH'
    print(
        f'excitation {found.excitation:.3g}, threshold {found.threshold:.3g}: {verdict}; '
        f'residual {found.residual:.3g} N m rms of {found.torque:.3g}'
    )
    for line in (*_left_out(found.left_out), *found.notes, *found.doubts):
        print(line)


def _left_out(count: int) -> Iterator[str]:
    if count:
        yield f'note: {count} states left out: not finite, or with unknown torques'


def _print_speed(samples: int, seconds: float, took: float) -> None:
    print(f'{samples} samples, {seconds:.3f} s in {took:.2f} s: {seconds / took:.0f}x real time')


def _verification(result: Verification) -> Iterator[str]:
    for found in result.comparisons:
        verdict = 'bit-equal'
        if found.difference is not None:
            verdict = f'DIFFERENT by at most {found.largest:.3g}'
        left_out = f' (not compared: {found.left_out})' if found.left_out else ''
        yield f'{found.topic}: {found.values} values {verdict}{left_out}'
    for topic in result.not_compared:
        yield f'{topic}: not compared, as it holds text'
    yield from _events(result)
    if result.difference is not None:
        yield f'DIFFERENT, first at {result.difference}'
    elif result.compared < 1.0:
        percent = min(round(100.0 * result.compared, 2), 99.99)
        yield (
            f'PARTLY COMPARED: {percent:g} % of the numbers in the bag, which are bit-equal; the '
            'others could not be compared'
        )
    else:
        yield 'bit-equal: all numbers of the controller in the bag'


def _events(result: Verification) -> Iterator[str]:
    """Yield what happened in the run, and what limits the result."""
    types = [event.type for event in result.events]
    for type_, what in (
        (EventType.PARAMETERS, 'parameter changes'),
        (EventType.TRAJECTORY, 'trajectories'),
    ):
        if type_ in types:
            yield f'{types.count(type_)} {what} replayed where they took effect'
    if len(result.turns) > 1:
        yield f'replayed in order: {", ".join(result.turns)}'
    if result.safe_torques:
        yield f'{result.safe_torques} of the commands are safe torques, or on the ramp to one'
    if result.passed_over:
        yield f'{result.passed_over} states skipped: the controller did not use them'
    yield from (f'note: {remark}' for remark in result.remarks)


def _open_loop(found: WhatIf, config: ControllerConfig) -> Iterator[str]:
    yield 'OPEN LOOP: the arm moved under the recorded torques, not under these'
    yield f'recorded torque: {found.source}'
    yield from _left_out(found.left_out)
    for i, joint in enumerate(config.joints):
        known = found.difference[np.isfinite(found.difference[:, i]), i]
        difference = (
            f'differs from the recorded one by rms {np.sqrt(np.mean(known**2)):.4g}, '
            f'max {np.abs(known).max():.4g} N m'
            if known.size
            else 'cannot be compared: no torque was recorded'
        )
        at_limit = np.mean(np.abs(found.run.torque[:, i]) >= config.torque.limit[i])
        yield (
            f'{joint}: torque {difference}; at its limit {100 * at_limit:.3g} % of the time; '
            f'max |xi1| / bound {found.error_ratio[i]:.3g}'
        )

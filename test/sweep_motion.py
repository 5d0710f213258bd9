# SPDX-License-Identifier: Apache-2.0
"""Resets, activations, stops and hangs at many moments of one motion, in lock-step.

`python test/sweep_motion.py ur5e_driver reset --step 0.1 --seconds 10` prints by how much [rad/s]
a joint is faster than before and than it was asked to be, as `soak_motion` measures it: worst,
median, and how many moments are past the slack.  The arm holds 2 kg that nobody has told of.
Each event happens in a fork of the process, so that the motion goes on as if it had not.
"""

from __future__ import annotations

import argparse
import json
import os

import numpy as np
from test_hang import PATIENT, SLACK, Loop

BEGIN = 4.0  # s, from which on events happen
BEFORE = 0.2  # s, whose speeds an arm may have again
AFTER = 1.0  # s, that are looked at
PAUSED = 0.15  # s
STOPPED = 2.0  # s, in which an arm comes to rest


def reset(loop, _):
    loop.guard.starting.reset()


def pause(loop, _):
    loop.guard.deactivate()
    loop.run(PAUSED)
    loop.guard.starting.activate()


def stop(loop, _):
    """Stop, and reset the arm at rest."""
    loop.guard.fail('by hand')
    loop.run(STOPPED)
    loop.guard.starting.reset()


def hang(loop, seconds):
    loop.hang(seconds, queued=False)


def hang_queued(loop, seconds):
    loop.hang(seconds, queued=True)


EVENTS = {each.__name__: each for each in (reset, pause, stop, hang, hang_queued)}


def in_fork(call):
    """Return what a call returns in a fork of this process."""
    here, there = os.pipe()
    if os.fork() == 0:
        with os.fdopen(there, 'w') as pipe:
            json.dump(call(), pipe)
        os._exit(0)
    os.close(there)
    with os.fdopen(here) as pipe:
        found = json.load(pipe)
    os.wait()
    return found


def excess(loop, event, seconds, before):
    """Return the excess [rad/s] after an event, and whether the law runs 1 s later.

    `before` are the speeds (n,) [rad/s] that the arm has had.
    """
    event(loop, seconds)
    before = np.maximum(before, loop.speed)
    speed, asked = loop.run(AFTER)
    most = np.maximum(before, asked.max(axis=0))
    return float((speed.max(axis=0) - most).max()), loop.guard.supervisor.running


def sweep(preset, event, step, seconds, hangs):
    """Return what `excess` does of an event at each `step` [s] of so many seconds."""
    loop = Loop(preset, PATIENT, watched=event in (hang, hang_queued))
    speeds, _ = loop.run(BEGIN)
    samples = round(BEFORE / loop.config.sample_time)
    found = []
    for _ in range(round(seconds / step)):
        speeds = np.concatenate((speeds, loop.run(step)[0]))[-samples:]
        before = speeds.max(axis=0)
        found.append(in_fork(lambda b=before: excess(loop, event, hangs, b)))
    return found


if __name__ == '__main__':
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument('preset')
    options.add_argument('event', choices=EVENTS)
    options.add_argument('--step', type=float, default=0.1, help='s')
    options.add_argument('--seconds', type=float, default=5.0)
    options.add_argument('--hangs', type=float, default=0.1, help='s, of a hang')
    given = options.parse_args()
    found = sweep(
        given.preset, EVENTS[given.event], given.step, given.seconds, given.hangs
    )
    over = np.array([each for each, _ in found])
    stopped = sum(not runs for _, runs in found)
    print(
        f'{given.preset} {given.event}: worst {over.max():+.3f} rad/s, median '
        f'{np.median(over):+.3f}, {(over > SLACK).sum()} of {over.size} past {SLACK}, '
        f'{stopped} stopped'
    )

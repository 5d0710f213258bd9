# SPDX-License-Identifier: Apache-2.0
"""A policy that returns chunks of actions at 30 Hz, of which the first half is carried out.

python examples/04_policy_chunks.py [ROBOT] [CONFIG]    (simulated, panda)

The reference follows as far behind as the arm needs to brake, and smoothly also where a
new chunk disagrees with the last one.  While the policy takes too long, the arm rests.
"""

import sys
import time

import numpy as np

import blf_dsc_controller as blf

RATE = 30.0  # Hz
CHUNK = 16  # actions, of which half are carried out


def policy(q: np.ndarray, count: int) -> np.ndarray:
    """Return the next actions (CHUNK, n) [rad]; yours reads pictures, too."""
    t = (count + np.arange(CHUNK)) / RATE
    wave = 0.15 * np.sin(2.0 * t)
    noise = np.random.default_rng(count).normal(0.0, 0.002, q.shape)
    return q + noise + wave[:, None]


robot = sys.argv[1] if len(sys.argv) > 1 else 'simulated'
config = sys.argv[2] if len(sys.argv) > 2 else 'panda'
with blf.Drive(config, robot=robot) as arm:
    start = arm.state.q
    due = time.monotonic()
    worst = 0.0
    for count in range(0, 120, CHUNK // 2):
        for action in policy(start, count)[: CHUNK // 2]:
            arm.stream(action)
            due = max(due + 1.0 / RATE, time.monotonic() - 1.0)
            time.sleep(max(due - time.monotonic(), 0.0))
            worst = max(worst, np.abs(arm.state.error).max())
    arm.stop()
    print(f'largest error against the reference: {1e3 * worst:.2f} mrad')

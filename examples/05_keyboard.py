# SPDX-License-Identifier: Apache-2.0
"""Teleoperation by keyboard: 1 to 9 choose a joint, + and - turn it, space stops, q ends.

python examples/05_keyboard.py [KEYS]    (with KEYS, these are pressed, and no terminal is needed)
"""

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Iterator

import numpy as np

import blf_dsc_controller as blf

RATE = 30.0  # Hz
SPEED = 0.3  # rad/s
HELD = 0.1  # s, for which one press turns the joint


def pressed() -> Iterator[str]:
    """Yield the keys of each interval."""
    before = termios.tcgetattr(sys.stdin)
    tty.setcbreak(sys.stdin)
    try:
        while True:
            time.sleep(1.0 / RATE)
            ready, _, _ = select.select([sys.stdin], [], [], 0.0)
            # not by sys.stdin, whose buffer would hide keys from select
            yield os.read(sys.stdin.fileno(), 1024).decode('latin-1') if ready else ''
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def typed(keys: str) -> Iterator[str]:
    """Yield given keys, one in each interval."""
    for key in keys:
        yield key
        time.sleep(1.0 / RATE)
    yield 'q'


if len(sys.argv) < 2 and not sys.stdin.isatty():
    sys.exit('keys come from a terminal, and this is none: give KEYS')
with blf.Drive('panda', robot='simulated') as arm:
    target, joint, left, sign = arm.state.q, 0, 0, 0.0
    for keys in typed(sys.argv[1]) if len(sys.argv) > 1 else pressed():
        for key in keys:
            if key == ' ':
                arm.stop()
                target, left = arm.state.reference.copy(), 0
            elif key in '123456789'[: len(arm.joints)]:
                joint = int(key) - 1
                print(f'\n{arm.joints[joint]}')
            elif key in '+-':
                sign, left = (1.0 if key == '+' else -1.0), round(HELD * RATE)
        if 'q' in keys:
            break
        if left:
            left -= 1
            target = target + sign * SPEED / RATE * np.eye(len(target))[joint]
            arm.stream(target)
        print(f'\r{arm.state.q[joint]:+.3f} rad', end='', flush=True)
    arm.stop()
    print('\nended at', ', '.join(f'{q:.3f}' for q in arm.state.q), 'rad')

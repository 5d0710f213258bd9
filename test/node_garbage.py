# SPDX-License-Identifier: Apache-2.0
"""Collecting nodes at the end of a test, without looking at all that was loaded before it.

A node's services keep its participant, visible to others, until it is collected. A
collection of everything takes up to 0.4 s, and hundreds of tests have nodes.
"""

import gc

_users = 0


def begin():
    """Call this before the first node: what is there by now is not looked at again.

    Not beside other nodes: theirs would stay for good. So would those that the last test still
    held at its `end`, as by a fixture that refers to them: they are collected here.
    """
    global _users  # noqa: PLW0603 - of the garbage collector, of which there is one
    if _users == 0:
        gc.collect()
        gc.freeze()
    _users += 1


def end():
    """Collect the nodes since `begin`."""
    global _users  # noqa: PLW0603
    _users -= 1
    gc.collect()

# SPDX-License-Identifier: Apache-2.0
"""Zeros of joints that are quarter turns from those of the URDF, as in a DH convention.

Which ones are likely is seen from gravity alone, with the masses of the URDF: a search
over the zeros of two joints at a time, since two that are off often hide each other.
A joint whose zero gravity does not show, such as the first of an upright arm, keeps it.
Gravity only proposes: see `identify`, which fits the arm to the best.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, islice, product

import numpy as np

from blf_dsc_controller.arms.base_parameters import base_parameters
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.mounting import gravity_columns
from blf_dsc_controller.identification.on_disk import mapped
from blf_dsc_controller.identification.recording import Recording
from blf_dsc_controller.identification.turns import TURN
from blf_dsc_controller.identification.windows import COLUMNS, rows_of, split
from blf_dsc_controller.run import Floats

_QUARTERS = (0, 1, 2, -1)  # turns over 4, of a zero
_FRICTION = ('viscous', 'Coulomb')
_POSTURES = 200  # at most, that are compared
_ROUNDS = 3  # over all pairs of joints
_CLEAR = 0.98  # times the cost, at most, for which a zero is moved
_BETTER = 0.9  # times the cost, at most, of zeros that are fitted: masses may be rough
_CANDIDATES = 2  # that are fitted


def shifted(recording: Recording, offsets: Floats) -> Recording:
    """Return the recording with offsets (n,) [rad] added to the positions."""
    q = recording.q
    moved = mapped(recording.gap.size, lambda rows: q[rows] + offsets)
    return recording._replace(q=moved)


def likely_zeros(recording: Recording, robot: Robot) -> list[Floats]:
    """Return offsets (n,) [rad] that may have to be added to the positions, the best first."""
    chain = robot.chain(recording.joints)
    rows = rows_of(recording, base_parameters(chain, robot.gravity).model)
    fit = split(rows).fit
    fit = fit[:: max(1, fit.size // _POSTURES)]
    q = rows.over_windows(lambda at: rows.q[at], rows.g)[fit]
    columns = rows.friction[fit][:, [COLUMNS.index(name) for name in _FRICTION]]
    gravity = _Gravity(chain, np.array(robot.gravity), q, rows.u(0.0)[fit], columns)
    turning = [i for i, joint in enumerate(chain.joints) if joint.kind != 'prismatic']
    _search(gravity, turning, q.shape[1])
    most = _BETTER * gravity.cost((0,) * q.shape[1])
    likely = (each for each in gravity.best() if gravity.cost(each) < most)
    return [0.25 * TURN * np.array(each) for each in islice(likely, _CANDIDATES)]


class _Gravity:
    """Torques (k, n) of postures q, and how well the URDF's gravity explains them."""

    def __init__(
        self, chain: Chain, g: Floats, q: Floats, u: Floats, friction: Floats
    ) -> None:
        """Take friction (k, c, n): c columns of each joint, which explain what they can."""
        self._chain = chain
        self._g = g
        self._q = q
        self._u = u
        # what friction does not explain of each joint, in units of its torque
        joints = range(q.shape[1])
        self._bases = [np.linalg.qr(friction[:, :, i])[0] for i in joints]
        self._scale = np.maximum(np.linalg.norm(u, axis=0), 1e-9)
        self._known: dict[tuple[int, ...], float] = {}

    def cost(self, quarters: tuple[int, ...]) -> float:
        """Return the squares that remain with other zeros."""
        if quarters not in self._known:
            q = self._q + 0.25 * TURN * np.array(quarters)
            left = (self._u - gravity_columns(self._chain, q) @ self._g) / self._scale
            explained = [Q.T @ own for Q, own in zip(self._bases, left.T, strict=True)]
            self._known[quarters] = float(
                np.sum(left**2) - sum(each @ each for each in explained)
            )
        return self._known[quarters]

    def simplest(self, quarters: tuple[int, ...]) -> tuple[int, ...]:
        """Return the zeros without moves that hardly matter."""
        for i, moved in enumerate(quarters):
            other = (*quarters[:i], 0, *quarters[i + 1 :])
            if moved and _CLEAR * self.cost(other) <= self.cost(quarters):
                quarters = other
        return quarters

    def best(self) -> Iterator[tuple[int, ...]]:
        """Yield those that were asked for, the best first, but each only in its simplest form."""
        found = set()
        for quarters in sorted(self._known, key=self._known.__getitem__):
            simplest = self.simplest(quarters)
            if simplest not in found:
                found.add(simplest)
                yield simplest


def _search(gravity: _Gravity, turning: Sequence[int], n: int) -> None:
    """Ask for the costs of likely zeros, in quarter turns, of n joints of which some turn."""
    best = (0,) * n
    for _ in range(_ROUNDS):
        before = best
        for pair in combinations(turning, 2):
            for chosen in product(_QUARTERS, repeat=2):
                other = list(best)
                for joint, quarter in zip(pair, chosen, strict=True):
                    other[joint] = quarter
                if gravity.cost(tuple(other)) < _CLEAR * gravity.cost(best):
                    best = tuple(other)
        if best == before:
            break

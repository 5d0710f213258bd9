# SPDX-License-Identifier: Apache-2.0
"""Directions and zeros of joints that are not those of the URDF, as in a DH convention.

Zeros are quarter turns away; a joint that counts the other way has its positions and its
efforts negated.  Which ones are likely is seen from gravity alone, with the masses of
the URDF: a search over the zeros of two joints at a time, since two that are off often
hide each other, and over the direction of each joint.  A joint of which gravity shows
nothing, such as the first of an upright arm, keeps both.  But one whose torque a fit
leaves unexplained, such as a last joint with little weight, may count the other way,
whatever gravity says.  All of this only proposes: see `identify`, which fits the arm to
the best.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, combinations, islice, permutations, product

import numpy as np

from blf_dsc_controller.identification.mounting import gravity_torques
from blf_dsc_controller.identification.problem import Problem
from blf_dsc_controller.identification.recording import TURN, Recording
from blf_dsc_controller.run import Floats

_QUARTERS = (0, 1, 2, -1)  # turns over 4, of a zero
_FRICTION = ('viscous', 'Coulomb')
_POSTURES = 200  # at most, that are compared
_ROUNDS = 3  # over all pairs of joints
_CLEAR = 0.98  # times the cost, at most, for which a joint counts in another way
_BETTER = 0.9  # times the cost, at most, of ways that are fitted: masses may be rough
_DIGITS = 6  # of a cost that are compared
_CANDIDATES = 2  # that are fitted, of all joints and of unexplained ones each

Way = tuple[int, int]
"""Sign and quarter turns: a joint of the URDF is at sign q + turns; (1, 0): as recorded."""

Convention = tuple[Way, ...]
"""How each joint counts."""

_AS_IS: Way = (1, 0)


def signs_and_offsets(convention: Convention) -> tuple[Floats, Floats]:
    """Return the signs of positions and efforts, and what is added to the former [rad] (n,)."""
    signs, quarters = np.array(convention, dtype=float).T
    return signs, 0.25 * TURN * quarters


def simpler(convention: Convention, i: int) -> Iterator[Convention]:
    """Yield others, in which joint i is as in the URDF, or has its zero, but not all joints."""
    for way in dict.fromkeys((_AS_IS, (convention[i][0], 0))):
        other = _with(convention, i, way)
        if other != convention and {*other} != {_AS_IS}:
            yield other


def converted(recording: Recording, convention: Convention) -> Recording:
    """Return the recording as if it had been counted as the URDF does."""
    signs, offsets = signs_and_offsets(convention)
    twist = recording.twist
    return recording._replace(
        q=signs * recording.q + offsets,
        torque=signs * recording.torque,
        twist=None if twist is None else signs * twist,
    )


def likely_conventions(
    problem: Problem, gravity: Sequence[float], unexplained: Sequence[int]
) -> list[Convention]:
    """Return ways in which the joints may count, the best first.

    `gravity` (3,) is in the base [m/s^2].  `unexplained` are joints, the worst first, that may
    count the other way round whatever gravity says.
    """
    ways = _Gravity(problem, gravity)
    ways.search()
    most = _BETTER * ways.cost(ways.as_is)
    likely = (each for each in ways.best() if ways.cost(each) < most)
    turned = (ways.turned(ways.as_is, i) for i in unexplained if i in ways.turning)
    both = chain(islice(likely, _CANDIDATES), islice(turned, _CANDIDATES))
    return list(dict.fromkeys(both))


def _with(ways: Convention, i: int, way: Way) -> Convention:
    return (*ways[:i], way, *ways[i + 1 :])


class _Gravity:
    """Torques (k, n) in postures of a motion, and how well the URDF's gravity explains them."""

    def __init__(self, problem: Problem, gravity: Sequence[float]) -> None:
        """Take the torques as they were recorded; friction explains what it can of them."""
        rows, fit = problem.rows, problem.windows.fit
        fit = fit[:: max(1, fit.size // _POSTURES)]
        kinds = [joint.kind for joint in problem.chain.joints]
        self.as_is: Convention = (_AS_IS,) * len(kinds)
        self.turning = [i for i, kind in enumerate(kinds) if kind != 'prismatic']
        self._torques = gravity_torques(problem.chain, np.array(gravity))
        self._q = rows.postures[fit]
        self._u = np.where(problem.reversed, -1.0, 1.0) * rows.u(0.0)[fit]
        # what friction does not explain of each joint, in units of its torque
        friction = np.moveaxis(rows.friction(fit, _FRICTION), 2, 0)
        self._bases = np.linalg.qr(friction)[0]  # (n, k, c)
        self._scale = np.maximum(np.linalg.norm(self._u, axis=0), 1e-9)
        self._known: dict[Convention, float] = {}

    def cost(self, ways: Convention) -> float:
        """Return the squares that remain if joints count in other ways."""
        if ways not in self._known:
            signs, offsets = signs_and_offsets(ways)
            weight = self._torques(signs * self._q + offsets)
            left = (self._u - signs * weight) / self._scale
            explained = np.einsum('ikc,ki->ic', self._bases, left)
            self._known[ways] = float(np.sum(left**2) - np.sum(explained**2))
        return self._known[ways]

    def turned(self, ways: Convention, i: int) -> Convention:
        """Return the best ways in which joint i counts in the other direction."""
        sign = -ways[i][0]
        return min((_with(ways, i, (sign, k)) for k in _QUARTERS), key=self.cost)

    def better(self, ways: Convention, other: Convention) -> Convention:
        """Return the other ways if they are clearly better."""
        return other if self.cost(other) < _CLEAR * self.cost(ways) else ways

    def simplest(self, ways: Convention) -> Convention:
        """Return the ways without what hardly matters: of each joint all, or its offset."""
        for i in range(len(ways)):
            for other in simpler(ways, i):
                if _CLEAR * self.cost(other) <= self.cost(ways):
                    ways = other
                    break
        return ways

    def search(self) -> None:
        """Ask for the costs of likely ways in which joints that turn may count.

        Two searches: a direction may look like zeros of others, and the other way round.
        """
        for first, then in permutations((self._with_zeros, self._with_directions)):
            ways = self.as_is
            for _ in range(_ROUNDS):
                before = ways
                ways = then(first(ways))
                if ways == before:
                    break

    def _with_zeros(self, ways: Convention) -> Convention:
        """Return these ways with better zeros, of two joints at a time."""
        for i, j in combinations(self.turning, 2):
            for one, other in product(_QUARTERS, repeat=2):
                both = _with(ways, i, (ways[i][0], one))
                ways = self.better(ways, _with(both, j, (ways[j][0], other)))
        return ways

    def _with_directions(self, ways: Convention) -> Convention:
        """Return these ways with better directions, first of the joint where it matters most."""
        for _ in self.turning:
            turned = (self.turned(ways, i) for i in self.turning)
            other = self.better(ways, min(turned, key=self.cost))
            if other == ways:
                break
            ways = other
        return ways

    def best(self) -> Iterator[Convention]:
        """Yield those that were asked for, the best first, but each only in its simplest form.

        Each sign and offset must explain something: there are others with the same gravity.
        """
        found = set()
        for ways in sorted(self._known, key=self._rank):
            simplest = self.simplest(ways)
            if simplest not in found:
                found.add(simplest)
                yield simplest

    def _rank(self, ways: Convention) -> tuple[float, int]:
        """Return what counts against these ways; of what is as good, directions are likelier."""
        offsets = sum(quarter != 0 for _, quarter in ways)
        moves = offsets + sum(sign < 0 for sign, _ in ways)
        return round(self.cost(ways) / _BETTER**moves, _DIGITS), offsets

# SPDX-License-Identifier: Apache-2.0
"""Identification of random simulated arms from positions and efforts alone, in one table.

    .venv/bin/python benchmark/random_arms.py --arms 100

Panda, UR5e and random chains of six joints, with links, centres of mass, rotors and friction drawn
at random, encoders of 20 bits and 1 % noise of torque, for half a minute at 1 kHz and at 100 Hz.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
sys.path.append(str(Path(__file__).parents[1] / 'test'))

import time

import numpy as np
from random_arm import CONFIG, random_urdf
from shaken_arm import PERIOD, Truth, measured, reference_of, shake, truth_of

from blf_dsc_controller.arms.inertia import pseudo_inertia
from blf_dsc_controller.arms.urdf import Chain
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.identification.identify import Identified, identify_arm
from blf_dsc_controller.identification.prior import columns_of
from blf_dsc_controller.identification.recording import Recording, rows_of
from blf_dsc_controller.run import Floats

_DURATION, _UNSEEN = 30.0, 10.0  # s
_EVERY = (1, 10)  # samples of 1 ms from state to state


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--arms', type=int, default=100)
    arms = parser.parse_args().arms
    results = np.array([_of_arm(seed) for seed in range(arms)])  # (arms, rates, columns)
    print(f'{arms} arms, {np.sum(results[:, :, 4] == 0.0)} results with unphysical bodies')
    print('| rate | torque error on unseen motion: URDF | identified | of 95 % intervals | time |')
    print('| --- | --- | --- | --- | --- |')
    for every, rate in zip(_EVERY, np.swapaxes(results, 0, 1), strict=True):
        inside, seconds = rate[:, 2], rate[:, 3]
        texts = [
            f'{np.median(e):.2f} % (95 of 100: {np.percentile(e, 95):.2f})' for e in rate.T[:2]
        ]
        print(
            f'| {1.0 / (every * PERIOD):.0f} Hz | {texts[0]} | {texts[1]} | '
            f'{100.0 * inside.mean():.1f} % hold the truth | {np.median(seconds):.2f} s |'
        )


def _robot(seed: int) -> Robot:
    if seed % 3 == 0:
        return Robot(urdf=(CONFIG / 'panda.urdf').read_text(), tip='panda_hand_tcp')
    if seed % 3 == 1:
        return Robot(urdf=(CONFIG / 'ur5e.urdf').read_text(), tip='tool0')
    return Robot(urdf=random_urdf(6, seed)[0], tip='tip', payload=1.0)


def _of_arm(seed: int) -> list[tuple[float, ...]]:
    """Return for each rate the errors [%] before and after, coverage, time and whether physical."""
    robot = _robot(seed)
    chain = robot.chain(())
    truth = truth_of(chain, seed)
    motion = measured(shake(chain, truth, reference_of(chain, 2 * seed), _DURATION), seed)
    unseen = shake(chain, truth, reference_of(chain, 2 * seed + 1), _UNSEEN)
    rows: list[tuple[float, ...]] = []
    for every in _EVERY:
        begin = time.perf_counter()
        found = identify_arm(_recording(chain, motion[::every], every), robot)
        seconds = time.perf_counter() - begin
        physical = min(np.linalg.eigvalsh(pseudo_inertia(body))[0] for body in found.inertias) > 0.0
        errors = _errors(found, _recording(chain, unseen, 1))
        rows.append((*errors, _coverage(found, truth), seconds, float(physical)))
    return rows


def _recording(chain: Chain, states: Floats, every: int) -> Recording:
    joints = tuple(joint.name for joint in chain.joints)
    gap = np.zeros(len(states), dtype=bool)
    return Recording(joints, every * PERIOD, states[:, 0], states[:, 2], gap, 'simulated')


def _errors(found: Identified, unseen: Recording) -> tuple[float, float]:
    rows = rows_of(unseen, found.parameters.model)
    G = columns_of(found.parameters, len(unseen.joints))
    u = rows.u(0.5 * PERIOD)  # torques are held for a period
    errors = []
    for values in (found.prior, found.values):
        rows.set_load((G @ values)[: found.parameters.model.p])
        left = rows.X @ (G @ values)[:-1] - u
        errors.append(100.0 * float(np.linalg.norm(left) / np.linalg.norm(u)))
    return errors[0], errors[1]


def _coverage(found: Identified, truth: Truth) -> float:
    """Return the share of the base parameters and friction within their 95 % intervals."""
    true = np.concatenate((truth.inertias.ravel(), truth.rotors, truth.viscous, truth.coulomb))
    at, n = slice(0, true.size), len(found.chain.joints)
    G = columns_of(found.parameters, n)[: found.parameters.model.p + 2 * n, at]
    deviation = np.sqrt(np.diag(G @ found.covariance[at, at] @ G.T))
    return float(np.mean(np.abs(G @ (found.values[at] - true)) < 1.96 * deviation))


if __name__ == '__main__':
    main()

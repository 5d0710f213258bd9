# SPDX-License-Identifier: Apache-2.0
"""The load that rows say, and its intervals, as numpy finds them."""

from __future__ import annotations

import numpy as np
from law_part import part

from blf_dsc_controller.law import innovation, payload

N, M, P = 2, 5, 3  # joints, entries of theta; base parameters, the others are friction
LOAD = payload.LOAD
SINCE = LOAD + N
K = M + 2 * N  # theta, breakaway torques, shares of the torque that are lost
UNSURE = np.repeat(
    (0.3, 0.1), N
)  # deviations of breakaway torques [N m], and of shares
random = np.random.default_rng(1)
SCALE = np.hstack((random.normal(size=(4, LOAD)), np.zeros((4, N))))
SCALE[:, 0] = 1.0, 0.1, 0.2, -0.1  # z = (1, 0, ..., 0) is 1 kg with its moments [kg m]
COLUMNS = np.zeros((K + 1, SINCE))  # [N D | E]
COLUMNS[:M, :LOAD] = random.normal(size=(M, 4)) @ SCALE[:, :LOAD]
COLUMNS[P:M, LOAD:] = 0.2 * np.eye(N)
PRIOR = innovation.Prior(random.normal(size=M), np.diag(random.uniform(0.5, 2.0, M)))
SETTINGS = payload.Settings(
    size=K + 1,
    inertial=P,
    since=SINCE,
    unknowns=K + SINCE,
    window=200,
    row_interval=1,
    pole=20.0,
    motion_scale=0.05,
    unmodelled=0.01,
    load_friction=UNSURE[-1] ** -2,
    breakaway=UNSURE[:N] ** -2,
    columns=COLUMNS,
    scale=SCALE,
)


def test_load_is_that_of_joint_least_squares_with_all_priors():
    """Of random rows before and since; intervals by the inverse of the normal equations."""
    state, work = (
        part(layout, n=N, payload=SETTINGS)
        for layout in (payload.State, payload.Workspace)
    )
    truth = random.normal(size=K + SINCE)
    rows, sums = [], {payload.BEFORE: 90, payload.NEWER: 40, payload.LATEST: 20}
    for which, count in sums.items():
        X = random.normal(size=(count * N, K))
        held = X[:, :M] @ COLUMNS[:M] * (which != payload.BEFORE)
        u = np.hstack((X, held)) @ truth + 0.04 * random.normal(size=count * N)
        rows.append(np.column_stack((X, held, u)))
        Xu = np.column_stack((X, u))
        state.sums[which] = np.triu(Xu.T @ Xu)
    period = innovation.CORRELATION / 7.0  # so that seven rows count as one
    a = 7.0 * 0.04**2
    grown = 5.0 / 20.0  # of the variance of changed friction
    state.complete[0], state.age[0], state.innovation.noise[0] = 1.0, 5.0, 0.04**2
    payload.solve(SETTINGS, state, work, PRIOR, period)
    payload.fill_estimate(SETTINGS, state, work, period)

    H = np.eye(K + SINCE)
    H[:M, :M] = PRIOR.information
    H[M:K, M:K] = np.diag(UNSURE**-2)
    H[K + LOAD :, K + LOAD :] /= grown
    *A, u = np.vstack(rows).T
    expected = np.append(PRIOR.estimate, np.zeros(2 * N + SINCE))
    g = np.array(A) @ u + a * H @ expected
    H = np.array(A) @ np.transpose(A) + a * H
    expected = np.linalg.solve(H, g)
    np.testing.assert_allclose(state.solution, expected, rtol=1e-6, atol=1e-9)
    mass, *moments = SCALE @ expected[K:]
    centre = np.array(moments) / mass
    C = a * SCALE @ np.linalg.inv(H)[K:, K:] @ SCALE.T
    J = np.column_stack((-centre, np.eye(3))) / mass
    deviation = np.sqrt(np.append(C[0, 0], np.diag(J @ C @ J.T)))
    np.testing.assert_allclose(state.load, [mass, *centre, *deviation], rtol=1e-5)

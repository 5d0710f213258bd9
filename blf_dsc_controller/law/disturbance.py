# SPDX-License-Identifier: Apache-2.0
"""The disturbance estimate d^3 of (30), which gives up what is learned.

    d^3' = -gamma (xi2 + eta d^3) - H (theta^' + Gamma H^T xi2)

(30) lacks the last term.  While the estimate is wrong, d^3 compensates for it; the
prediction error then corrects the estimate within milliseconds, but d^3 follows only
within seconds, and their sum is wrong in between.  With the term learning
does not change the torque H P^ + d^3, and d^3 is left to estimate the disturbance
alone.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array


class Settings(NamedTuple):
    """The parameters `disturbance.*`."""

    gain: Annotated[Array, 'n']  # gamma, N m/rad
    leakage: float  # eta, rad/(N m s)


class Workspace(NamedTuple):
    """Values of one sample."""

    step: Annotated[Array, 'n']  # by which d^3 falls, N m


@inner
def fill_step(
    settings: Settings, workspace: Workspace, estimate: Array, xi2: Array, dt: float
) -> None:
    """Compute dt gamma (xi2 + eta d^3) (n,) [N m] of (30), by which d^3 falls, as `workspace.step`.

    `estimate` is d^3 (n,) [N m], xi2 (n,) [rad/s].
    """
    for i in range(xi2.size):
        error = xi2[i] + settings.leakage * estimate[i]
        workspace.step[i] = dt * settings.gain[i] * error


@inner
def transfer_learned(estimate: Array, H: Array, theta: Array, before: Array) -> None:
    """Subtract H (theta - before) from d^3: the torque H theta + d^3 does not change by learning.

    `estimate` is d^3 (n,) [N m], modified in place; H is (n, m), `theta` and `before` are (m,).
    """
    for j in range(theta.size):
        for i in range(estimate.size):
            estimate[i] -= H[i, j] * (theta[j] - before[j])

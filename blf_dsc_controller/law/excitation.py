# SPDX-License-Identifier: Apache-2.0
"""Which windows are learned from: those that are excited (27), and of one and the same arm.

Disturbance columns that a window cannot distinguish from the parameters are rejected:
theta_j = 0.

A window that spans a change of the arm (a payload, a contact) contradicts itself
although it is excited; its least-squares solution is a mixture, and the Newton step
would solve it exactly.  The mean of u^T u, kept with Phi and b, gives the residual of
the solution,

    r^2 = mean(u^T u) - b^T theta_LS   [(N m)^2],

and a window is latched only if r^2 is at most four times the smallest of any full
window, or what unmodelled torque explains (configured, but no more than the smallest
residual suggests), and if its solution gives the arm a positive inertia, which the
residual does not imply.  The first full window has only its own parts as a measure:
fitted apart, neither may explain its rows better than by that factor, else the older
part is removed from the window; again only if the residual has halved since, since
parts of a period never agree about a lasting disturbance.

A window that is not full does not average out disturbances.  It is learned from all the
same after a change of the arm (see `change`) and, if configured, from the start, but its
solution is pulled to the estimate before, most strongly in weakly excited directions.
Likewise, a full window with an unusually large residual is pulled to an earlier solution,
kept once per window.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.arms.model import ArmModel
from blf_dsc_controller.compiled.jit import inner
from blf_dsc_controller.compiled.layout import Array, Cell
from blf_dsc_controller.law import sums, window
from blf_dsc_controller.law.innovation import Prior
from blf_dsc_controller.law.window import Window
from blf_dsc_controller.numerics.algebra import cholesky_factor, cholesky_solve

_WARM = 4  # inverse iterations from the previous direction
_COLD = 60  # from an arbitrary direction
_COMPARABLE = 0.95  # fraction of the best lambda_min
_LAMBDA_LOST = 0.1  # fraction of the best lambda_min lost per window
_GATE_RATIO = 4.0  # ratio of mean squares: twice the torque
# times the smallest residual: the floor, where that is below the configured one
_QUIET_RATIO = 4.0
_MIN_FLOOR = 0.01  # of the configured floor: a tenth of the torque
# of the residual since the last split; that of a lasting disturbance does not fall
_FALLEN_RATIO = 0.5
_USUAL_RATIO = 1.25  # times the smallest residual, which varies with the motion
_DOUBT_PULL = 3.0  # pull to the anchor per (N m)^2 above that, 1/(kg m^2)^2
_MIN_INERTIA = 0.1  # fraction of the initial estimate's


class Settings(NamedTuple):
    """The parameters `learning.*` of the latch, and what follows from others."""

    excitation_threshold: float  # sigma, on lambda_min(Phi)
    learning_start: float  # tau_d + T_a, s
    starts_full: int  # 1: no window is learned from before then
    change_detection: int  # 1: windows must be consistent
    # mean square residual that noise and unmodelled torque explain, (N m)^2
    residual_floor: float
    anchor_weight: float  # pull to `anchor` while the window is not full


class State(NamedTuple):
    """The latched window, and measures of earlier ones."""

    latched: Cell  # 1 while a window (Phi_e, b_e) is latched
    latch_time: Cell  # T_e, s
    lambda_min: Cell  # of Phi at the last check
    best_lambda: Cell  # largest of a full window since the last change, with decay
    columns_checked: Cell  # 1 once the disturbance columns are accepted or rejected
    residual: Cell  # mean square torque residual of the latched window, (N m)^2
    min_residual: Cell  # smallest residual of any full window, (N m)^2
    # of the last first window that its parts contradicted, (N m)^2
    split_residual: Cell
    Phi: Annotated[Array, 'm', 'm']  # latched Phi_e
    b: Annotated[Array, 'm']  # latched b_e
    factor: Annotated[Array, 'm', 'm']  # Cholesky factor of Phi_e + rho R
    solution: Annotated[Array, 'm']  # of the latched window, (Phi_e + rho R)^-1 b_e
    # theta^ to which windows with little information are pulled
    anchor: Annotated[Array, 'm']
    active: Annotated[Array, 'm']  # 0 where a disturbance column has been rejected


class Workspace(NamedTuple):
    """Scratch of the check for a positive inertia."""

    # M^(q) minus its least admissible value, or its factor
    inertia: Annotated[Array, 'n', 'n']
    unit: Annotated[Array, 'n']
    Yp: Annotated[Array, 'n', 'p']
    Yr: Annotated[Array, 'n', 'm']


@inner
def explained(settings: Settings, min_residual: float, residual: float) -> float:
    """Return the mean square residual [(N m)^2] that noise and unmodelled torque explain.

    It is at least the `residual` of the window.  The configured floor is an upper limit: the
    smallest residual of any full window, `min_residual` (0 before the first), lowers it.
    """
    floor = settings.residual_floor
    if min_residual > 0.0:
        observed_floor = max(_QUIET_RATIO * min_residual, _MIN_FLOOR * floor)
        floor = min(floor, observed_floor)
    return max(residual, floor)


@inner
def window_residual(running: Array, theta: Array) -> float:
    """Return the sum of |u - X theta|^2 over the window [(N m)^2], >= 0.

    `running` (m + 1, m + 1) is its sum of [X | u]^T [X | u], `theta` is (m,).
    """
    m = theta.size
    total = running[m, m]
    for i in range(m):
        product = -2.0 * running[i, m] + running[i, i] * theta[i]
        for j in range(i + 1, m):
            product += 2.0 * running[i, j] * theta[j]
        total += theta[i] * product
    return max(float(total), 0.0)


@inner
def find_spare_inertia(
    model: ArmModel, workspace: Workspace, q: Array, theta: Array, P0: Array
) -> None:
    """Write M(q; theta - 0.1 P^(0)) (n, n) to `workspace.inertia`, upper triangle.

    theta (m,) is physical there if that is positive definite.  q (n,) [rad], P0 (p,).
    """
    n = q.size
    for k in range(n):
        for i in range(n):
            workspace.unit[i] = 1.0 if i == k else 0.0
        model.momentum_regressor(q, workspace.unit, workspace.Yp, workspace.Yr)
        for i in range(k, n):
            workspace.inertia[k, i] = 0.0
            for j in range(workspace.Yp.shape[1]):
                parameter = theta[j] - _MIN_INERTIA * P0[j]
                workspace.inertia[k, i] += workspace.Yp[i, j] * parameter


@inner
def is_in_question(
    settings: Settings, state: State, sliding: Window, residual: float
) -> bool:
    """Whether a full window must be compared with its parts: no other has been accepted yet.

    Its mean square `residual` [(N m)^2] is above the gate, and has halved since the last split.
    """
    is_full = window.is_full(sliding.settings, sliding.state)
    if not is_full or state.min_residual[0] > 0.0 or sliding.settings.length == 1:
        return False
    split = state.split_residual[0]
    is_new = split == 0.0 or residual < _FALLEN_RATIO * split
    return bool(is_new and residual > _GATE_RATIO * settings.residual_floor)


@inner
def part_residual(
    sliding: Window, prior: Prior, active: Array, part: Array, rows: int
) -> float:
    """Return the mean square residual [(N m)^2] of some `rows` of the window, fitted apart.

    `part` (m + 1, m + 1) is the sum of their [X | u]^T [X | u].  Their equations and solution
    are left in the workspace of the window.
    """
    workspace = sliding.workspace
    window.fill_equations(sliding.settings, workspace, prior, part, rows)
    window.solve(sliding.settings, workspace, prior.information, active)
    return window_residual(part, workspace.solution) / rows


@inner
def best_part_residual(
    sliding: Window, prior: Prior, active: Array, newer_rows: int
) -> float:
    """Return the smaller mean square residual of the two parts of a full window, each fitted apart.

    `sliding.workspace.newer` is the sum of its `newer_rows` newer rows.  Phi, b, the factor and
    the solution of the whole window are in its workspace again afterwards.
    """
    whole, newer, older = (
        sliding.state.running,
        sliding.workspace.newer,
        sliding.workspace.part,
    )
    length = sliding.settings.length
    sums.add(whole, -1.0, newer, older)
    older_residual = part_residual(sliding, prior, active, older, length - newer_rows)
    newer_residual = part_residual(sliding, prior, active, newer, newer_rows)
    part_residual(sliding, prior, active, whole, length)  # for its scratch alone
    return min(older_residual, newer_residual)


@inner
def split_window(
    settings: Settings,
    state: State,
    sliding: Window,
    prior: Prior,
    residual: float,
) -> bool:
    """Remove the older part of a full window if the parts contradict each other; return whether.

    They do if one of them, fitted apart, explains its rows better than the window with its mean
    square `residual` by more than the gate.
    """
    newer = sliding.workspace.newer
    rows = window.newer_part(sliding.state, newer)
    best = best_part_residual(sliding, prior, state.active, rows)
    if residual <= _GATE_RATIO * explained(settings, state.min_residual[0], best):
        return False
    state.split_residual[0] = residual
    window.keep_newer(sliding.state, newer, rows)
    return True


@inner
def accept_window(
    settings: Settings,
    state: State,
    workspace: Workspace,
    sliding: Window,
    prior: Prior,
    model: ArmModel,
    q: Array,
) -> bool:
    """Keep the solution of the window if it is consistent and physical; return whether.

    A window that is not full, or has an unusually large residual, is pulled to the anchor:
    Phi + a R, b + a R theta_anchor, in the workspace of the window.

    Args:
        sliding: the window, whose workspace has Phi, b and their factor.
        prior: P^(0) and R.
        q: position (n,) [rad] at which the inertia must be positive definite.
    """
    equations = sliding.workspace
    for j in range(equations.b.size):
        equations.solution[j] = equations.b[j]
    cholesky_solve(equations.factor, equations.solution)
    rows = sliding.state.rows[0]
    residual = window_residual(sliding.state.running, equations.solution) / rows
    missing = 1.0 - rows / sliding.settings.length
    if is_in_question(settings, state, sliding, residual) and split_window(
        settings, state, sliding, prior, residual
    ):
        return False
    min_residual = state.min_residual[0]
    if missing <= 0.0 and (min_residual == 0.0 or residual < min_residual):
        min_residual = state.min_residual[0] = residual
    if residual > _GATE_RATIO * explained(settings, min_residual, min_residual):
        return False
    pull = settings.anchor_weight * missing
    pull += _DOUBT_PULL * max(0.0, residual - _USUAL_RATIO * min_residual)
    if pull > 0.0:
        window.pull_to(
            state.anchor, pull, prior.information, equations.Phi, equations.b
        )
        window.solve(sliding.settings, equations, prior.information, state.active)
    find_spare_inertia(model, workspace, q, equations.solution, prior.estimate)
    if not cholesky_factor(workspace.inertia):
        return False
    keep_solution(state, sliding, residual)
    return True


@inner
def keep_solution(state: State, sliding: Window, residual: float) -> None:
    """Keep the solution of the window, and that of a full one as the anchor, once per window.

    `residual` is its mean square [(N m)^2].
    """
    solution = sliding.workspace.solution
    is_first = state.latched[0] == 0.0
    is_new = is_first or window.is_at_start(sliding.settings, sliding.state)
    becomes_anchor = is_new and window.is_full(sliding.settings, sliding.state)
    state.residual[0] = residual
    for j in range(solution.size):
        state.solution[j] = solution[j]
        if becomes_anchor:
            state.anchor[j] = solution[j]


@inner
def reject_columns(
    settings: Settings, state: State, sliding: Window, prior: Prior, first: int
) -> None:
    """Reject the disturbance columns that this window cannot distinguish from the parameters.

    The columns are those from the `first` on.  The window must excite the parameters
    without any column; then the column with the largest entry in the minimum
    eigenvector is rejected, repeatedly, until the rest is excited.  This happens at the
    first settled window that is excited enough, and once per window while a column is
    rejected.
    """
    active = state.active
    m = active.size
    direction = sliding.state.min_eigenvector
    for j in range(first, m):
        active[j] = 0.0
    window.reset_direction(sliding.state)
    parameters_excited = (
        window.find_excitation(sliding, prior, active, _COLD)
        >= settings.excitation_threshold
    )
    for j in range(first, m):
        active[j] = 1.0
    if not parameters_excited:
        state.columns_checked[0] = 0.0  # readmit all, until a window is excited
        window.reset_direction(sliding.state)
        return
    state.columns_checked[0] = 1.0
    for _ in range(first, m):
        window.reset_direction(sliding.state)
        value = window.find_excitation(sliding, prior, active, _COLD)
        if value >= settings.excitation_threshold:
            return
        active[strongest(direction, active, first)] = 0.0


@inner
def strongest(direction: Array, active: Array, first: int) -> int:
    """Return the active column, from the `first` on, with the largest entry of `direction` (m,)."""
    worst = first
    for j in range(first, direction.size):
        strength = abs(direction[j]) * active[j]
        if strength > abs(direction[worst]) * active[worst]:
            worst = j
    return worst


@inner
def readmit_columns(
    settings: Settings, state: State, sliding: Window, prior: Prior, first: int
) -> None:
    """Check rejected columns again, once per window: a later one may distinguish them.

    Columns from the `first` on are those of disturbances.
    """
    rejected = 0.0
    for j in range(first, state.active.size):
        rejected += 1.0 - state.active[j]
    is_start = window.is_at_start(sliding.settings, sliding.state)
    if rejected == 0.0 or not is_start:
        return
    reject_columns(settings, state, sliding, prior, first)


@inner
def has_settled(settings: Settings, sliding: Window, t: float, dt: float) -> bool:
    """Whether the window may be learned from at time t [s]; `dt` [s] is the sample time.

    It is full, or spans T_a: after a change of the arm, and from the start if configured.
    """
    if settings.starts_full == 1 and t < settings.learning_start:
        return False
    window_settings = sliding.settings
    period = window_settings.row_interval * dt
    settling_time = settings.learning_start - window_settings.length * period
    rows = sliding.state.rows[0]
    return bool(rows == window_settings.length or rows * period >= settling_time)


@inner
def update_excitation(
    settings: Settings,
    state: State,
    workspace: Workspace,
    sliding: Window,
    prior: Prior,
    model: ArmModel,
    q: Array,
    t: float,
    dt: float,
) -> None:
    """Compute lambda_min of the window; once it has settled, latch it if it suffices, by (27).

    Args:
        prior: P^(0) and R, in whose metric the eigenvalue is.
        model: the arm, whose inertia the solution must keep positive.
        q: position (n,) [rad] at time t [s].
        dt: sample time [s].
    """
    if sliding.state.rows[0] == 0.0:
        return
    first = workspace.Yp.shape[1]
    learning = has_settled(settings, sliding, t, dt)
    if learning and state.columns_checked[0] == 0.0:
        reject_columns(settings, state, sliding, prior, first)
    elif learning:
        readmit_columns(settings, state, sliding, prior, first)
    value = window.find_excitation(sliding, prior, state.active, _WARM)
    state.lambda_min[0] = value
    window_settings = sliding.settings
    state.best_lambda[0] *= 1.0 - _LAMBDA_LOST * window_settings.interval / (
        window_settings.length * window_settings.row_interval
    )
    # (27) would end with the weakest window above the threshold when the reference stops.  A weaker
    # one has less information, unless the latched one is old (its lambda decays) or contradicted.
    required = settings.excitation_threshold
    if settings.change_detection == 1:
        required = max(required, _COMPARABLE * state.best_lambda[0])
    if not (learning and value >= required):
        return
    if settings.change_detection == 1 and not accept_window(
        settings, state, workspace, sliding, prior, model, q
    ):
        return
    latch(state, sliding, value, t)


@inner
def latch(state: State, sliding: Window, value: float, t: float) -> None:
    """Latch the window as Phi_e, b_e of (26), with its lambda_min `value`, at time t [s]."""
    equations = sliding.workspace
    for i in range(equations.b.size):
        state.b[i] = equations.b[i]
        for j in range(equations.b.size):
            state.Phi[i, j] = equations.Phi[i, j]
            state.factor[i, j] = equations.factor[i, j]
    state.latched[0] = 1.0
    if window.is_full(sliding.settings, sliding.state):
        state.best_lambda[0] = max(value, state.best_lambda[0])
    state.latch_time[0] = t


@inner
def unlatch(state: State, estimate: Array) -> None:
    """Forget the latched window; the `estimate` (m,) becomes the anchor."""
    state.latched[0] = 0.0
    state.best_lambda[0] = 0.0
    for j in range(estimate.size):
        state.anchor[j] = estimate[j]

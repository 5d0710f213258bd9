# SPDX-License-Identifier: Apache-2.0
"""Arms identified by others, `figaroh` and `mujoco.sysid`, from the same part of a recording.

figaroh        its `physical_fit`: physical bodies, no bounds of friction, hardly any prior; from
               the columns, rows and weights of `identify`.
mujoco.sysid   what MuJoCo has: physical bodies, rotors, viscous and Coulomb friction, offsets; by
               the errors of `mj_inverse` in the windows of `identify`, with its weights.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np

from benchmark.rollouts import THICKENED, spec_of
from blf_dsc_controller.arms.inertia import inertia_of
from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.prior import Prior
from blf_dsc_controller.identification.regression import Regression
from blf_dsc_controller.identification.values import (
    COULOMB,
    JOINT_TERMS,
    OFFSET,
    ROTOR_INERTIA,
    VISCOUS,
    indices,
    parts,
)
from blf_dsc_controller.identification.windows import Indices, Rows
from blf_dsc_controller.run import Floats

MISSING: list[str] = []
"""Which of them are not installed."""

try:
    physical_fit = importlib.import_module('figaroh.identification.physical_fit')
except ImportError:
    MISSING.append('figaroh')
try:
    from mujoco import sysid

    sysid.optimize  # noqa: B018 - there only with its own requirements
except (ImportError, AttributeError):
    MISSING.append('mujoco.sysid')

_ITERATIONS = 30
# of a body, as figaroh names them, in the order of our ten
_TEN = ('m', 'mx', 'my', 'mz', 'Ixx', 'Ixy', 'Iyy', 'Ixz', 'Iyz', 'Izz')
# of a joint's largest torque, ten times the start of the search
_SHARES = {'armature': 0.01, 'damping': 0.1, 'frictionloss': 0.1}
_MOST = 100.0  # times the start: bound
_PERIOD = 0.01  # s
_MASS = np.array((0.05, 20.0))  # times that of the URDF: bounds
_STRETCH = np.array((0.01, 100.0))  # times that of the URDF, of squares
_SHEAR = np.array((-5.0, 5.0))
_STEP = 1e-6  # of differences
_RANK = 1e-10  # of the largest eigenvalue of the information


class Fit(NamedTuple):
    """Values, and their covariance as their author computes it."""

    values: Floats  # (17 n + 14,)
    covariance: Floats  # (17 n + 14, 17 n + 14)
    at_once: bool = False  # whether its Coulomb friction changes its sign at once


def figaroh(found: Identified, problem: Regression, prior: Prior) -> Fit | None:
    """Return the fit to the rows of a problem; None if figaroh says that it failed."""
    at = indices(prior.joints)
    names = found.joints
    own = np.concatenate(
        (at.bodies.ravel(), at.terms.ravel(), at.coupling, at.delay)
    ).astype(int)
    to_z = np.linalg.inv(prior.D[np.ix_(own, own)])
    Y = problem.A[:, own] @ to_z
    mean = prior.mean[own]
    given = physical_fit.build_problem(
        Y,
        problem.b + Y @ mean,
        [
            *(f'{key}_{name}' for name in names for key in _TEN),
            *(f'{term}_{name}' for term in JOINT_TERMS for name in names),
            *(f'other_{k}' for k in range(at.coupling.size + 1)),
        ],
        names,
        prior=mean,
    )
    record = physical_fit.solve_direct_effort_fit(given)
    if record.theta is None:
        print(f'figaroh failed: {record.solver_status}', file=sys.stderr)
        return None
    values = prior.mean.copy()
    values[own] = record.theta
    covariance = np.zeros((values.size, values.size))
    scale = prior.D[np.ix_(own, own)]
    information = problem.A[:, own].T @ problem.A[:, own]
    covariance[np.ix_(own, own)] = scale @ _inverse(information) @ scale.T
    return Fit(values, covariance)


def mujoco_sysid(
    found: Identified,
    rows: Rows,
    fit: Indices,
    problem: Regression,
    prior: Prior,
    gravity: Sequence[float],
) -> Fit:
    """Return the fit to the torques of some windows.

    It starts from the prior, with physical bodies and hardly any friction.
    """
    first = np.zeros_like(prior.mean)
    parts(first).bodies[:] = parts(prior.mean + prior.D @ prior.start).bodies
    friction = np.zeros((2, rows.speed.size))
    spec = spec_of(found, first, friction, gravity, _PERIOD)
    parameters = _parameters(found, rows, spec)
    residual = _residual(rows, fit, spec, problem)
    with contextlib.redirect_stdout(io.StringIO()):
        best, result = sysid.optimize(
            parameters,
            residual,
            'scipy_parallel_fd',
            verbose=False,
            max_iters=_ITERATIONS,
            x_scale='jac',
        )
    x = best.as_vector()
    values = _values_at(x, parameters, spec, first)
    left = residual(x, parameters)[0][0]
    variance = float(left @ left) / (left.size - x.size)
    covariance = variance * _inverse(result.jac.T @ result.jac)
    others = [
        _values_at(x + own, parameters, spec, first) for own in _STEP * np.eye(x.size)
    ]
    to_values = (np.column_stack(others) - values[:, None]) / _STEP
    return Fit(values, to_values @ covariance @ to_values.T, at_once=True)


def _parameters(found: Identified, rows: Rows, spec: Any) -> Any:
    """Return the parameters of all bodies and joints."""
    model = spec.compile()
    parameters = sysid.ParameterDict()
    for i, joint in enumerate(found.chain.joints):
        parameters.add(_of_body(spec, model, joint.link))
        for parameter in _of_joint(joint.name, float(rows.largest_torque[i])):
            parameters.add(parameter)
    return parameters


def _residual(
    rows: Rows, fit: Indices, spec: Any, problem: Regression
) -> Callable[[Floats, Any], tuple[list[Floats], list[Any], list[Any]]]:
    """Return the errors of the torques as `sysid` wants them, of one vector or several columns."""
    predict = _Torques(rows, fit, spec)
    weight = rows.weight[fit] / problem.deviation
    measured = rows.u(problem.delay)[fit]

    def residual(x: Floats, own: Any) -> tuple[list[Floats], list[Any], list[Any]]:
        columns = x if x.ndim > 1 else x[:, None]
        errors = np.empty((measured.size, columns.shape[1]))
        for k, column in enumerate(columns.T):
            own.update_from_vector(column)
            errors[:, k] = ((predict(own) - measured) * weight).ravel()
        return [errors if x.ndim > 1 else errors[:, 0]], [], []

    return residual


class _Torques:
    """Torques of `mj_inverse` in some windows, at 100 Hz."""

    def __init__(self, rows: Rows, fit: Indices, spec: Any) -> None:
        every = max(1, round(_PERIOD / rows.period))
        g = rows.g[::every]
        self._g = g / g.sum()
        self._starts = rows.starts[fit] // every
        self._used = np.unique(self._starts[:, None] + np.arange(g.size))
        dq = np.asarray(rows.dq)
        ddq = np.gradient(dq, rows.period, axis=0)
        self._motion = [each[::every] for each in (np.asarray(rows.q), dq, ddq)]
        self._spec = spec

    def __call__(self, parameters: Any) -> Floats:
        """Return the torques (R, n) of a model."""
        model = sysid.apply_param_modifiers(parameters, self._spec)
        data = mujoco.MjData(model)
        torque = np.zeros_like(self._motion[0])
        for k in self._used:
            data.qpos[:], data.qvel[:], data.qacc[:] = (m[k] for m in self._motion)
            mujoco.mj_inverse(model, data)
            torque[k] = data.qfrc_inverse
        at = self._starts[:, None] + np.arange(self._g.size)
        mean = np.einsum('rln,l->rn', torque[at], self._g)
        return np.asarray(mean - model.actuator_biasprm[:, 0])


def _of_body(spec: Any, model: Any, link: str) -> Any:
    """Return the pseudo-inertia of a body as a parameter."""

    def write(changed: Any, parameter: Any) -> None:
        ten = sysid.model_modifier.pi_from_theta(parameter.value)
        mass = ten[0]
        c = ten[1:4] / mass
        I = ten[4:].reshape(3, 3) - mass * (c @ c * np.eye(3) - np.outer(c, c))
        I += THICKENED * np.trace(I) * np.eye(3)
        body = changed.body(link)
        body.mass = mass
        body.ipos = c
        body.fullinertia[:] = I[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

    return sysid.body_inertia_param(
        spec.copy(),
        model,
        link,
        inertia_type=sysid.InertiaType.Pseudo,
        mass_bound_mult=_MASS,
        stretch_bound_mult=_STRETCH,
        shear_bound_off=_SHEAR,
        modifier=write,
    )


def _of_joint(name: str, largest: float) -> Iterator[Any]:
    """Yield the rotor, the friction and the offset of a joint with this largest torque."""
    for attribute, share in _SHARES.items():

        def write(spec: Any, parameter: Any, attribute: str = attribute) -> None:
            value = float(parameter.value[0])
            joint = spec.joint(name)
            setattr(
                joint, attribute, [value, 0, 0] if attribute == 'damping' else value
            )

        start = 0.1 * share * largest
        yield sysid.Parameter(
            f'{name} {attribute}', start, 0.0, _MOST * start, modifier=write
        )

    def shift(spec: Any, parameter: Any) -> None:
        spec.actuator(name).biasprm[0] = -float(parameter.value[0])

    yield sysid.Parameter(f'{name} offset', 0.0, -largest, largest, modifier=shift)


def _values_at(x: Floats, parameters: Any, spec: Any, first: Floats) -> Floats:
    """Return all values (17 n + 14,) of the parameters x."""
    parameters.update_from_vector(x)
    model = sysid.apply_param_modifiers(parameters, spec.copy())
    values: Floats = first.copy()
    own = parts(values)
    own.bodies[:] = [_inertia(model, body) for body in range(1, model.nbody)]
    own.terms[ROTOR_INERTIA] = model.dof_armature
    own.terms[VISCOUS] = np.reshape(model.dof_damping, (model.nv, -1))[:, 0]
    own.terms[COULOMB] = model.dof_frictionloss
    own.terms[OFFSET] = -model.actuator_biasprm[:, 0]
    return values


def _inertia(model: Any, body: int) -> Floats:
    """Return the ten of a body of MuJoCo, in its own frame."""
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, model.body_iquat[body])
    axes = R.reshape(3, 3)
    moments = model.body_inertia[body]
    mass = float(model.body_mass[body])
    c = model.body_ipos[body]
    spread = axes @ np.diag(0.5 * moments.sum() - moments) @ axes.T
    J = np.zeros((4, 4))
    J[:3, :3] = spread + mass * np.outer(c, c)
    J[:3, 3] = J[3, :3] = mass * c
    J[3, 3] = mass
    return np.asarray(inertia_of(J), dtype=np.float64)


def _inverse(information: Floats) -> Floats:
    """Return the inverse within what the data show."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information * np.outer(scale, scale)
    inverse = np.linalg.pinv(scaled, rcond=_RANK, hermitian=True)
    return np.asarray(inverse * np.outer(scale, scale), dtype=np.float64)

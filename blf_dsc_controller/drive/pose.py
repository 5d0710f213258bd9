# SPDX-License-Identifier: Apache-2.0
"""Poses of the tip, and the way of the joints along a straight line to one, by the library pink.

Pink solves inverse kinematics as quadratic programs within the joint limits (Caron et
al., pin-pink).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blf_dsc_controller.arms.urdf import Chain, frames
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.control.slow_move import duration_of
from blf_dsc_controller.errors import DriveError, MotionFailedError
from blf_dsc_controller.extras import import_extra

Floats = NDArray[np.float64]

_POINTS = 20  # on the line
_STEP = 0.05  # s, of a step of the solver
_STEPS = 400  # until a pose counts as out of reach
_NEAR = 1e-4  # m and rad
_ORTHONORMAL = 1e-6
_SHORTEST = 0.2  # s, of a line


class Pose(NamedTuple):
    """Where the tip is, in the base frame."""

    position: Floats  #: (3,) m
    rotation: Floats  #: (3, 3), its columns are the axes of the tip


class Poses:
    """Kinematics of a configured arm."""

    def __init__(self, config: ControllerConfig) -> None:
        """Read the chain.

        Raises:
            DriveError: the arm is not one of a URDF.
        """
        if not config.robot.urdf:
            raise DriveError(
                'poses: the two links of the paper have none: give robot.urdf'
            )
        self._config = config
        self._chain = config.robot.chain(config.joints)

    def at(self, q: Floats) -> Pose:
        """Return the pose of the tip at positions (n,) [rad]."""
        placement = frames(self._chain, q)[-1]
        return Pose(placement[:3, 3].copy(), placement[:3, :3].copy())

    def line(
        self,
        begin: Floats,
        position: ArrayLike,
        rotation: ArrayLike | None,
        speed: float,
    ) -> list[tuple[float, Floats]]:
        """Return times [s] and positions (n,) [rad] on the way from `begin` (n,) to a pose.

        `speed` is a share of the limits of the joints.

        Raises:
            DriveError: it is no pose.
            MotionFailedError: a point of the line is out of reach.
            MissingExtraError: pink is not installed.
        """
        start = self.at(begin)
        wanted = _checked(position, start.rotation if rotation is None else rotation)
        pin = import_extra('pinocchio', 'pose', 'move_to_pose')
        solver = _Solver(self._chain, self._config, begin)
        turn = pin.log3(start.rotation.T @ wanted.rotation)
        s = np.arange(1, _POINTS + 1) / _POINTS
        shares = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)  # minimum jerk
        way = [begin]
        for share in shares:
            there = start.position + share * (wanted.position - start.position)
            rotated = start.rotation @ pin.exp3(share * turn)
            way.append(solver.reach(Pose(there, rotated)))
        limits = self._config.limits
        far = np.abs(np.diff(way, axis=0)).sum(axis=0)
        fastest, acceleration = speed * np.array((limits.velocity, limits.acceleration))
        duration = max(_SHORTEST, duration_of(far, fastest, acceleration))
        return [*zip((duration * s).tolist(), way[1:], strict=True)]


class _Solver:
    """Pink on a chain, from pose to pose."""

    def __init__(self, chain: Chain, config: ControllerConfig, q: Floats) -> None:
        self._pink = import_extra('pink', 'pose', 'move_to_pose')
        self._pin = import_extra('pinocchio', 'pose', 'move_to_pose')
        model = _model(self._pin, chain, config)
        lower, upper = model.lowerPositionLimit, model.upperPositionLimit
        q = np.clip(q, lower, upper)
        self._configuration = self._pink.Configuration(model, model.createData(), q)
        self._limits = [self._pink.limits.ConfigurationLimit(model)]

    def reach(self, pose: Pose) -> Floats:
        """Return positions (n,) [rad] with the tip at a pose, near those before."""
        task = self._pink.FrameTask('tip', position_cost=1.0, orientation_cost=1.0)
        task.set_target(self._pin.SE3(pose.rotation, pose.position))
        configuration = self._configuration
        for _ in range(_STEPS):
            if np.abs(task.compute_error(configuration)).max() < _NEAR:
                return np.array(configuration.q)
            velocity = self._pink.solve_ik(
                configuration,
                [task],
                _STEP,
                solver='daqp',
                damping=1e-9,
                limits=self._limits,
            )
            configuration.integrate_inplace(velocity, _STEP)
        left = np.abs(task.compute_error(configuration))
        raise MotionFailedError(
            f'the tip cannot be at {np.round(pose.position, 3).tolist()} m on a straight line '
            f'within the limits of the joints: {1e3 * left[:3].max():.1f} mm and '
            f'{left[3:].max():.2g} rad are left'
        )


def _model(pin: Any, chain: Chain, config: ControllerConfig) -> Any:
    """Return a chain as a model of pinocchio, without masses."""
    model = pin.Model()
    kinds = {'prismatic': pin.JointModelPrismaticUnaligned}
    parent = 0
    for joint in chain.joints:
        kind = kinds.get(joint.kind, pin.JointModelRevoluteUnaligned)
        placement = pin.SE3(joint.placement)
        parent = model.addJoint(parent, kind(*joint.axis), placement, joint.name)
    tip = pin.SE3(chain.tip_placement)
    model.addFrame(pin.Frame('tip', parent, 0, tip, pin.FrameType.OP_FRAME))
    model.lowerPositionLimit = np.array(config.limits.position_lower)
    model.upperPositionLimit = np.array(config.limits.position_upper)
    return model


def _checked(position: ArrayLike, rotation: ArrayLike) -> Pose:
    at = _array('position', position, 'three finite values in m are needed')
    if at.shape != (3,) or not np.isfinite(at).all():
        raise DriveError(
            f'position: got {at.tolist()}, but three finite values in m are needed'
        )
    turned = _array('rotation', rotation, 'an orthonormal matrix (3, 3) is needed')
    if (
        turned.shape != (3, 3)
        or not np.abs(turned.T @ turned - np.eye(3)).max() < _ORTHONORMAL
        or np.linalg.det(turned) < 0.0
    ):
        raise DriveError(
            f'rotation: got {turned.tolist()}, but an orthonormal matrix (3, 3) of determinant 1 '
            'is needed'
        )
    return Pose(at, turned)


def _array(name: str, given: ArrayLike, need: str) -> Floats:
    try:
        return np.asarray(given, float)
    except (TypeError, ValueError):
        raise DriveError(
            f'{name}: got {type(given).__name__}, but {need}, such as pose.{name}'
        ) from None

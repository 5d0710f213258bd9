# SPDX-License-Identifier: Apache-2.0
"""Motions of identified arms in MuJoCo, by the measured torques, from measured states.

A recording is cut into rollouts of 0.2 s.  Models are the MJCF of `identify`, with their
offsets of torque; friction that MuJoCo lacks becomes the nearest that it has.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.mjcf import mjcf
from blf_dsc_controller.identification.recording import Recording, interpolated
from blf_dsc_controller.identification.scoring import nearest_friction
from blf_dsc_controller.identification.values import OFFSET, parts
from blf_dsc_controller.identification.windows import Indices, Rows, Split
from blf_dsc_controller.run import Floats

LENGTH = 0.2
"""Length of a rollout [s]."""

_STEP = 0.002  # s, longest
_FAR = 100.0  # rad or m
_MOMENTS = (4, 6, 9)  # Ixx, Iyy, Izz among the ten of a body
THICKENED = 1e-6
"""Part of the sum of its moments of inertia, by which a flat body is made thicker."""


class Rollouts(NamedTuple):
    """K rollouts of S steps of n joints."""

    step: float  # s
    q: Floats  # (K, S + 1, n) rad or m
    dq: Floats  # (K, S + 1, n) rad/s or m/s
    torque: Floats  # (K, S, n) N m or N, in the middle of each step

    @property
    def moved(self) -> Floats:
        """Root mean square way of each joint (n,) from the start of its rollout."""
        return np.asarray(np.sqrt(np.mean((self.q - self.q[:, :1]) ** 2, axis=(0, 1))))


def rollouts_of(
    recording: Recording, rows: Rows, windows: Indices, delay: float
) -> Rollouts:
    """Return the rollouts within some windows, whose torques were recorded `delay` [s] late."""
    period = recording.period
    step = period / np.ceil(period / _STEP)
    steps = round(LENGTH / step)
    time = period * np.arange(recording.gap.size)
    q = np.asarray(rows.q)
    dq = np.asarray(rows.dq)
    torque = np.asarray(rows.torque[:])
    begins = np.arange(
        rows.time[windows[0]], rows.time[windows[-1]] - LENGTH - delay, LENGTH
    )
    found = []
    for begin in begins:
        at = begin + step * np.arange(steps + 1)
        if recording.gap[(time >= begin) & (time <= at[-1])].any():
            continue
        middle = at[:-1] + 0.5 * step + delay
        found.append(
            (
                interpolated(at, time, q),
                interpolated(at, time, dq),
                interpolated(middle, time, torque),
            )
        )
    own, speeds, torques = (np.array(each) for each in zip(*found, strict=True))
    return Rollouts(float(step), own, speeds, torques)


def spec_of(
    found: Identified,
    values: Floats,
    friction: Floats,
    gravity: Sequence[float],
    step: float,
) -> mujoco.MjSpec:
    """Return the arm with these values and friction (2, n), and a motor of each joint."""
    rounded = values.copy()
    moments = parts(rounded).bodies[:, _MOMENTS]
    parts(rounded).bodies[:, _MOMENTS] += THICKENED * moments.sum(axis=1, keepdims=True)
    arm = found._replace(values=rounded, dynamics=friction)
    spec = mujoco.MjSpec.from_string(mjcf(arm, gravity, ''))
    spec.option.timestep = step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for joint, offset in zip(spec.joints, parts(values).terms[OFFSET], strict=True):
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        motor = spec.add_actuator(name=joint.name, target=joint.name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        motor.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        motor.biasprm[0] = -offset
    return spec


def rollout_error(
    found: Identified,
    values: Floats,
    rows: Rows,
    windows: Split,
    given: Rollouts,
    gravity: Sequence[float],
) -> float:
    """Return the rms error of positions, relative to the way moved [%].

    It is infinite if the motion diverges, and NaN if MuJoCo refuses the model as not physical.
    """
    friction = nearest_friction(rows, windows, values)
    try:
        model = spec_of(found, values, friction, gravity, given.step).compile()
    except (ValueError, ZeroDivisionError, np.linalg.LinAlgError):
        return float('nan')
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    mujoco.set_mju_user_warning(lambda _: None)  # those that diverge show in the error
    data = mujoco.MjData(model)
    errors = []
    for q, dq, torque in zip(given.q, given.dq, given.torque, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = q[0]
        data.qvel[:] = dq[0]
        for k, ctrl in enumerate(torque):
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data)
            off = data.qpos - q[k + 1]
            if not np.abs(off).max() < _FAR:
                return float('inf')
            errors.append(off)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    return float(100.0 * np.linalg.norm(rms) / np.linalg.norm(given.moved))

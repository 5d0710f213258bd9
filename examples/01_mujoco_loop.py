# SPDX-License-Identifier: Apache-2.0
"""A loop of your own: MuJoCo simulates a Panda, `ArmController` computes its torques.

python examples/01_mujoco_loop.py [FOLDER of a bag]
"""

import sys

import mujoco
import numpy as np

import blf_dsc_controller as blf

arm = mujoco.MjModel.from_xml_path(str(blf.share_folder() / 'config' / 'panda.urdf'))
arm.opt.timestep = 0.001
arm.dof_armature[:] = 0.1  # kg m^2: rotors, which no URDF has
data = mujoco.MjData(arm)
data.qpos[:7] = [-0.14, -0.04, -0.03, -1.43, -0.05, 1.66, 0.27]

record = sys.argv[1] if len(sys.argv) > 1 else None
with blf.ArmController('panda', record=record) as controller:
    for step in range(8000):
        torque = controller.update(data.time, data.qpos[:7], data.qvel[:7])
        data.qfrc_applied[:7] = 0.0 if torque is None else torque
        mujoco.mj_step(arm, data)
        if step % 1000 == 999:
            error = 1e3 * np.abs(controller.error).max()
            print(f'{data.time:4.1f} s: {controller.phase}, error {error:.2f} mrad')

# SPDX-License-Identifier: Apache-2.0
"""franka-sim's Franka Research 3 as a process, in lock-step, with its limits enforced.

    python franka_sim_server.py ADDRESS [published] [WHAT@CYCLE ...]

It needs franka-sim and nothing of this package: both want other releases of numpy and
MuJoCo.  Each step waits for the torque of the last state.  Cycles are counted from the
first torque of a motion.  It prints `ready` when it accepts connections.  The arm is
that of franka-sim's own URDF, since its default is downloaded.  WHAT is one of

    load=KG     a mass appears behind the flange, or disappears again (0)
    deaf        torques are no longer heard, as on a bad network

As published, tau_J is the command without gravity.  Here it is what a sensor between
gear and link measures, as an FR3's: links, gravity and load, without rotor and friction.
`published` leaves it.  A torque that steps by more than 1 N m in a cycle ends the motion,
and so do 20 states without an answer.
"""

from __future__ import annotations

import re
import sys
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path

import franka_sim
import mujoco
from franka_sim import FrankaSimServer
from franka_sim.mujoco_franka_sim import MujocoFrankaSim

_ROTORS = (0.606, 0.606, 0.462, 0.462, 0.206, 0.206, 0.206)  # kg m^2, published
_GRASP = '0 0 0.227'  # m, of the load in the frame of link 7
_NOTHING = 1e-6  # kg
_PATIENCE = 20.0  # s, for a torque; then the client is gone
_IDLE = 0.002  # s, for a step while nothing moves
_SLOW = 0.05  # s, for a step of a motion that waits for its first torque


def model_file(folder):
    """Write the arm of franka-sim's URDF as MJCF, with a body that may become a load."""
    urdf = (Path(franka_sim.__file__).parent / 'models/fr3.urdf').read_text()
    urdf = re.sub(r'<(visual|collision)\b.*?</\1>', '', urdf, flags=re.DOTALL)
    keep = '<mujoco><compiler fusestatic="false"/></mujoco>'
    urdf = re.sub('(<robot[^>]*>)', rf'\1{keep}', urdf, count=1)
    path = str(Path(folder) / 'fr3.xml')
    mujoco.mj_saveLastXML(path, mujoco.MjModel.from_xml_string(urdf))
    text = Path(path).read_text()
    rotors = iter(_ROTORS)
    text = re.sub('<joint ', lambda _: f'<joint armature="{next(rotors)}" ', text)
    load = (
        f'<body name="load" pos="{_GRASP}"><inertial pos="0 0 0" mass="{_NOTHING}" '
        f'diaginertia="{_NOTHING} {_NOTHING} {_NOTHING}"/></body>'
    )
    text = re.sub('(<body name="link7"[^>]*>)', rf'\1{load}', text, count=1)
    Path(path).write_text(text)
    return path


class Arm(MujocoFrankaSim):
    """The arm, which moves when it is told to."""

    def __init__(self, path, *, is_published):
        super().__init__(model_path=path)
        self.is_published = is_published

    def initialize_simulation(self):
        super().initialize_simulation()
        self.load = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, 'load')
        self.model.body_gravcomp[self.load] = 0.0  # its drives do not know it

    def run_simulation(self):
        """Leave the steps to the server."""
        while self.running:
            time.sleep(0.1)

    def hold(self, mass):
        self.model.body_mass[self.load] = max(mass, _NOTHING)
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def _read_and_publish_state(self):
        super()._read_and_publish_state()
        if not self.is_published:
            self._state_snapshot['tau_J'] = self.sensed()

    def sensed(self):
        """Return the torques (7,) [N m] of sensors behind gears, over the last step."""
        data, joints = self.data, self.arm_dofs_idx
        rotors = self.model.dof_armature * data.qacc
        # of the drives with what they add, less viscous and dry friction and rotors
        behind = data.qfrc_applied + data.qfrc_passive + data.qfrc_constraint - rotors
        return behind[joints]


class Server(FrankaSimServer):
    """A server whose states wait for the torques of those before."""

    def __init__(self, arm, address, events):
        self.answer = threading.Condition()
        self.answered = 0  # number of the last state with an answer
        self.events = events
        self.cycle = 0  # since the first torque of the motion
        super().__init__(
            host=address,
            physics_sim=arm,
            enable_gripper=False,
            enforce_comm_constraints=True,
            enforce_motion_limits=True,
        )

    def _dispatch_control_command(self, command, **options):
        super()._dispatch_control_command(command, **options)
        with self.answer:
            self.answered = command['message_id']
            self.answer.notify_all()

    def _drain_gate(self, answer_deadline=0.0):
        """Wait for the answer to the last state, and let the arm move by one cycle."""
        del answer_deadline
        moves = self.current_motion_id and self._motion_has_commands
        if moves:
            self.wait()
        else:
            self.cycle = 0
            time.sleep(_SLOW if self.current_motion_id else _IDLE)
        self.cycle += bool(moves)
        for what in self.events.pop(self.cycle, ()):  # once, of the first motion
            self.happen(what)
        self.physics_sim.step()
        fields = self.physics_sim.get_robot_state().items()
        owned = self._server_owned_state_fields
        self.robot_state.state.update({k: v for k, v in fields if k not in owned})
        return 0.0

    def happen(self, what):
        name, _, value = what.partition('=')
        match name:
            case 'load':
                self.physics_sim.hold(float(value))
            case 'deaf':
                self.comm.command_received = lambda _number: (
                    False
                )  # until the next client

    def wait(self):
        end = time.monotonic() + _PATIENCE
        with self.answer:
            while self.answered < self._last_published_message_id:
                if not self.current_motion_id or not self.connection_running:
                    return
                if time.monotonic() > end:
                    return
                self.answer.wait(0.02)


def main(address, *words):
    events = defaultdict(list)
    for word in words:
        what, _, cycle = word.partition('@')
        if cycle:
            events[int(cycle)].append(what)
    with tempfile.TemporaryDirectory() as folder:
        arm = Arm(model_file(folder), is_published='published' in words)
        server = Server(arm, address, events)
        threading.Thread(target=server.start, daemon=True).start()
        while not server.running or arm.data is None or not arm.running:
            time.sleep(0.05)
        print('ready', flush=True)  # noqa: T201
        while True:
            time.sleep(1.0)


if __name__ == '__main__':
    main(*sys.argv[1:])

# SPDX-License-Identifier: Apache-2.0
"""franky-sim's Franka Research 3 as a process: MuJoCo behind libfranka's protocol, in lock-step.

    python franka_simulator.py ADDRESS [WHAT@CYCLE ...]

Once the first torque of a motion has come, each step waits for the torque of the last
state, and until then time passes slowly, so that results do not depend on the computer.
Cycles are counted from that torque.  It prints `ready` when it accepts connections.
WHAT is one of

    load=KG     a mass appears in the hand, or disappears again (0)
    reflex      the motion is aborted, as after a collision
    die         the process ends without a word
    lose=N      N states are lost on the network
    gears=K     motors have positions, ahead of their links by the torque over K N m/rad
"""

from __future__ import annotations

import os
import sys
import time
from collections import defaultdict
from pathlib import Path
from select import select

import mujoco
import numpy as np
from franky_sim import SimulationServer
from franky_sim.franka_robot_protocol import (
    BaseCommand,
    MoveStatus,
    RobotCommand,
    UDPCommand,
)
from franky_sim.mujoco_simulator import MujocoSimulator

_HAND = 'robot0_hand'
_GRASP = np.array([0.0, 0.0, 0.12])  # m, of the load in the frame of the hand
_PATIENCE = 20.0  # s, for a torque; then the client is gone
_POLL = 0.02  # s, in which also what needs no message is noticed
_IDLE = 0.04  # s, for a step while nothing moves: a client reads but a few states then
_SLOW = 0.3  # s, for a step of a motion that waits for its first torque


class Simulator:
    """One robot, and what is to happen to it."""

    def __init__(self, sim, server, events):
        self.sim = sim
        self.server = server
        (self.robot,) = server.robot_servers
        self.events = events
        self.cycle = 0  # since the first torque of the motion
        self.unanswered = False
        self.last = 0  # number of the last state
        self.hand = mujoco.mj_name2id(sim.model, mujoco.mjtObj.mjOBJ_BODY, _HAND)
        if self.hand < 0:
            raise LookupError(f'the model has no body {_HAND}')
        self.empty = (
            sim.model.body_mass[self.hand],
            sim.model.body_ipos[self.hand].copy(),
        )
        handle = self.robot._handle_udp_command

        def answered(data):
            # A torque for an earlier state would leave one more on its way for good.
            self.unanswered = UDPCommand.from_bytes(data).message_id < self.last
            self.cycle = max(self.cycle, 1)
            handle(data)

        self.robot._handle_udp_command = answered

    def step(self):
        """Wait for the torque of the last state, and advance by one cycle."""
        if self.cycle and self.robot.current_motion_id:
            self.wait()
        else:
            self.robot.process_commands()
        if not self.robot.current_motion_id:
            self.cycle = 0
        if self.cycle == 0:
            time.sleep(_SLOW if self.robot.current_motion_id else _IDLE)
        for what in self.events[self.cycle] if self.cycle else ():
            self.happen(what)
        self.sim.step()
        self.last = self.robot._FrankaServer__message_id
        self.robot.send_state()
        self.unanswered = True
        self.cycle += self.cycle > 0

    def wait(self):
        deadline = time.monotonic() + _PATIENCE
        while self.unanswered and self.robot.current_motion_id:
            if time.monotonic() > deadline:
                return
            sockets = self.robot._FrankaServer__udp_socket, self.robot._tcp_socket
            select(sockets, (), (), _POLL)
            self.robot.process_commands()

    def happen(self, what):
        name, _, value = what.partition('=')
        match name:
            case 'load':
                self.hold(float(value))
            case 'reflex':
                motion, socket = self.robot.current_motion_id, self.robot._tcp_socket
                self.robot.stop_motion(send_preemption_signal=False)
                self.robot.reset_current_motion_id()
                status = MoveStatus.kReflexAborted
                BaseCommand.send_response(socket, RobotCommand.kMove, motion, status)
            case 'lose':
                for _ in range(int(value)):
                    self.sim.step()
                    self.robot.process_commands()
                    self.robot._FrankaServer__message_id += 1
            case 'gears':
                self.twist(float(value))
            case 'die':
                os._exit(0)

    def twist(self, stiffness):
        """Let the states have positions of motors, of which the simulator has none."""

        def with_motors():
            state = self.robot.robot_state
            theta = np.add(state.q, np.divide(state.tau_J, stiffness))
            return state.replace(theta=tuple(theta), dtheta=state.dq).pack_state()

        self.robot._get_state_bytes = with_motors

    def hold(self, mass):
        """Let the hand hold a point mass, or nothing but itself."""
        own, centre = self.empty
        model = self.sim.model
        model.body_mass[self.hand] = own + mass
        model.body_ipos[self.hand] = (own * centre + mass * _GRASP) / (own + mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))


def without_visuals(sim):
    """Leave out what is only drawn: to load it takes half of a short run, and nothing looks.

    Every body that moves has its inertia in the file.
    """
    for parent in list(sim.worldbody.iter()):
        for drawn in parent.findall("geom[@class='visual']"):
            parent.remove(drawn)
    used = {geom.get('mesh') for geom in sim.worldbody.iter('geom')}
    for assets in sim.scene.findall('asset'):
        for mesh in assets.findall('mesh'):
            if mesh.get('name', Path(mesh.get('file')).stem) not in used:
                assets.remove(mesh)


def main(address, *words):
    events = defaultdict(list)
    for word in words:
        what, _, cycle = word.partition('@')
        events[int(cycle)].append(what)
    with MujocoSimulator() as sim:
        sim.add_robot()
        without_visuals(sim)
        with SimulationServer(sim, hostname_candidates=[address]) as server:
            simulator = Simulator(sim, server, events)
            print('ready', flush=True)  # noqa: T201
            while True:
                simulator.step()


if __name__ == '__main__':
    main(*sys.argv[1:])

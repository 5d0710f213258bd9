# SPDX-License-Identifier: Apache-2.0
"""A Franka Research 3 over libfranka's protocol: a robot, or franky-sim's on this computer.

python examples/02_fr3_protocol.py [ADDRESS]

Without an address it starts the simulator, five times slower than a real robot, so that
no state is missed where other programs run.  It has a hand that our URDF lacks.
"""

import importlib.util
import subprocess
import sys

import numpy as np

import blf_dsc_controller as blf

SIMULATOR = """
from franky_sim import SimulationServer
from franky_sim.mujoco_simulator import MujocoSimulator
with MujocoSimulator() as sim:
    sim.add_robot()
    with SimulationServer(sim, hostname_candidates=['127.0.0.40']) as server:
        print('ready', flush=True)
        server.run_forever(realtime=5.0)
"""


def main(address: str) -> None:
    """Move 0.1 rad forth and back."""
    with blf.Drive('fr3_direct', robot=address) as arm:
        start = arm.state.q
        arm.move_to(start + 0.1)
        print('moved by', np.round(arm.state.q - start, 3), 'rad')
        arm.move_to(start)
        print(f'back, within {1e3 * abs(arm.state.error).max():.2f} mrad')


if len(sys.argv) > 1:
    main(sys.argv[1])
else:
    needed = {'franky_sim': 'franky-sim', 'pylibfranka': 'pylibfranka'}
    if missing := [each for each in needed if not importlib.util.find_spec(each)]:
        sys.exit(f'first pip install {" ".join(needed[each] for each in missing)}')
    simulator = subprocess.Popen(
        [sys.executable, '-c', SIMULATOR], stdout=subprocess.PIPE, text=True
    )
    while 'ready' not in simulator.stdout.readline():
        pass
    try:
        main('127.0.0.40')
    finally:
        simulator.kill()

# SPDX-License-Identifier: Apache-2.0
"""A parameter file of two links with elastic joints, postures of it, and shorter motions."""

from blf_dsc_controller.commissioning import motion, planned, postures, response

NEAR, FAR = (0.3, 1.1), (0.8, 0.5)  # rad
# Springs of 26 and 29 Hz, and no torque where nothing moves: no gravity.
ARM = """
/**:
  ros__parameters:
    robot: {urdf: two_link.urdf, gravity: [0.0, 0.0, 0.0], rotor_inertia: [0.3, 0.1], payload: 0.1}
/**/sim_plant:
  ros__parameters:
    truth.rotor_inertia: [0.3, 0.1]
    joint.stiffness: [3.0e+3, 1.5e+3]
    disturbance: {constant: [0.0, 0.0], amplitude: [0.0, 0.0], viscous: [2.0, 1.0]}
    initial.position: [0.1, 0.8]
/**/blf_dsc_controller:
  ros__parameters:
    barrier.bound: [0.2, 0.2]
    limits.position_lower: [-3.0, -3.0]
    limits.position_upper: [3.0, 3.0]
"""


def shorten_motions(monkeypatch):
    """Let motions settle for 2 s in place of 6 s, and periods take 4 s in place of 8 s.

    That is enough for an arm whose springs ring at 26 Hz.
    """
    for module in (motion, planned, response):
        monkeypatch.setattr(module, 'SETTLING', 2.0)
    monkeypatch.setattr(motion, '_SECONDS', 2.0)


def shorten_moves(monkeypatch):
    """Let moves to a posture take as little time as they may, in place of 1 to 2 s more."""
    monkeypatch.setattr(postures, 'SPEED', 2.0)
    monkeypatch.setattr(postures, '_ACCELERATION', 8.0)

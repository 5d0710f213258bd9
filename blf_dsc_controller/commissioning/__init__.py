# SPDX-License-Identifier: Apache-2.0
"""Measure an arm before it is controlled, and choose its gains by what was measured.

Nobody can state the stiffness of his gears, the inertia of his motors and the lags of his
drives, and all gains rest on them.  Here the arm is held softly and shaken a little by its
reference; from the torques sent and the positions measured follow the responses of its
joints, and from these the stiffest gains with a margin.

    motion          the reference that shakes all joints at once
    response        the responses (f, n, n) from a run of it, with their uncertainty
    choice          gains by the modulus margin, at all postures measured
    findings        inertias, lags, resonances: what the arm is, beside what was assumed
    commissioning   the three steps in a row
    own_loop        all of it for a loop of your own: `blf.Commissioning`
    simulated       the runs of a simulated arm
    postures        the runs of a robot, from posture to posture
    driven          likewise, over its driver
    over_ros        likewise, over ROS, by the controller's node
    proof           the chosen gains in three steps along the arm's own reference
    page            what was found and chosen, for people
    files           the parameter files of motions, and with what was chosen
"""

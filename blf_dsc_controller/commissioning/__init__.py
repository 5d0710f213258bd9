# SPDX-License-Identifier: Apache-2.0
"""Measure an arm before it is controlled, and choose its gains by what was measured.

The stiffness of gears, the inertia of motors and the lags of drives are rarely specified,
and all gains depend on them.  Here the arm is held with soft gains and excited a little by
its reference.  The torques sent and the positions measured give the responses of its
joints, and these the stiffest gains with a margin.

    motion          the reference that excites all joints at once
    planned         the motions in some postures, and the gains of the arm meanwhile
    run_parameters  what else such runs have in common, and those of moves and proofs
    measurement     a run of it, with the configuration that it had
    response        the responses (f, n, n) from a run of it, with their uncertainty
    margin          the modulus margin of the measured arm, by its gains
    choice          the stiffest gains with a margin, at all postures measured
    observer_pole   likewise, the fastest load observer
    better_known    the stiffer configuration with which a hardly known arm is measured again
    strength        whether a run shows enough, and the torque of the next one
    chosen          the configuration with the chosen gains, and bounds that they keep
    findings        inertias, lags and resonances of the arm, beside those assumed
    commissioned    the three steps in a row
    commissioning   all of it for a loop of your own: `blf.Commissioning`
    simulated       the runs of a simulated arm
    postures        the runs of a robot over its driver, from posture to posture
    proof           the chosen gains in three steps along the arm's own reference
    page            tables and sentences of what was found and chosen
    picture         margins of the gains, and responses of the joints
    files           the parameter files of motions, and with what was chosen
"""

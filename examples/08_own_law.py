# SPDX-License-Identifier: Apache-2.0
"""A law of your own in one file: gravity and inertia by the URDF, and a PD.

python examples/08_own_law.py

It is compiled into the loop, with all checks, and may be run wherever the paper's law
is: `law: /path/to/08_own_law.py` in a parameter file.  doc/tutorial_law.md says more.
"""

from typing import Annotated, NamedTuple

from blf_dsc_controller.configuration.schema import positive
from blf_dsc_controller.law.compensation import fill_known_torque


class ComputedTorque(NamedTuple):
    """tau = M (ddqr - kp z - kd dz) + C dq + G, of the arm that the URDF describes."""

    rate: Annotated[float, positive(30.0, 'natural frequency of the error', 'rad/s')]

    @property
    def has_barrier(self):
        """It keeps no bound: the loop does not stop at it."""
        return False

    def compute_demand(self, settings, state, signals, t, dt):
        """Write the torque."""
        for i in range(settings.n):
            rate_of_error = signals.dq[i] - signals.dqr[i]
            state.alpha2[i] = signals.dq[i]
            signals.dalpha2[i] = (
                signals.ddqr[i]
                - self.rate**2 * signals.xi1[i]
                - 2.0 * self.rate * rate_of_error
            )
        fill_known_torque(settings, state, signals, state.alpha2, signals.dalpha2, dt)
        for i in range(settings.n):
            signals.demand[i] = signals.model_torque[i]

    def finish(self, settings, state, signals, dt, saturated):
        """Keep nothing from one sample to the next."""


LAW = ComputedTorque

if __name__ == '__main__':
    import blf_dsc_controller as blf

    for law in ('blf_dsc', __file__):
        given = {'blf_dsc_controller': {'law': law}, 'sim_plant': {'duration': 20.0}}
        loop = blf.load_loop('two_tone', given)
        run = blf.simulate(loop.controller, loop.plant).run()
        late = run.error[run.time > 15.0]
        print(f'{law}: largest error {1e3 * abs(late).max():.3f} mrad from 15 s on')

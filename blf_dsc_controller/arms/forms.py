# SPDX-License-Identifier: Apache-2.0
"""Learned parameters of a chain: all base parameters, or the load.

In the form `payload` the inertias of all bodies are phi = D c, where c has the rotor inertias, the
ten of a load in the tip frame, which are 0 in the URDF, and one factor for all bodies.  Only an
independent set of them is learned, P = K c; the others are grouped with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from blf_dsc_controller.arms.base_parameters import (
    BaseParameters,
    independent,
    stacked_regressor,
)
from blf_dsc_controller.arms.chain_kernels import ROTOR, bodies_of
from blf_dsc_controller.arms.combined_chain import CombinedChain, combined_chain
from blf_dsc_controller.arms.inertia import inertia_of, pseudo_inertia
from blf_dsc_controller.arms.prior import (
    PAYLOAD_SIZE,
    ROTORS,
    UNKNOWN_ROTOR,
    deviations,
    payload_inertia,
    prior_factor,
)
from blf_dsc_controller.arms.serial_chain import SerialChain, serial_chain
from blf_dsc_controller.arms.urdf import Chain

TRUSTED = 0.001
"""Standard deviation of the factor for all bodies where only the load is unknown: almost zero."""


@dataclass(frozen=True, eq=False)
class LearnedParameters:
    """Learned parameters P of a model.

    Attributes:
        initial: (p,) P according to the URDF.
        L: (p, r) of P = initial + L theta, where theta has zero mean and unit covariance.
        load: (p,) what 1 kg at the tip adds to P.
    """

    model: SerialChain | CombinedChain
    initial: np.ndarray
    L: np.ndarray
    load: np.ndarray


def learned_parameters(
    chain: Chain, base: BaseParameters, form: str, payload: float, rotors: np.ndarray
) -> LearnedParameters:
    """Return the parameters of a form for a rated payload [kg] and rotors (n,) [kg m^2, or kg]."""
    n, tip = len(chain.joints), chain.tip_placement
    phi = np.column_stack((chain.inertias, np.zeros(n)))
    ten = np.array([inertia_of(tip @ pseudo_inertia(e) @ tip.T) for e in np.eye(ROTOR)])
    unsure = np.where(rotors > 0.0, ROTORS * rotors, UNKNOWN_ROTOR)
    if form == 'base':
        L = prior_factor(chain, base, payload, unsure)
        loaded = np.zeros_like(chain.inertias)
        loaded[-1] = ten[0]
        load = base.of(loaded, np.zeros(n))
        return LearnedParameters(base.model, base.of(chain.inertias, rotors), L, load)
    unit = np.eye(phi.size).reshape(n, ROTOR + 1, -1)
    D = np.vstack((unit[:, ROTOR], ten @ unit[-1, :ROTOR], phi.ravel()))
    start, load = np.append(np.zeros(ROTOR), 1.0), np.eye(n + ROTOR + 1)[n]
    L = np.diag(np.append(unsure, np.full(ROTOR + 1, TRUSTED)))
    L[n:-1, n:-1] = deviations(payload_inertia(payload), 1.0, PAYLOAD_SIZE)
    size = np.linalg.norm(D, axis=1)
    whole = serial_chain(chain, tuple(bodies_of(base.model.vector).gravity))
    kept, K = independent(stacked_regressor(whole) @ (D.T / size), np.arange(size.size))
    K *= size / size[kept, None]
    model = combined_chain(whole, kept, D[kept])
    return LearnedParameters(model, K @ np.append(rotors, start), K @ L, K @ load)

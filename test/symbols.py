# SPDX-License-Identifier: Apache-2.0
"""The paper's symbols for settings of the law, which has them in parts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from blf_dsc_controller.law import columns
from blf_dsc_controller.law.state import Settings

_PARTS = {
    'barrier': 'bound initial_bound funnel_rate weight slope_limit knee',
    'surface': 'gain=K mu time_constant known_rate',
    'feedback': 'gain=Kp robust_gain=d2 damping_rate follows_inertia decoupled',
    'disturbance': 'gain=gamma leakage=eta',
    'torque': 'limit=torque_limit rate_limit drive',
    'columns': 'coulomb_velocity',
    'row': 'filter_pole=pole motion_scale lag row_weight',
    'window': 'length=window row_interval interval prior_weight regularization=rho',
    'excitation': (
        'excitation_threshold=sigma learning_start change_detection starts_full '
        'residual_floor'
    ),
    'adaptation': 'weight=kappa radius adaptation_gain=Gamma variance lower=least upper=most',
}
_FIELDS = {
    symbol or field: (part, field)
    for part, fields in _PARTS.items()
    for field, _, symbol in (each.partition('=') for each in fields.split())
}
"""Part and field of each symbol; all others are fields of the settings themselves."""


def replaced(settings: Settings, **changes: Any) -> Settings:
    """Return settings with changes to fields or symbols."""
    for name, value in changes.items():
        part, field = _FIELDS.get(name, ('', name))
        if part:
            changed = getattr(settings, part)._replace(**{field: value})
            settings = settings._replace(**{part: changed})
        else:
            settings = settings._replace(**{field: value})
    return settings


def _blocks(of: columns.Settings) -> dict[str, Any]:
    """Return which disturbance columns there are."""
    blocks = list(zip(of.kinds, of.rates, strict=True))
    return {
        'bias': columns.BIAS in of.kinds,
        'viscous': columns.VISCOUS in of.kinds,
        'coulomb': columns.COULOMB in of.kinds,
        'load_friction': columns.LOAD_FRICTION in of.kinds,
        'frequencies': [w for kind, w in blocks if kind == columns.SINE],
        'ripple_cycles': [N for kind, N in blocks if kind == columns.RIPPLE_SINE],
    }


def by_symbol(settings: Settings) -> SimpleNamespace:
    """Return the settings by their symbols."""
    return SimpleNamespace(
        **settings._asdict()
        | _blocks(settings.columns)
        | {
            symbol: getattr(getattr(settings, part) if part else settings, field)
            for symbol, (part, field) in _FIELDS.items()
        }
    )

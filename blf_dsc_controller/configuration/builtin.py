# SPDX-License-Identifier: Apache-2.0
"""The parameters that ROS itself gives to every node."""

_NAMES = ('use_sim_time', 'start_type_description_service')
_GROUPS = ('qos_overrides.',)


def is_builtin(name: str) -> bool:
    """Whether ROS, not this package, declares the parameter."""
    return name in _NAMES or name.startswith(_GROUPS)

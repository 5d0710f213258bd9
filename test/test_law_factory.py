# SPDX-License-Identifier: Apache-2.0
"""From a configuration to the settings of the law."""

from __future__ import annotations

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.schema import build
from blf_dsc_controller.law.factory import column_names, settings_of_config


def settings(**given):
    return settings_of_config(build(ControllerConfig, given))


def test_learning_waits_for_the_window_and_the_filters_to_settle():
    """tau_d + T_a of (26)."""
    learning = {'learning.window': 0.75, 'learning.settling_time': 0.25}
    assert settings(**learning).learning_start == 1.0
    assert settings(**learning).window == 750


def test_parameters_and_columns_have_separate_gains():
    config = {'learning.adaptation_gain': [1.0, 2.0, 3.0], 'learning.column_gain': 5.0}
    columns = len(column_names(build(ControllerConfig, config)))
    assert columns > 0
    assert settings(**config).Gamma.tolist() == [1.0, 2.0, 3.0, *[5.0] * columns]

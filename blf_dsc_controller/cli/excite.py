# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc excite`: write a preset whose reference excites the learning best within the limits."""

from __future__ import annotations

from argparse import Namespace

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.configuration.params_file import format_value, load, locate
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law import exciting_reference

_DIGITS = 4  # of a radian, in the file
_UNITS = {'frequency': 'rad/s, of the cosines, then of the sines'}


def excite(options: Namespace) -> None:
    """Search, and write the preset."""
    if options.out.exists():
        raise BlfDscError(f'{options.out} exists already: choose another name')
    options.out.write_text(_preset(options), encoding='utf-8')
    print(f'wrote {options.out}')


def _preset(options: Namespace) -> str:
    config = load(locate(options.config), CONTROLLER, ControllerConfig)
    guess = options.guess or config.learning.initial_estimate
    if len(guess) != len(config.learning.initial_estimate):
        raise BlfDscError(
            f'--guess has {len(guess)} values, but the model {config.model} has '
            f'{len(config.learning.initial_estimate)} parameters'
        )
    problem = exciting_reference.ExcitationProblem(
        config, np.array(guess), options.torque_fraction, options.harmonics
    )
    x = exciting_reference.search(problem, options.seed, options.starts)
    parameters = problem.parameters(np.round(x, _DIGITS))
    names = ('offset', 'amplitude', 'frequency', 'phase')
    before = problem.evaluate({name: getattr(config.reference, name) for name in names})
    after = problem.evaluate(parameters)
    command = (
        f'blf_dsc excite PRESET.yaml --config {options.config} '
        f'--guess {" ".join(f"{value:g}" for value in guess)} '
        f'--torque-fraction {options.torque_fraction:g} --harmonics {options.harmonics} '
        f'--starts {options.starts} --seed {options.seed}'
    )
    entries = ''.join(
        f'      # {_UNITS.get(name, "rad")}\n      {name}: {format_value(value)}\n'
        for name, value in parameters.items()
    )
    return f"""\
# The reference that excites the learning most within the limits of joints and torque: minimum
# eigenvalue of the excitation matrix {after.lambda_min:.3g}, instead of {before.lambda_min:.3g} \
with the reference of that file.
# {command}

/**/{CONTROLLER}:
  ros__parameters:
    reference:
      type: sinusoids
{entries}"""

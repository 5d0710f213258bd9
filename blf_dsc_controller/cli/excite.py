# SPDX-License-Identifier: Apache-2.0
"""`excite`: write a preset whose reference excites the learning as much as the limits allow."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.configuration.params_file import format_value, load, locate
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.law import exciting_reference

_DIGITS = 4  # of a radian, in the file


class ExciteError(BlfDscError):
    """The search cannot be made as asked for."""


def parser() -> argparse.ArgumentParser:
    """Command-line options."""
    options = argparse.ArgumentParser(
        prog='excite',
        description='Find the sum of sinusoids, of the period of the learning window, that excites '
        'the learning most within the limits of joints and torque, and write it as a preset.',
    )
    options.add_argument('out', type=Path, help='parameter file to write; it must not exist yet')
    options.add_argument(
        '--config', default='recommended', help='parameter file, or a preset (recommended)'
    )
    options.add_argument(
        '--guess',
        type=float,
        nargs='+',
        help='parameters P to reckon the torque with (learning.initial_estimate)',
    )
    options.add_argument(
        '--share', type=float, default=0.8, help='of the torque limit that may be used (0.8)'
    )
    options.add_argument('--harmonics', type=int, default=2, help='of the window (2)')
    options.add_argument('--starts', type=int, default=8, help='searches to take the best of (8)')
    options.add_argument('--seed', type=int, default=0, help='of the starts (0)')
    return options


def preset(
    parameters: dict[str, tuple[float, ...]], after: float, before: float, command: str
) -> str:
    """Text of the parameter file."""
    gain = f'{after:.3g}, instead of {before:.3g} with the reference of that file'
    lines = [
        '# The reference that excites the learning most within the limits of joints and torque:',
        f'# least eigenvalue of the excitation matrix {gain}.',
        f'# {command}',
        '',
        f'/**/{CONTROLLER}:',
        '  ros__parameters:',
        '    reference:',
        '      type: sinusoids',
    ]
    units = {'frequency': 'rad/s, of the cosines, then of the sines'}
    for name, value in parameters.items():
        lines += [f'      # {units.get(name, "rad")}', f'      {name}: {format_value(value)}']
    return '\n'.join(lines) + '\n'


def search(options: argparse.Namespace) -> str:
    """Search, and return the text of the preset.

    Raises:
        ConfigurationError: the configuration makes no controller.
        ExciteError: the guess does not fit the model, or scipy is not installed.
        MotionError: no reference was found that keeps the limits.
    """
    if importlib.util.find_spec('scipy') is None:
        raise ExciteError("the search needs scipy: pip install 'blf_dsc_controller[study]'")
    config = load(locate(options.config), CONTROLLER, ControllerConfig)
    guess = options.guess or config.learning.initial_estimate
    if len(guess) != len(config.learning.initial_estimate):
        raise ExciteError(
            f'--guess has {len(guess)} values, but the model {config.model} has '
            f'{len(config.learning.initial_estimate)} parameters'
        )
    problem = exciting_reference.ExcitationProblem(
        config, np.array(guess), options.share, options.harmonics
    )
    x = exciting_reference.search(problem, options.seed, options.starts)
    parameters = problem.parameters(np.round(x, _DIGITS))
    told = config.reference
    before = problem.evaluate(
        {
            'offset': told.offset,
            'amplitude': told.amplitude,
            'frequency': told.frequency,
            'phase': told.phase,
        }
    )
    command = (
        f'excite --config {options.config} --guess {" ".join(f"{value:g}" for value in guess)} '
        f'--share {options.share:g} --harmonics {options.harmonics} --starts {options.starts} '
        f'--seed {options.seed}'
    )
    after = problem.evaluate(parameters)
    return preset(parameters, after.lambda_min, before.lambda_min, command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    options = parser().parse_args(arguments)
    try:
        if options.out.exists():
            raise ExciteError(f'{options.out} is there already: choose another name')
        options.out.write_text(search(options), encoding='utf-8')
    except BlfDscError as error:
        print(f'excite: {error}', file=sys.stderr)
        return 1
    print(f'written: {options.out}')
    return 0


if __name__ == '__main__':
    sys.exit(main())

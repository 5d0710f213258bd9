# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc excite`: write a preset whose reference excites the learning best within the limits."""

from __future__ import annotations

import textwrap
from argparse import Namespace

import numpy as np
from tqdm import tqdm

from blf_dsc_controller.cli.output import make_room
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER
from blf_dsc_controller.configuration.params_file import format_value, load, locate
from blf_dsc_controller.configuration.robot import learned_of, parameters_of
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification import exciting_reference
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.reference.clearance import Clearance

_DIGITS = 4  # decimals of an angle [rad] in the file
_UNITS = {'frequency': 'rad/s, of the cosines, then of the sines'}
_UNSHOWN = 0.8  # of the prior's deviation; parameters that keep more are hardly shown
_WIDTH = 98


def excite(options: Namespace) -> None:
    """Search for the reference and write the preset."""
    make_room(options.out, force=options.force)
    text = _preset(options)
    options.out.write_text(text, encoding='utf-8')
    print(text[: text.index('\n\n')])
    print(f'wrote {options.out}')


def _preset(options: Namespace) -> str:
    config = load(locate(options.config), CONTROLLER, ControllerConfig)
    problem = exciting_reference.ExcitationProblem(
        config,
        guess_of(config, options.guess),
        options.torque_fraction,
        options.harmonics,
        clearance_of(config, options.radius, options.floor),
        options.speed_fraction,
    )
    parameters = problem.parameters(_search(problem, options.seed, options.starts))
    for name in ('offset', 'amplitude'):
        parameters[name] = tuple(round(value, _DIGITS) for value in parameters[name])
    names = ('offset', 'amplitude', 'frequency', 'phase')
    before = problem.evaluate({name: getattr(config.reference, name) for name in names})
    after = problem.evaluate(parameters)
    if config.learning.prior_weight > 0.0:
        remaining = problem.remaining(parameters)
        left = [
            f'{100.0 * np.exp(-one.gain / 2 / remaining.size):.0f} %' for one in (before, after)
        ]
        figures = (
            f'a window leaves {left[1]} of the deviation of the prior, in the geometric mean over '
            f'all directions, instead of {left[0]}'
        )
        unshown = _unshown(config, remaining)
    else:
        figures = (
            f'minimum eigenvalue of the excitation matrix {after.lambda_min:.3g}, instead of '
            f'{before.lambda_min:.3g}'
        )
        unshown = []
    about = (
        'The reference that excites the learning most within the limits of joints and torque: '
        f'{figures} with the configured reference.'
    )
    command = (
        f'blf_dsc excite PRESET.yaml --config {options.config} --torque-fraction '
        f'{options.torque_fraction:g} --speed-fraction {options.speed_fraction:g} '
        f'--harmonics {options.harmonics} --starts {options.starts} --seed {options.seed}'
    )
    if options.guess:
        command += f' --guess {" ".join(f"{value:g}" for value in options.guess)}'
    if config.model == 'urdf':
        command += f' --radius {options.radius:g} --floor {options.floor:g}'
    lines = [*textwrap.wrap(about, _WIDTH), command, *unshown]
    comment = ''.join(f'# {line}\n' for line in lines)
    entries = ''.join(
        f'      # {_UNITS.get(name, "rad")}\n      {name}: {format_value(value)}\n'
        for name, value in parameters.items()
    )
    return f"""\
{comment}
/**/{CONTROLLER}:
  ros__parameters:
    reference:
      type: sinusoids
{entries}"""


def guess_of(config: ControllerConfig, given: list[float] | None) -> np.ndarray:
    """Return parameters P (k, p) to compute the torque with: as given, or the initial estimate.

    A URDF arm must also be able to carry its payload, which a second row includes.
    """
    start = config.learning.initial_estimate
    if given and len(given) != len(start):
        raise BlfDscError(
            f'--guess has {len(given)} values, but the model {config.model} has {len(start)} '
            'parameters'
        )
    if given or config.model != 'urdf':
        return np.atleast_2d(given or start)
    robot, chain = config.robot, config.robot.chain(config.joints)
    return np.array((start, start + robot.payload * learned_of(robot, chain).load))


def clearance_of(config: ControllerConfig, radius: float, floor: float) -> Clearance | None:
    """Return the clearance of the links of a URDF's arm; radius and height of the floor in m."""
    if config.model != 'urdf':
        return None
    return Clearance(config.robot.chain(config.joints), radius, floor)


def _search(problem: exciting_reference.ExcitationProblem, seed: int, starts: int) -> np.ndarray:
    total = starts * exciting_reference.ITERATIONS
    with tqdm(total=total, desc='searching', unit='iteration', disable=None) as bar:

        def show(done: int, best: float) -> None:
            bar.set_postfix_str(f'best {best:.4g}' if best > -np.inf else '', refresh=False)
            bar.update(done - bar.n)

        return exciting_reference.search(problem, seed, starts, show)


def _unshown(config: ControllerConfig, remaining: np.ndarray) -> list[str]:
    """Return lines listing the parameters that the motion hardly shows, the least shown first."""
    order = [int(k) for k in np.argsort(-remaining) if remaining[k] > _UNSHOWN]
    if not order:
        return ['It shows all parameters.']
    names = list(estimate_names(config))
    if config.model == 'urdf' and config.robot.learn == 'base':
        sums = parameters_of(config.robot, config.robot.chain(config.joints)).combinations
        names[: len(sums)] = sums
    lines = ["It hardly shows the following; of the prior's deviation a window leaves"]
    for k in order:
        text = f'{100.0 * remaining[k]:4.0f} % of {names[k]}'
        lines += textwrap.wrap(text, _WIDTH, subsequent_indent=' ' * 10, initial_indent=' ')
    return lines

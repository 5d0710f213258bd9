# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc excite` and `identify`: an exciting motion, and a corrected URDF."""

from __future__ import annotations

import textwrap
from argparse import Namespace
from collections.abc import Iterable, Sequence
from contextlib import closing
from datetime import datetime
from pathlib import Path

from blf_dsc_controller import __version__
from blf_dsc_controller.bags.content import NameMap
from blf_dsc_controller.cli.main import make_room
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import CONTROLLER, dump, load, locate
from blf_dsc_controller.configuration.robot import Robot
from blf_dsc_controller.errors import BlfDscError
from blf_dsc_controller.identification.corrected_urdf import corrected_urdf
from blf_dsc_controller.identification.exciting_reference import (
    ExcitationProblem,
    search,
)
from blf_dsc_controller.identification.from_files import identify_bag
from blf_dsc_controller.identification.identified import Identified
from blf_dsc_controller.identification.identify import STAGES
from blf_dsc_controller.identification.parameters import robot_parameters
from blf_dsc_controller.identification.problems import (
    is_usable,
    problems_of,
    verdict_of,
)
from blf_dsc_controller.identification.summary import (
    base_table,
    bodies_table,
    errors_table,
    header_of,
    joints_table,
    load_table,
    notes_of,
    ripple_table,
    stiffness_table,
)
from blf_dsc_controller.progress import Stages, announce_reading, print_notice
from blf_dsc_controller.writing import write_text

UNUSABLE = 3
"""Exit code if the model does not explain the torques held back."""

_FORMATS = {'.urdf', '.yaml'}
_DIGITS = 4  # decimals of an angle [rad] in the file
_WIDTH = 98


def identify(options: Namespace) -> int:
    """Identify the arm, print what changed, and write the results and the page."""
    robot = Robot(
        urdf=options.urdf,
        base=options.base,
        tip=options.tip,
        gravity=tuple(options.gravity),
        payload=options.rated_payload,
    )
    outputs = _outputs(options)
    found = _identified(options, robot)
    facts = _facts(found, options)
    notes = _filled(notes_of(found))
    bodies = bodies_table(found)
    base = '\n'.join(base_table(found))
    joints = joints_table(found)
    others = [*stiffness_table(found), *ripple_table(found)]
    tables = [*load_table(found), joints, *others]
    errors = errors_table(found)
    print('\n\n'.join([*facts, errors, bodies, base, *tables, *notes]))
    if options.report:
        print_notice(f'drawing {options.report}: some seconds')
        # slow: its libraries
        from blf_dsc_controller.identification.page import write_identified

        tables_of_page = [errors, bodies, *tables, base]
        write_identified(options.report, found, [*facts, *notes], tables_of_page)
        print(f'wrote {options.report}')
    usable = is_usable(found)
    if outputs and not (usable or options.force):
        print(f'not written: {_listed(outputs)}; --force writes them nevertheless')
    else:
        note = '\n'.join([*facts, *notes, *tables, errors])
        _write(outputs, found, robot, note)
    return 0 if usable else UNUSABLE


def _identified(options: Namespace, robot: Robot) -> Identified:
    """Return the identified arm, and say how far it is."""
    pick_up = options.payload is True
    names = NameMap.parse(options.map)
    begun = (
        f'identifying from {_listed(options.bags)}: some ten seconds for a minute of a few '
        'joints, and up to some minutes where other loads or zeros have to be tried'
    )
    reading, *others = STAGES
    announce_reading(options.bags, 'read')
    with closing(Stages(tuple(others), begun)) as stages:

        def begin(stage: str) -> None:
            if stage == reading:
                return
            if stage == others[0]:  # URDF and recordings have been read, and are right
                _refuse_no_output(options)
            stages.begin(stage)

        return identify_bag(
            options.bags,
            robot,
            options.namespace,
            names,
            options.effort,
            options.gains,
            None if pick_up else options.payload,
            pick_up=pick_up,
            begin=begin,
        )


def _outputs(options: Namespace) -> list[Path]:
    """Return the files to write, and make room for them and the page."""
    outputs: list[Path] = options.out
    suffixes = [path.suffix for path in outputs]
    for path in outputs:
        if path.suffix not in _FORMATS:
            raise BlfDscError(
                f'{path}: got {path.suffix or "no suffix"}; expected .urdf, or .yaml (parameters '
                'of this package)'
            )
    if len(set(suffixes)) < len(suffixes):
        raise BlfDscError(f'{_listed(outputs)}: give one file of each format')
    if '.yaml' in suffixes and '.urdf' not in suffixes:
        raise BlfDscError(
            'the parameters refer to the corrected URDF: give --out a .urdf, too'
        )
    report = [options.report] if options.report else []
    for path in (*outputs, *report):
        make_room(path, force=options.force)
    return outputs


def _refuse_no_output(options: Namespace) -> None:
    if not (options.out or options.report or options.payload):
        raise BlfDscError('nothing to write: give --out, --report or --payload')


def _facts(found: Identified, options: Namespace) -> list[str]:
    """Return the verdict, what was identified from what, and when, and problems."""
    today = datetime.now().astimezone().strftime('%Y-%m-%d %H:%M')
    origin = (
        f'{options.urdf} identified from {_listed(options.bags)} on {today} by '
        f'blf_dsc_controller {__version__}'
    )
    lines = [
        verdict_of(found, options.effort),
        origin,
        header_of(found),
        *problems_of(found, options.effort),
    ]
    if found.chain.gripper and not options.tip:
        lines.append(
            f'{found.chain.gripper} was identified as a joint of the arm; if it is that of a '
            f'gripper, give the link that carries it: --tip {found.chain.joints[-2].link}'
        )
    return _filled(lines)


def _filled(lines: Iterable[str]) -> list[str]:
    """Return paragraphs in lines of the terminal's width."""
    return [textwrap.fill(line, _WIDTH) for line in lines]


def _write(outputs: Sequence[Path], found: Identified, robot: Robot, note: str) -> None:
    """Write the arm in the format of each suffix."""
    for path in outputs:
        if path.suffix == '.urdf':
            viscous, coulomb = found.dynamics
            text = corrected_urdf(
                robot.text, found.chain, found.parts.bodies, viscous, coulomb, note
            )
            write_text(path, text)
        else:
            urdf = next(each for each in outputs if each.suffix == '.urdf')
            comment = ''.join(f'# {line}\n' for line in note.splitlines())
            dump(path, {'/**': robot_parameters(found, robot, urdf)}, comment)
        print(f'wrote {path}')


def _listed(paths: Sequence[Path]) -> str:
    return ', '.join(map(str, paths))


def excite(options: Namespace) -> None:
    """Search for the reference, and write it as a preset."""
    make_room(options.out, force=options.force)
    config = load(locate(options.config), CONTROLLER, ControllerConfig)
    if config.model != 'urdf':
        raise BlfDscError(
            f'{options.config}: got model {config.model}, but a URDF is needed: set robot.urdf, '
            'or choose a preset with one, such as ur5e'
        )
    problem = ExcitationProblem(
        config, options.harmonics, options.radius, options.floor
    )
    parameters = problem.parameters(search(problem, 0, options.starts))
    for name in ('offset', 'amplitude'):
        parameters[name] = tuple(round(value, _DIGITS) for value in parameters[name])
    before = problem.evaluate(
        {name: getattr(config.reference, name) for name in parameters}
    )
    after = problem.evaluate(parameters)
    about = (
        'The reference that excites the learning most within the limits of joints and torque: a '
        f'window leaves {100.0 * after.left:.0f} % of the deviation of the prior, in the geometric '
        f'mean over all directions, instead of {100.0 * before.left:.0f} % with the configured '
        'reference. First the cosines, then the sines.'
    )
    lines = [*textwrap.wrap(about, _WIDTH), options.line]
    reference = {f'reference.{name}': value for name, value in parameters.items()}
    node = {f'**/{CONTROLLER}': {'reference.type': 'sinusoids', **reference}}
    dump(options.out, node, ''.join(f'# {line}\n' for line in lines))
    print('\n'.join([*lines, f'wrote {options.out}']))

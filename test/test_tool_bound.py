# SPDX-License-Identifier: Apache-2.0
"""A bound at the tool: joint bounds that keep it, and what is shown of its error."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from random_arm import chain_of
from recorded_run import compared

from blf_dsc_controller.analysis.metrics import measure
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.arms.two_link import urdf
from blf_dsc_controller.arms.urdf import frames, read_chain
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    dump,
    load,
    load_loop,
)
from blf_dsc_controller.configuration.schema import build, change, flatten
from blf_dsc_controller.configuration.tool_bound import certified, tool_of
from blf_dsc_controller.control.arm_controller import ArmController
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.factory.gains import law_gains
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.messages.topics import TOOL
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.simulation.loop import simulate, write_bag
from blf_dsc_controller.supervision.config_warnings import config_warnings
from blf_dsc_controller.supervision.expected_errors import expected_errors
from blf_dsc_controller.tool.errors import ANGLE, ANGLE_BOUND, BOUND, ERROR, Tool
from blf_dsc_controller.tool.postures import _angle, axes_of, ways_to_tip

TRAVEL = 2.5  # m, limit of the prismatic joints of random arms
ROUNDING = 1e-13  # m and rad, of placements


def preset(name, **controller):
    """Return the loop of a preset with a bound at the tool in place of its joint bounds."""
    given = {'barrier.bound': None, **controller}
    return load_loop(name, {CONTROLLER: given, PLANT: {'duration': 1.0}})


def arm(name):
    """Return the chain of a preset, of the paper's arm or of a random one."""
    if name == 'paper':
        text = urdf(('joint1', 'joint2'), (1.0, 0.8), (0.5, 0.5))
        return read_chain(text, '', 'tip', ())
    if name in ('fr3', 'openarm', 'widowx', 'yam'):
        config = load_loop(name).controller
        return config.robot.chain(config.joints)
    return chain_of(name)


def true_errors(chain, qr, errors):
    """Return error [m] and angle [rad] (m, 2) by the placements of the tip, and their log."""
    there, here = frames(chain, qr + errors)[-1], frames(chain, qr)[-1]
    off = np.linalg.norm(there[:, :3, 3] - here[:, :3, 3], axis=1)
    turned = np.swapaxes(here[:, :3, :3], 1, 2) @ there[:, :3, :3]
    sines = np.linalg.norm(turned - np.swapaxes(turned, 1, 2), axis=(1, 2)) / 8.0**0.5
    cosines = (np.trace(turned, axis1=1, axis2=2) - 1.0) / 2.0
    return np.stack((off, np.arctan2(sines, cosines)), axis=1)


def worst_errors(chain, q, k, random):
    """Return the largest error and angle (2,) found in the box |e| <= k about q (n,)."""
    n = q.size
    some = random.choice((-1.0, 1.0), (200, n))
    if n <= 7:
        some = np.array(list(product((-1.0, 1.0), repeat=n)))
    some = np.vstack((some, random.uniform(-1.0, 1.0, (100, n))))
    largest = np.zeros(2)
    for column in range(2):
        best = some
        for spread in (0.5, 0.2, 0.05):
            found = true_errors(chain, np.broadcast_to(q, best.shape), k * best)
            top = best[np.argsort(-found[:, column])[:10]]
            shifted = top + spread * random.normal(size=(10, *top.shape))
            best = np.vstack((top, np.clip(shifted.reshape(-1, n), -1.0, 1.0)))
        found = true_errors(chain, np.broadcast_to(q, best.shape), k * best)
        largest[column] = found[:, column].max()
    return largest


ARMS = ('panda', 'ur5e', 'fr3', 'paper', 'one', 'two', 'three', 'six', 'nine')


@pytest.mark.parametrize('size', [1e-3, 0.05])
@pytest.mark.parametrize('name', ARMS)
def test_no_error_in_the_box_moves_the_tool_past_its_bound(name, size):
    """Nine joints of all kinds among them, and errors far beyond the linear range."""
    chain = arm(name)
    n = len(chain.joints)
    random = np.random.default_rng(n)
    tool = Tool(chain, np.full(n, TRAVEL))
    for _ in range(5):
        q = random.uniform(-2.4, 2.4, n)
        k = size * random.uniform(0.1, 1.0, n)
        found = worst_errors(chain, q, k, random)
        here = tool.at_postures(q[np.newaxis], k)[0]
        everywhere = tool.everywhere(k)
        assert (found <= here + ROUNDING).all()
        assert (found <= everywhere + ROUNDING).all()
        if size < 0.01 and n <= 7:  # all corners were tried
            assert (here <= 1.02 * found + 1e-12).all()


@pytest.mark.parametrize('name', ['panda', 'six', 'nine'])
def test_errors_are_those_of_the_placements(name):
    chain = arm(name)
    n = len(chain.joints)
    random = np.random.default_rng(1)
    qr = random.uniform(-2.0, 2.0, (30, n))
    # up to half a turn
    errors = np.geomspace(1e-6, 1.0, 30)[:, np.newaxis] * random.normal(size=(30, n))
    tool = Tool(chain, np.full(n, TRAVEL))
    found = tool.errors(qr, errors, np.ones(n))
    true = true_errors(chain, qr, errors)
    np.testing.assert_allclose(found[:, ERROR], true[:, 0], rtol=1e-8, atol=1e-15)
    small = true[:, 1] < 2.0
    assert small.sum() > 20
    np.testing.assert_allclose(
        found[small, ANGLE], true[small, 1], rtol=1e-8, atol=1e-14
    )
    # one sample or many: the same bits
    rows = zip(qr, errors, strict=True)
    each = [tool.errors(*row, np.ones(n)) for row in rows]
    np.testing.assert_array_equal(found, each)


@pytest.mark.parametrize('name', ['panda', 'ur5e', 'fr3', 'openarm', 'widowx', 'yam'])
def test_bound_at_every_posture_is_tight(name):
    """Compare with the worst of many postures, which are not all: the true ratio is lower."""
    chain = arm(name)
    n = len(chain.joints)
    random = np.random.default_rng(3)
    tool = Tool(chain, np.zeros(n))
    lower = np.array([max(joint.lower, -np.pi) for joint in chain.joints])
    upper = np.array([min(joint.upper, np.pi) for joint in chain.joints])
    q = random.uniform(lower, upper, (20_000, n))
    for k in (np.full(n, 1e-5), random.uniform(1e-6, 1e-5, n)):
        worst = tool.at_postures(q, k).max(axis=0)
        assert (worst <= 1.01 * tool.everywhere(k)).all()  # but for their remainder
        assert (tool.everywhere(k) <= 1.3 * worst).all()


@pytest.mark.parametrize('turn', [0.0, 0.2, 1.5, 1.7, 3.0, np.pi])
def test_angle_of_two_lines_is_a_right_one_at_most(turn):
    """Axes have no sense of direction here: with an obtuse one the bound would be wider."""
    across = np.array([np.cos(turn), np.sin(turn), 0.0])
    found = _angle(np.array([1.0, 0.0, 0.0]), across)
    assert found == pytest.approx(min(turn, np.pi - turn), abs=1e-15)


@pytest.mark.parametrize('name', ['two', 'six', 'nine'])
def test_bound_grows_by_the_remainder_of_joint_errors(name):
    """By k^T C k / 2 and k^T T k / 2, where the linear part is twice as large for 2 k."""
    chain = arm(name)
    n = len(chain.joints)
    tool = Tool(chain, np.full(n, TRAVEL))
    random = np.random.default_rng(4)
    q, k = random.uniform(-2.0, 2.0, (2, n))
    k = 0.01 * np.abs(k)
    bounds = [tool.at_postures(q[np.newaxis], scale * k)[0] for scale in (1.0, 2.0)]
    remainder = 0.5 * (bounds[1] - 2.0 * bounds[0])
    links = tool._links
    expected = [0.5 * k @ C @ k for C in (links.curvature, links.turning)]
    np.testing.assert_allclose(remainder, expected, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize('name', ['two', 'six', 'nine'])
def test_tip_is_no_farther_from_an_axis_than_its_way(name):
    """Prismatic joints in between, at both ends of their travel."""
    chain = arm(name)
    n = len(chain.joints)
    axes = axes_of(chain, np.full(n, TRAVEL))
    random = np.random.default_rng(2)
    slides = random.choice((-TRAVEL, TRAVEL), (2000, n))
    q = np.where(axes.revolute, random.uniform(-np.pi, np.pi, (2000, n)), slides)
    placements = frames(chain, q)
    tip = placements[-1][:, :3, 3]
    ways = ways_to_tip(axes)
    for i in range(n):
        if not axes.revolute[i]:
            assert ways[i] == 0.0
            continue
        at = placements[1 + i]
        z = at[:, :3, :3] @ chain.joints[i].axis
        away = np.linalg.norm(np.cross(tip - at[:, :3, 3], z), axis=1)
        assert away.max() <= ways[i] + ROUNDING


def test_tones_of_a_reference_add_up_to_the_region_that_it_needs():
    """Joint bounds are the same whether a swing is one tone or the sum of two."""
    found = []
    for shares in ([1.0], [0.3, -0.7]):  # of 0.8 rad of each joint
        tones = len(shares)
        reference = {
            'reference.amplitude': (0.8 * np.tile(shares, 7)).tolist(),
            'reference.frequency': [1.0, 2.0][:tones],
            'reference.phase': [0.0] * tones,
        }
        loop = preset('panda', **{'barrier.tool_bound': 0.003}, **reference)
        found.append(loop.controller.barrier.bound)
    assert found[0] == found[1]


@pytest.mark.parametrize('name', ['panda_rigid', 'panda', 'ur5e', 'fr3'])
def test_joint_bounds_follow_from_the_bound_at_the_tool(name):
    loop = preset(name, **{'barrier.tool_bound': 0.003})
    config = loop.controller
    assert law_gains(config).initial_bound == config.barrier.bound
    position, angle = certified(config)
    assert 0.99 * 0.003 < position <= 0.003
    # along the reference, at most 1.51 times the worst there
    w = 2.0 * np.pi / 5.0
    reference = config.reference
    amplitude = np.reshape(reference.amplitude, (len(config.joints), -1))
    tones = np.arange(1, 4) * w
    t = np.linspace(0.0, 5.0, 200)
    angles = np.multiply.outer(t, tones) + reference.phase
    q = reference.offset + np.cos(angles) @ amplitude.T
    k = np.array(config.barrier.bound)
    tool = tool_of(config)
    assert position <= 1.51 * tool.at_postures(q, k)[:, 0].max()
    # what is to be expected uses about the same part of each that moves the tool
    alone = np.array([tool.everywhere(each)[0] for each in np.diag(k)])
    moves = alone > 0.051 * 0.003
    expected = sum(expected_errors(config, settings_of_config(config)))
    even = expected / np.array(load_loop(name).controller.barrier.bound)
    used = expected / k
    assert np.ptp(np.log(used[moves])) < 0.5 * np.ptp(np.log(even))
    # and less of the others, such as the last, whose axis goes through the tool
    assert used[~moves].max() < used[moves].min()
    assert used[-1] < 0.25 * used[moves].mean()

    for given in ({}, {'barrier.tool_bound': 0.003}):
        given['barrier.tool_angle_bound'] = angle / 2.0
        turned = certified(preset(name, **given).controller)
        assert turned[0] <= given.get('barrier.tool_bound', np.inf)
        assert 0.99 * angle / 2.0 < turned[1] <= angle / 2.0


def test_configuration_with_its_joint_bounds_can_be_read_again(tmp_path):
    config = preset('panda_rigid', **{'barrier.tool_bound': 0.003}).controller
    assert change(config, {}) == config
    dump(tmp_path / 'config.yaml', {CONTROLLER: config})
    assert load(tmp_path / 'config.yaml', CONTROLLER, ControllerConfig) == config
    halved = [each / 2.0 for each in config.barrier.bound]
    assert change(config, {'barrier.bound': halved}).barrier.tool_bound == 0.003
    with pytest.raises(ConfigurationError, match=r'within 0\.0059.* m only'):
        change(config, {'barrier.bound': [2.0 * each for each in config.barrier.bound]})


PANDA = {'robot.urdf': 'panda.urdf', 'robot.tip': 'panda_hand_tcp'}
POSITION = {'barrier.tool_bound': 0.001}
ON_ITS_AXIS = """<robot name="wheel"><link name="base"/>
  <link name="tip"><inertial><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="tip"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="80" velocity="5"/></joint>
</robot>"""
MISTAKES = {
    'negative': (
        PANDA | {'barrier.tool_bound': -0.001},
        'barrier.tool_bound: got -0.001, but it must be at least 0 m',
    ),
    'negative angle': (
        PANDA | {'barrier.tool_angle_bound': -0.1},
        'barrier.tool_angle_bound: got -0.1, but it must be at least 0 rad',
    ),
    'no number': (
        PANDA | {'barrier.tool_bound': float('nan')},
        'barrier.tool_bound: got .nan, but a finite number is needed',
    ),
    'a list': (
        PANDA | {'barrier.tool_bound': [0.001]},
        'barrier.tool_bound: got [0.001], but a double is expected',
    ),
    'no tip': (
        {'robot.urdf': 'panda.urdf', 'joints': [f'panda_joint{i}' for i in range(1, 8)]}
        | POSITION,
        'barrier.tool_bound: give robot.tip, the link whose origin is the tool',
    ),
    'no URDF': (
        POSITION,
        'barrier.tool_bound: model two_link has no tool: give robot.urdf and robot.tip',
    ),
    'joint bounds, too': (
        PANDA | POSITION | {'barrier.bound': [0.005] * 7},
        (
            'barrier.bound: these joint bounds keep the tool within 0.01332 m only, but '
            'barrier.tool_bound is 0.001 m: drop barrier.bound, which then follows from it, or '
            'drop barrier.tool_bound'
        ),
    ),
    'joint bounds, too, for the angle': (
        PANDA | {'barrier.tool_angle_bound': 0.01, 'barrier.bound': [0.005] * 7},
        (
            'barrier.bound: these joint bounds keep the tool within 0.025 rad only, but '
            'barrier.tool_angle_bound is 0.01 rad: drop barrier.bound, which then follows from '
            'it, or drop barrier.tool_angle_bound'
        ),
    ),
    'unmoved': (
        {'robot.urdf': ON_ITS_AXIS, 'robot.tip': 'tip', 'joints': ['turn']} | POSITION,
        'barrier.tool_bound: no joint moves tip, the tool: give another robot.tip',
    ),
    'unreachable': (
        PANDA | {'barrier.tool_bound': 1e-7},
        'rad, finer than any encoder: give at least',
    ),
    'no barrier': (
        PANDA | POSITION | {'law': 'slotine_li'},
        'barrier.tool_bound: the law slotine_li keeps no bound: choose blf_dsc, or remove',
    ),
}


@pytest.mark.parametrize('mistake', MISTAKES)
def test_mistakes_are_named_with_their_remedy(mistake):
    given, problem = MISTAKES[mistake]
    with pytest.raises(ConfigurationError) as caught:
        build(ControllerConfig, given)
    (found,) = caught.value.problems
    assert problem in found


def test_warnings_speak_of_the_bound_at_the_tool():
    """The rate cannot hold joint bounds this narrow; a wider one as said can."""
    tight = preset(
        'panda_rigid', **{'barrier.tool_bound': 0.0005, 'safety.error_ratio': 2.0}
    )
    share, friction, load = config_warnings(tight.controller)
    assert share.startswith('safety.error_ratio: the arm stops only 2 times past')
    assert friction.startswith('barrier.tool_bound: friction and unmodelled torque')
    assert load.startswith('barrier.tool_bound: when 2 kg')
    times = float(load.partition(' times this bound at the tool')[0].split()[-1])
    wide = preset('panda_rigid', **{'barrier.tool_bound': 0.0005 * times})
    assert config_warnings(wide.controller) == []


def test_page_shows_the_warning_of_the_preset_that_it_names():
    page = Path(__file__).resolve().parents[1] / 'doc' / 'tool_bound.md'
    shown = page.read_text(encoding='utf-8').partition('```text')[2].partition('```')[0]
    tight = preset('panda_rigid', **{'barrier.tool_bound': 0.001})
    assert ' '.join(shown.split()) in config_warnings(tight.controller)


@pytest.fixture(scope='module')
def tracked():
    """A Panda that tracks with its tool within 3 mm, once its bound has narrowed."""
    given = {
        'barrier.tool_bound': 0.003,
        'telemetry.decimation': 1,
    }
    loop = preset('panda_rigid', **given)
    return loop, simulate(loop.controller, loop.plant)


def test_run_shows_the_error_at_the_tool(tracked, tmp_path):
    loop, record = tracked
    write_bag(tmp_path / 'bag', record, loop.plant)
    run = read_run(tmp_path / 'bag')
    values = run.monitor.select(TOOL)
    assert values.shape == (run.stamp.size, 4)
    errors = run.position - run.reference
    chain = loop.controller.robot.chain(run.joints)
    true = true_errors(chain, run.reference, errors)
    np.testing.assert_allclose(values[:, :3:2], true, rtol=1e-6, atol=1e-12)
    assert (values[:, ERROR] < values[:, BOUND]).all()
    assert (values[:, ANGLE] < values[:, ANGLE_BOUND]).all()
    # the funnel narrows
    assert values[0, BOUND] > 1.5 * values[-1, BOUND]

    metrics = measure(run)
    assert metrics.tool['error'] == values[:, ERROR].max()
    assert metrics.tool == measure(record.run()).tool
    at = values[:, ERROR].argmax()
    text = f'tool        at most {1e3 * values[at, ERROR]:.3g} mm off, '
    text += f'{1e3 * values[at, BOUND]:.3g} mm certified there'
    assert text in format_table(metrics)
    titles = {panel.title for panel in panels([run])}
    assert {'error at the tool', 'angle at the tool'} <= titles

    result = verify(tmp_path / 'bag')
    assert (result.difference, result.remarks) == (None, ())
    assert compared(result)['monitor'] >= run.monitor.values[:, :-1].size


def test_stop_says_both_errors():
    given = {
        'barrier.tool_bound': 0.003,
        'torque.limit': [40.0, 40.0, 40.0, 12.0, 12.0, 12.0, 12.0],
        'safety.saturation_time': 10.0,
    }
    loop = preset('panda_rigid', **given)
    record = simulate(loop.controller, loop.plant)
    (stop,) = record.run().stops
    assert stop.reason == 'error past the bound'
    assert 'rad from its reference: past its bound of' in stop.text
    told = stop.text.partition('; the tool is ')[2]
    error, bound = (float(told.split(' mm')[k].split()[-1]) for k in (0, 1))
    assert 0.0 < error < bound < 3.0  # at one joint's bound, with room of the others


def test_library_has_the_same_bounds_and_errors(tracked):
    loop, record = tracked
    run = record.run()
    with ArmController(loop.controller) as controller:
        assert np.isfinite(controller.tool).all()
        for k in range(50):
            controller.update(
                1.0 + 1e-9 * record.stamps[k], *record.measurements[k].reshape(3, -1)
            )
        sample = (each[49] for each in (run.reference, run.error, run.bound))
        np.testing.assert_array_equal(controller.tool, run.tool(*sample))
    with ArmController('recommended') as controller:
        assert np.isnan(controller.tool).all()


def test_without_a_bound_at_the_tool_nothing_of_it_is_shown():
    config = load_loop('panda_rigid').controller
    assert tool_of(config) is None
    assert flatten(config)['barrier.bound'] == (0.005,) * 7

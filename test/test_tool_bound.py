# SPDX-License-Identifier: Apache-2.0
"""A bound at the tool: joint bounds that keep it, and what is shown of its error."""

from __future__ import annotations

import re
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
from random_arm import chain_of
from recorded_run import compared

import blf_dsc_controller as blf
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.arms.two_link import urdf
from blf_dsc_controller.arms.urdf import frames, read_chain
from blf_dsc_controller.configuration.nodes import (
    CONTROLLER,
    PLANT,
    dump,
    load,
)
from blf_dsc_controller.configuration.tool_bound import certified
from blf_dsc_controller.factory.gains import law_gains
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.messages.topics import TOOL
from blf_dsc_controller.simulation.loop import write_bag
from blf_dsc_controller.supervision.config_warnings import config_warnings
from blf_dsc_controller.supervision.expected_errors import expected_errors
from blf_dsc_controller.tool.errors import ANGLE, ANGLE_BOUND, BOUND, ERROR, Tool

TRAVEL = 2.5  # m, limit of the prismatic joints of random arms
ROUNDING = 1e-13  # m and rad, of placements


def preset(name, **controller):
    """Return the loop of a preset with a bound at the tool in place of its joint bounds."""
    given = {'barrier.bound': None, **controller}
    return blf.load_loop(name, {CONTROLLER: given, PLANT: {'duration': 1.0}})


def arm(name):
    """Return the chain of a preset, of the paper's arm or of a random one."""
    if name == 'paper':
        text = urdf(('joint1', 'joint2'), (1.0, 0.8), (0.5, 0.5))
        return read_chain(text, '', 'tip', ())
    if name in ('fr3', 'openarm', 'widowx', 'yam'):
        config = blf.load_loop(name).controller
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


def turns_of(here, there):
    """Return the rotation vectors (m, 3) [rad] between placements (m, 4, 4), below half a turn."""
    turned = np.swapaxes(here[:, :3, :3], 1, 2) @ there[:, :3, :3]
    skew = turned - np.swapaxes(turned, 1, 2)
    sines = 0.5 * np.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), axis=1)
    size = np.linalg.norm(sines, axis=1, keepdims=True)
    return sines * np.arcsin(size) / np.maximum(size, 1e-300)


@pytest.mark.parametrize('name', ['panda', 'six', 'nine'])
def test_what_two_joints_add_to_linear_errors_is_within_the_remainder(name):
    """The bound is a linear part, twice as large for 2 k, and a remainder, four times."""
    chain = arm(name)
    n = len(chain.joints)
    random = np.random.default_rng(4)
    tool = Tool(chain, np.full(n, TRAVEL))
    q = random.uniform(-2.4, 2.4, (20, n))
    closest = np.zeros(2)
    for pair in combinations(range(n), 2):
        k = np.zeros(n)
        k[list(pair)] = 0.02
        once, twice = (tool.at_postures(q, scale * k) for scale in (1.0, 2.0))
        remainder = 0.5 * (twice - 2.0 * once)
        here, *moved = (frames(chain, q + e * k)[-1] for e in (0.0, 1.0, 1e-3, -1e-3))
        off, ahead, back = (each[:, :3, 3] - here[:, :3, 3] for each in moved)
        turn, turned, returned = (turns_of(here, each) for each in moved)
        for column, (whole, more, less) in enumerate(
            ((off, ahead, back), (turn, turned, returned))
        ):
            left = np.linalg.norm(whole - 500.0 * (more - less), axis=1)
            assert (left <= 1.01 * remainder[:, column] + 1e-9).all()
            ratio = left.max() / max(remainder[:, column].max(), 1e-9)
            closest[column] = max(closest[column], ratio)
    assert (closest > 0.9).all()


REAL = ('panda', 'ur5e', 'fr3', 'openarm', 'widowx', 'yam')


@pytest.mark.parametrize('name', [*REAL, 'two', 'three', 'six', 'nine'])
def test_bound_at_every_posture_is_tight(name):
    """Compare with the worst of many postures, joints that slide at both of their ends."""
    chain = arm(name)
    n = len(chain.joints)
    random = np.random.default_rng(3)
    tool = Tool(chain, np.full(n, TRAVEL))
    slides = np.array([joint.kind == 'prismatic' for joint in chain.joints])
    lower, upper = np.full(n, -np.pi), np.full(n, np.pi)
    if name in REAL:
        lower = np.maximum(lower, [joint.lower for joint in chain.joints])
        upper = np.minimum(upper, [joint.upper for joint in chain.joints])
    q = random.uniform(lower, upper, (20_000, n))
    q[:, slides] = TRAVEL * np.sign(q[:, slides])
    for k in (np.full(n, 1e-5), random.uniform(1e-6, 1e-5, n)):
        worst = tool.at_postures(q, k).max(axis=0)
        everywhere = tool.everywhere(k)
        assert (worst <= 1.01 * everywhere).all()  # but for their remainder
        assert (everywhere <= np.array((1.2, 1.05)) * worst).all()


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
    config = preset(name, **{'barrier.tool_bound': 0.003}).controller
    assert law_gains(config).initial_bound == config.barrier.bound
    position, angle = certified(config)
    assert 0.99 * 0.003 < position <= 0.003
    # what is to be expected uses about the same part of each that moves the tool
    k = np.array(config.barrier.bound)
    tool = Tool(config.robot.chain(config.joints), np.zeros(k.size))
    moves = np.array([tool.everywhere(each)[0] for each in np.diag(k)]) > 0.051 * 0.003
    expected = sum(expected_errors(config, settings_of_config(config)))
    even = expected / np.array(blf.load_loop(name).controller.barrier.bound)
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
    assert blf.change(config, {}) == config
    dump(tmp_path / 'config.yaml', {CONTROLLER: config})
    assert load(tmp_path / 'config.yaml', CONTROLLER, blf.ControllerConfig) == config
    halved = [each / 2.0 for each in config.barrier.bound]
    assert blf.change(config, {'barrier.bound': halved}).barrier.tool_bound == 0.003
    with pytest.raises(blf.ConfigurationError, match=r'within 0\.0059.* m only'):
        blf.change(
            config, {'barrier.bound': [2.0 * each for each in config.barrier.bound]}
        )


def test_page_shows_the_warning_of_the_preset_that_it_names():
    """A bound as many times as wide as the warning says has none."""
    page = Path(__file__).resolve().parents[1] / 'doc' / 'tool_bound.md'
    shown = page.read_text(encoding='utf-8').partition('```text')[2].partition('```')[0]
    tight = preset('panda_rigid', **{'barrier.tool_bound': 0.001})
    warning = ' '.join(shown.split())
    assert warning in config_warnings(tight.controller)
    times = float(re.search(r'give (\S+) times this bound', warning)[1])
    wide = preset('panda_rigid', **{'barrier.tool_bound': 0.001 * times})
    assert config_warnings(wide.controller) == []


@pytest.fixture(scope='module')
def tracked():
    """A Panda that tracks with its tool within 3 mm, once its bound has narrowed."""
    given = {
        'barrier.tool_bound': 0.003,
        'telemetry.decimation': 1,
    }
    loop = preset('panda_rigid', **given)
    return loop, blf.simulate(loop.controller, loop.plant)


def test_run_shows_the_error_at_the_tool(tracked, tmp_path):
    loop, record = tracked
    write_bag(tmp_path / 'bag', record, loop.plant)
    run = blf.read_run(tmp_path / 'bag')
    values = run.monitor.select(TOOL)
    assert values.shape == (run.stamp.size, 4)
    errors = run.position - run.reference
    chain = loop.controller.robot.chain(run.joints)
    true = true_errors(chain, run.reference, errors)
    np.testing.assert_allclose(values[:, :3:2], true, rtol=1e-6, atol=1e-12)
    assert (values[:, ERROR] < values[:, BOUND]).all()
    assert (values[:, ANGLE] < values[:, ANGLE_BOUND]).all()

    metrics = blf.measure(run)
    assert metrics.tool['error'] == values[:, ERROR].max()
    assert metrics.tool == blf.measure(record.run()).tool
    at = values[:, ERROR].argmax()
    text = f'tool        at most {1e3 * values[at, ERROR]:.3g} mm off, '
    text += f'{1e3 * values[at, BOUND]:.3g} mm certified there'
    assert text in format_table(metrics)
    titles = {panel.title for panel in panels([run])}
    assert {'error at the tool', 'angle at the tool'} <= titles

    result = blf.verify(tmp_path / 'bag')
    assert (result.difference, result.remarks) == (None, ())
    assert compared(result)['monitor'] >= run.monitor.values[:, :-1].size


def test_stop_says_both_errors():
    given = {
        'barrier.tool_bound': 0.003,
        'torque.limit': [40.0, 40.0, 40.0, 12.0, 12.0, 12.0, 12.0],
        'safety.saturation_time': 10.0,
    }
    loop = preset('panda_rigid', **given)
    record = blf.simulate(loop.controller, loop.plant)
    (stop,) = record.run().stops
    assert stop.reason == 'error past the bound'
    assert 'rad from its reference: past its bound of' in stop.text
    told = stop.text.partition('; the tool is ')[2]
    error, bound = (float(told.split(' mm')[k].split()[-1]) for k in (0, 1))
    assert 0.0 < error < bound < 3.0  # at one joint's bound, with room of the others


def test_library_has_the_same_bounds_and_errors(tracked):
    loop, record = tracked
    run = record.run()
    with blf.ArmController(loop.controller) as controller:
        assert np.isfinite(controller.tool).all()
        for k in range(50):
            controller.update(
                1.0 + 1e-9 * record.stamps[k], *record.measurements[k].reshape(3, -1)
            )
        sample = (each[49] for each in (run.reference, run.error, run.bound))
        np.testing.assert_array_equal(controller.tool, run.tool(*sample))
    with blf.ArmController('recommended') as controller:
        assert np.isnan(controller.tool).all()

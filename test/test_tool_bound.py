# SPDX-License-Identifier: Apache-2.0
"""A bound at the tool: joint bounds that keep it, and what is shown of its error."""

from __future__ import annotations

import re
from itertools import product
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
from blf_dsc_controller.factory.settings import settings_of_config
from blf_dsc_controller.simulation.loop import write_bag
from blf_dsc_controller.tool.errors import Tool
from blf_dsc_controller.warnings.expected_errors import expected_errors
from blf_dsc_controller.warnings.table import config_warnings

TRAVEL = 2.5  # m, limit of the prismatic joints of random arms
ROUNDING = 1e-13  # m and rad, of placements


def preset(name, **controller):
    """Return the loop of a preset with a bound at the tool in place of its joint bounds."""
    given = {'barrier.bound': None, **controller}
    return blf.load_loop(
        name, {'blf_dsc_controller': given, 'sim_plant': {'duration': 1.0}}
    )


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


@pytest.mark.parametrize('name', ['panda_rigid', 'panda', 'ur5e', 'fr3'])
def test_joint_bounds_follow_from_the_bound_at_the_tool(name):
    """All of it; what is to be expected uses about the same part of each that moves the tool."""
    config = preset(name, **{'barrier.tool_bound': 0.003}).controller
    k = np.array(config.barrier.bound)
    tool = Tool(config.robot.chain(config.joints), np.zeros(k.size))
    position, angle = tool.everywhere(k)
    assert 0.99 * 0.003 < position <= 0.003 * (1.0 + ROUNDING)
    expected = sum(expected_errors(config, settings_of_config(config)))
    even = expected / np.array(blf.load_loop(name).controller.barrier.bound)
    used = expected / k
    moves = np.array([tool.everywhere(each)[0] for each in np.diag(k)]) > 0.051 * 0.003
    assert np.ptp(np.log(used[moves])) < 0.5 * np.ptp(np.log(even))
    # and less of the others, such as the last, whose axis goes through the tool
    assert used[~moves].max() < used[moves].min()
    for given in ({}, {'barrier.tool_bound': 0.003}):
        given['barrier.tool_angle_bound'] = angle / 2.0
        bound = preset(name, **given).controller.barrier.bound
        turned = tool.everywhere(np.array(bound))
        assert turned[0] <= given.get('barrier.tool_bound', np.inf) + ROUNDING
        assert 0.99 * angle / 2.0 < turned[1] <= angle / 2.0 + ROUNDING


def test_bounds_of_joints_that_slide_add_up_at_the_tool(tmp_path):
    """Of a gantry, whose axes are at right angles."""
    links = ('base', 'bridge', 'tip')
    inertia = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    body = f'<inertial><mass value="2"/>{inertia}</inertial>'
    text = ''.join(f'<link name="{name}">{body}</link>' for name in links)
    for parent, child, axis in (
        ('base', 'bridge', '1 0 0'),
        ('bridge', 'tip', '0 1 0'),
    ):
        text += (
            f'<joint name="to_{child}" type="prismatic"><parent link="{parent}"/>'
            f'<child link="{child}"/><axis xyz="{axis}"/>'
            '<limit lower="-1" upper="1" effort="40" velocity="1"/></joint>'
        )
    (tmp_path / 'gantry.urdf').write_text(f'<robot name="gantry">{text}</robot>')
    (tmp_path / 'my.yaml').write_text(
        '/**: {ros__parameters: {robot: {urdf: gantry.urdf, tip: tip}}}\n'
        '/**/blf_dsc_controller: {ros__parameters: {barrier: {tool_bound: 0.003}}}\n'
    )
    bounds = blf.load_loop(tmp_path / 'my.yaml').controller.barrier.bound
    assert 0.7 * 0.003 < np.hypot(*bounds) <= 0.003


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
    values = run.monitor.select(
        [f'tool_{each}' for each in ('error', 'bound', 'angle', 'angle_bound')]
    )
    errors = run.position - run.reference
    chain = loop.controller.robot.chain(run.joints)
    true = true_errors(chain, run.reference, errors)
    np.testing.assert_allclose(values[:, ::2], true, rtol=1e-6, atol=1e-12)
    assert (values[:, ::2] < values[:, 1::2]).all()

    at = values[:, 0].argmax()
    text = f'tool        at most {1e3 * values[at, 0]:.3g} mm off, '
    text += f'{1e3 * values[at, 1]:.3g} mm certified there'
    assert text in format_table(blf.measure(run))
    turned = values[:, 2].argmax()
    told = blf.measure(run).tool
    assert (told['angle'], told['angle_bound']) == pytest.approx(values[turned, 2:])
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

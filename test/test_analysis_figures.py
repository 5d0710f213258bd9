# SPDX-License-Identifier: Apache-2.0
"""The figures show every panel of the run and keep its peaks."""

from __future__ import annotations

import dataclasses

import matplotlib.image
import numpy as np
import pytest
import synthetic_bag
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import pyplot as plt
from matplotlib import rcParams
from matplotlib.colors import to_hex, to_rgb
from synthetic_bag import Synthetic

from blf_dsc_controller.analysis import figures
from blf_dsc_controller.analysis.figures import draw
from blf_dsc_controller.analysis.panels import COLOURS, envelope, panels
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.simulation.loop import simulate


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    messages = Synthetic(5000).messages()
    return read_run(synthetic_bag.write(tmp_path_factory.mktemp('made') / 'bag', messages))


def pixels(path):
    return matplotlib.image.imread(path)[..., :3]


def amount(image, colour):
    """Number of pixels close to this colour."""
    target = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return int((np.abs(image - target).max(axis=2) < 0.08).sum())


def lightened(colour, opacity=0.75):
    """Colour of a line with this opacity on white."""
    return to_hex(np.array(to_rgb(colour)) * opacity + 1.0 - opacity)


def test_a_change_of_the_arm_is_drawn_from_close_by(tmp_path):
    event = {'events.begin': (1.0,), 'events.duration': (0.0,), 'events.payload': (0.25,)}
    loop = load_loop('recommended', {'sim_plant': {'duration': 4.0, **event}})
    drawn = draw(simulate(loop.controller, loop.plant).run(), tmp_path)
    assert [path.name for path in drawn[:2]] == ['tracking.png', 'change.png']
    image = pixels(tmp_path / 'change.png')
    assert amount(image, '#DCE9F5') > 100_000  # the bound
    for colour in COLOURS[:2]:  # error and torque of two joints
        assert amount(image, colour) > 500


def test_draw_writes_both_figures_and_leaves_no_trace(run, tmp_path):
    before = dict(rcParams)
    assert draw(run, tmp_path) == [tmp_path / 'tracking.png', tmp_path / 'parameters.png']
    assert (dict(rcParams), plt.get_fignums()) == (before, [])  # no changed settings
    tracking = pixels(tmp_path / 'tracking.png')
    parameters = pixels(tmp_path / 'parameters.png')
    # Wide enough for readable labels on a page.
    assert tracking.shape[1] > 1200
    assert parameters.shape[1] > 1200
    # The shaded bound, the error and the torque; the estimates and the disturbances.
    assert amount(tracking, '#DCE9F5') > 100_000
    assert amount(tracking, '#0072B2') > 1000
    assert amount(tracking, '#D55E00') > 1000
    for colour in COLOURS[:2]:
        assert amount(parameters, lightened(colour, 0.6)) > 500


def test_violation_is_marked_and_errors_stay_visible_beside_the_wide_start_of_a_funnel(
    run, tmp_path
):
    error = run.error.copy()
    error[2000, 1] = 0.003
    widening = np.linspace(20.0, 1.0, len(run.bound))[:, None]
    amounts = []
    for changes in ({}, {'error': error}, {'bound': run.bound * widening}):
        draw(dataclasses.replace(run, **changes), tmp_path)
        image = pixels(tmp_path / 'tracking.png')
        amounts.append([amount(image, colour) for colour in ('#B3001B', '#0072B2')])
    (none, blue), (red, _), (_, beside) = amounts
    assert (none, red > 100) == (0, True)
    assert beside > 0.8 * blue


def test_missing_series_and_a_single_sample_are_drawn(run, tmp_path):
    draw(run, tmp_path)
    height = pixels(tmp_path / 'tracking.png').shape[0]
    unknown_torque = np.full_like(run.torque, np.nan)
    partial = dataclasses.replace(run, error=None, truth=None, torque=unknown_torque)
    assert len(draw(partial, tmp_path)) == 2
    assert pixels(tmp_path / 'tracking.png').shape[0] < height / 2
    minimal = dataclasses.replace(partial, reference=None, bound=None, monitor=None)
    assert draw(minimal, tmp_path / 'alone') == [tmp_path / 'alone' / 'tracking.png']
    assert not (tmp_path / 'alone' / 'parameters.png').exists()
    arrays = ('stamp', 'received', 'position', 'velocity', 'torque', 'reference', 'error', 'bound')
    one = {name: getattr(run, name)[:1] for name in (*arrays, 'torque_limit')}
    assert draw(dataclasses.replace(run, **one), tmp_path)


def test_logarithmic_error_panel_shows_small_and_large_errors(run):
    error = 1e-6 * np.ones_like(run.error)
    error[700, 1] = 0.0015
    found = panels([dataclasses.replace(run, error=error)])
    (panel,) = (panel for panel in found if panel.title == '|error| of elbow')
    magnitude, bound = panel.lines
    assert panel.log
    assert (magnitude.values.max(), magnitude.time[magnitude.values.argmax()]) == (
        1.5,
        pytest.approx(0.7, abs=0.02),
    )
    assert magnitude.values.min() == pytest.approx(1e-3)  # mrad
    assert set(bound.values) == {2.0}


def test_panels_are_drawn_once(run, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, 'draw_panels', lambda _p, _t, shown, *_, **__: drawn.extend(shown))
    draw(run, tmp_path)
    titles = [panel.title for panel in drawn]
    assert len(titles) == len({*titles})
    assert {'|error| of shoulder', 'minimum eigenvalue of Φ', 'relative parameter error'} <= {
        *titles
    }


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('level', [0.0001, np.nan])
def test_constant_series_on_a_logarithmic_axis_is_drawn(run, tmp_path, level):
    learning = run.monitor
    values = learning.values.copy()
    values[:, learning.names.index('lambda_min')] = level
    values[-1, learning.names.index('lambda_min')] *= 1.0 - 6e-16
    unknown = dataclasses.replace(run, monitor=dataclasses.replace(learning, values=values))
    assert tmp_path / 'parameters.png' in draw(unknown, tmp_path)


@given(st.integers(1, 400), st.integers(1, 50), st.randoms(use_true_random=False))
def test_envelope_keeps_the_extremes_of_every_piece(size, pieces, random):
    values = np.array([random.choice([random.gauss(0, 1), np.nan]) for _ in range(size)])
    time = np.arange(size) * 0.5
    thin_time, thin = envelope(time, values, pieces)
    assert thin.size <= max(2 * pieces, size if size <= 2 * pieces else 0)
    kept = (thin_time / 0.5).astype(int)
    assert np.all(np.diff(kept) >= 0)
    np.testing.assert_array_equal(thin, values[kept])
    for piece in np.split(np.arange(size), range(0, size, -(-size // pieces))[1:]):
        known = values[piece][~np.isnan(values[piece])]
        remaining = thin[np.isin(kept, piece)]
        if known.size:
            assert np.nanmax(remaining) == known.max()
            assert np.nanmin(remaining) == known.min()

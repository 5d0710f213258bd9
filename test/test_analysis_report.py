# SPDX-License-Identifier: Apache-2.0
"""Pictures and page show every panel of a run, keep its peaks, and mark its events."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest
import recorded_run
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import pyplot as plt
from matplotlib import rcParams
from matplotlib.colors import to_hex, to_rgb
from recorded_run import JOINTS, MILLISECOND, START, Synthetic

from blf_dsc_controller.analysis import figures
from blf_dsc_controller.analysis.figures import draw
from blf_dsc_controller.analysis.metrics import measure
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.analysis.panels import (
    _AXIS_MARGIN,
    ALARM,
    COLOURS,
    _span,
    _torque,
    envelope,
    panels,
)
from blf_dsc_controller.analysis.report import plots, read_bag, write_report
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.nodes import load_loop
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.messages.topics import (
    CHANGES,
    DIAGNOSTICS,
    JOINT_STATES,
    JOURNAL,
    MONITOR,
    REFERENCE,
    TRACKING_ERROR,
)
from blf_dsc_controller.simulation.loop import simulate
from blf_dsc_controller.supervision.supervisor import Reason

pytest.importorskip('plotly', reason='needs plotly: pip install .[report]')


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    messages = Synthetic(5000).messages()
    return read_run(
        recorded_run.write_made(tmp_path_factory.mktemp('made') / 'bag', messages)
    )


@pytest.fixture(scope='module')
def drawn(run, tmp_path_factory):
    """The folder of the run's pictures, and what matplotlib's settings were before."""
    folder = tmp_path_factory.mktemp('drawn')
    before = dict(rcParams)
    assert draw(run, folder) == [folder / 'tracking.png', folder / 'parameters.png']
    return folder, before


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
    event = {
        'events.begin': (1.0,),
        'events.duration': (0.0,),
        'events.payload': (0.25,),
    }
    loop = load_loop('recommended', {'sim_plant': {'duration': 4.0, **event}})
    drawn = draw(simulate(loop.controller, loop.plant).run(), str(tmp_path))
    assert [path.name for path in drawn[:2]] == ['tracking.png', 'change.png']
    image = pixels(tmp_path / 'change.png')
    assert amount(image, '#DCE9F5') > 100_000  # the bound
    for colour in COLOURS[:2]:  # error and torque of two joints
        assert amount(image, colour) > 500


def test_draw_writes_both_figures_and_leaves_no_trace(drawn):
    folder, before = drawn
    assert (dict(rcParams), plt.get_fignums()) == (before, [])  # no changed settings
    tracking = pixels(folder / 'tracking.png')
    parameters = pixels(folder / 'parameters.png')
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
    run, drawn, tmp_path
):
    error = run.error.copy()
    error[2000, 1] = 0.003
    widening = np.linspace(20.0, 1.0, len(run.bound))[:, None]
    folders = [drawn[0]]
    for changes in ({'error': error}, {'bound': run.bound * widening}):
        folders.append(tmp_path / next(iter(changes)))
        # without what else would be drawn
        draw(replace(run, monitor=None, **changes), folders[-1])
    (none, blue), (red, _), (_, beside) = (
        [amount(image, colour) for colour in ('#B3001B', '#0072B2')]
        for image in (pixels(folder / 'tracking.png') for folder in folders)
    )
    assert (none, red > 100) == (0, True)
    assert beside > 0.8 * blue


@pytest.mark.parametrize(
    ('errors', 'largest'),
    [
        ([0.1, -0.4], 2.0),
        ([0.1, -4.0], 4.0),
        ([3.0, -1e101], 3.0),
        ([np.nan, 1e101], 2.0),
    ],
)
def test_axis_of_a_funnel_has_room_for_its_errors_but_not_for_absurd_ones(
    errors, largest
):
    """Of either sign, in mrad; its bound narrows from 9 mrad to 2 mrad."""
    span = _span(np.array([9e-3, 2e-3]), np.array(errors))
    assert span == pytest.approx(_AXIS_MARGIN * largest)
    assert _span(np.array([2e-3, 2e-3]), np.array(errors)) == 0.0


@pytest.mark.parametrize(
    ('limit', 'names'),
    [
        (None, ['torque']),
        ([np.nan, np.nan], ['torque']),
        ([9.0, np.nan], ['torque', 'limit']),
    ],
)
def test_torque_is_drawn_with_its_limit_if_that_is_known(limit, names):
    columns = {'torque': np.array([1.0, -3.0]), 'torque_limit': limit}
    run = SimpleNamespace(
        joints=('a',),
        column=lambda name, _: columns[name],
        units=lambda _: SimpleNamespace(torque='N m'),
    )
    (panel,) = _torque(run, np.arange(2.0), 0)
    assert [line.name for line in panel.lines] == names
    assert panel.note == 'peak 3'


def test_missing_series_and_a_single_sample_are_drawn(run, drawn, tmp_path):
    height = pixels(drawn[0] / 'tracking.png').shape[0]
    unknown_torque = np.full_like(run.torque, np.nan)
    partial = replace(run, error=None, truth=None, torque=unknown_torque)
    assert len(draw(partial, tmp_path)) == 2
    assert pixels(tmp_path / 'tracking.png').shape[0] < height / 2
    minimal = replace(partial, reference=None, bound=None, monitor=None)
    assert draw(minimal, tmp_path / 'alone') == [tmp_path / 'alone' / 'tracking.png']
    assert not (tmp_path / 'alone' / 'parameters.png').exists()
    arrays = (
        'stamp',
        'received',
        'position',
        'velocity',
        'torque',
        'reference',
        'error',
        'bound',
    )
    one = {name: getattr(run, name)[:1] for name in (*arrays, 'torque_limit')}
    assert draw(replace(run, **one), tmp_path)


def test_logarithmic_error_panel_shows_small_and_large_errors(run):
    error = 1e-6 * np.ones_like(run.error)
    error[700, 1] = 0.0015
    found = panels([replace(run, error=error)])
    (panel,) = (panel for panel in found if panel.title == '|error| of elbow')
    magnitude, bound = panel.lines
    assert panel.log
    assert (magnitude.values.max(), magnitude.time[magnitude.values.argmax()]) == (
        1.5,
        pytest.approx(0.7, abs=0.02),
    )
    assert magnitude.values.min() == pytest.approx(1e-3)  # mrad
    assert set(bound.values) == {2.0}


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('level', [0.0001, np.nan])
def test_constant_series_on_a_logarithmic_axis_is_drawn(
    run, tmp_path, level, monkeypatch
):
    monkeypatch.setattr(figures, '_draw_motion', lambda *_: None)
    learning = run.monitor
    values = learning.values.copy()
    values[:, learning.names.index('lambda_min')] = level
    values[-1, learning.names.index('lambda_min')] *= 1.0 - 6e-16
    unknown = replace(run, monitor=replace(learning, values=values))
    assert tmp_path / 'parameters.png' in draw(unknown, tmp_path)


@given(st.integers(1, 400), st.integers(1, 50), st.randoms(use_true_random=False))
def test_envelope_keeps_the_extremes_of_every_piece(size, pieces, random):
    values = np.array(
        [random.choice([random.gauss(0, 1), np.nan]) for _ in range(size)]
    )
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


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags')
    recorded_run.record(path / 'one')
    recorded_run.record(path / 'other', **{'feedback.gain': [30.0, 10.0]})
    synthetic = Synthetic(4000)
    synthetic.error[1234, 0] = -0.005  # one sample far outside
    synthetic.torque[2000:2010, 1] = 20.0  # ten samples at the limit
    synthetic.torque[3996:, 1] = -20.0  # and the last four
    data = json.dumps(
        {'stamp': START + 2_500_000_000, 'parameters': {'load.torque': [1.0, 0.0]}}
    )
    message = typestore().types[CHANGES.type](data=data)
    change = (CHANGES, START, bytes(typestore().serialize_cdr(message, CHANGES.type)))
    recorded_run.write_made(
        path / 'synthetic', [*synthetic.messages(with_timing=True), change]
    )
    return path


def by_title(bags):
    return {
        plot['title']: plot for plot in plots(panels([bag.run for bag in bags]), bags)
    }


def test_every_quantity_has_a_panel(folder, run, tmp_path, monkeypatch):
    titles = set(by_title([read_bag(folder / 'synthetic')]))
    expected = {
        f'{quantity} of {joint}'
        for quantity in ('error', '|error|', 'position', 'torque')
        for joint in JOINTS
    }
    expected |= {'(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2', 'relative parameter error'}
    expected |= {'minimum eigenvalue of Φ', 'disturbance estimates'}
    assert titles == expected
    drawn = []  # in the pictures, each once
    monkeypatch.setattr(
        figures, 'draw_panels', lambda _p, _t, shown, *_, **__: drawn.extend(shown)
    )
    draw(run, tmp_path)
    assert sorted(panel.title for panel in drawn) == sorted(expected)


def test_peak_of_one_sample_survives_thinning(folder):
    panel = by_title([read_bag(folder / 'synthetic')])['error of shoulder']
    error, bound, _ = panel['traces']
    k = int(np.argmin(error['y']))
    assert (error['x'][k], error['y'][k]) == (1.234, -5.0)
    assert len(error['x']) <= 3000
    assert set(bound['y']) == {2.0}


def test_events_list_violation_latch_saturation_and_plant_change(folder):
    bag = read_bag(folder / 'synthetic')
    events = {(kind, round(time, 3)): text for time, kind, text in bag.events}
    assert events == {
        ('violation', 1.234): 'shoulder outside its bound for 1 samples',
        ('learning', 1.5): 'first excited window: learning began',
        ('saturation', 2.0): 'elbow at its torque limit for 10 samples',
        ('saturation', 3.996): 'elbow at its torque limit for 4 samples',
        ('plant', 2.5): 'load.torque: [1.0, 0.0]',
    }


def diagnosed(at, level, message):
    """Return a message of diagnostics `at` [ns]."""
    types = typestore().types
    status = types['diagnostic_msgs/msg/DiagnosticStatus'](
        level=level, name='state', message=message, hardware_id='', values=[]
    )
    stamp = types['builtin_interfaces/msg/Time'](sec=0, nanosec=0)
    header = types['std_msgs/msg/Header'](stamp=stamp, frame_id='')
    array = types[DIAGNOSTICS.type](header=header, status=[status])
    raw = typestore().serialize_cdr(array, DIAGNOSTICS.type)
    return DIAGNOSTICS, at, bytes(raw)


def test_waiting_before_the_first_sample_is_no_event_but_an_error_is(tmp_path):
    before, after = START - 1_000_000, START + 500_000_000
    messages = [
        diagnosed(before, 1, 'waiting for a joint state'),
        diagnosed(before, 2, 'start rejected'),
        *Synthetic(1000).messages(),
        diagnosed(after, 1, 'half of the states are late'),
    ]
    bag = read_bag(recorded_run.write_made(tmp_path / 'bag', messages))
    told = [
        (round(t, 2), kind, text)
        for t, kind, text in bag.events
        if kind in ('WARN', 'ERROR')
    ]
    assert told == [
        (0.0, 'ERROR', 'state: start rejected'),
        (0.5, 'WARN', 'state: half of the states are late'),
    ]


def test_several_bags_are_overlaid_and_their_parameter_differences_listed(
    folder, tmp_path
):
    bags = [read_bag(folder / 'one'), read_bag(folder / 'other')]
    panel = by_title(bags)['error of joint1']
    names = [trace['name'] for trace in panel['traces']]
    one, other = (bag.name for bag in bags)
    assert names == [
        f'{bag}: {line}' for bag in (one, other) for line in ('error', *['bound'] * 2)
    ]
    assert panel['traces'][0]['line']['color'] != panel['traces'][3]['line']['color']
    shown = [trace['name'] for trace in panel['traces'] if trace['showlegend']]
    assert (one, other) == (f'{folder.name}/one', f'{folder.name}/other')
    # what they share, once
    assert shown == [f'{one}: error', f'{one}: bound', f'{other}: error']
    write_report(bags, tmp_path / 'page.html')
    text = (tmp_path / 'page.html').read_text()
    assert '<p>1 parameters differ.</p>' in text
    row = 'blf_dsc_controller: feedback.gain</td><td>[60.0, 20.0]</td><td>[30.0, 10.0]</td>'
    assert row in text


def test_page_is_self_contained_and_escapes_names(tmp_path, monkeypatch):
    nasty = '</script><b>&{{data}}'
    monkeypatch.setattr(recorded_run, 'JOINTS', ('<!--<script>', nasty))
    bag = read_bag(recorded_run.write_made(tmp_path / 'bag', Synthetic(200).messages()))
    write_report([replace(bag, name=nasty)], tmp_path / 'page.html')
    text = (tmp_path / 'page.html').read_text()
    # without plotly's own script
    own = text.split('<script>')[0] + text.rsplit('<script>', 1)[1]
    assert not re.search(r'(?:src|href)="(?!#|data:)|https?:', own)
    embedded = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1]
    titles = {panel['title'] for panel in json.loads(embedded)['panels']}
    assert {'position of <!--<script>', f'position of {nasty}'} <= titles
    assert '<' not in embedded
    assert nasty not in text
    assert '<b>' not in own


def test_joint_states_alone_suffice_for_a_page(tmp_path, capsys):
    states = [entry for entry in Synthetic(500).messages() if entry[0] is JOINT_STATES]
    recorded_run.write_made(tmp_path / 'bag', states)
    assert (
        main(['report', str(tmp_path / 'bag'), '--out', str(tmp_path / 'page.html')])
        == 0
    )
    assert 'not recorded in the bag' in (tmp_path / 'page.html').read_text()
    assert (
        main(
            ['report', str(tmp_path / 'nowhere'), '--out', str(tmp_path / 'none.html')]
        )
        == 1
    )
    assert capsys.readouterr().err.startswith('blf_dsc report: ')
    assert not (tmp_path / 'none.html').exists()


@pytest.mark.parametrize('value', [np.nan, np.inf, -1e308])
def test_absurd_numbers_and_characters_missing_from_the_font_cause_no_warning(
    tmp_path, value, monkeypatch, capfd
):
    """Warnings are errors here: numpy's and matplotlib's would be seen beside the page."""
    monkeypatch.setattr(recorded_run, 'JOINTS', ('关节', 'elbow'))
    made = Synthetic(400)
    made.position[50, 0] = made.error[100, 1] = made.reference[70, 0] = value
    made.error[200:, 0] = made.torque[:, 1] = made.estimate[:, 1] = value
    made.disturbance[100:, 0] = made.latched[:] = value
    bag = str(
        recorded_run.write_made(tmp_path / 'bag', made.messages(with_timing=True))
    )
    for command, option, out in (
        ('report', '--out', 'page.html'),
        ('report', '--png', 'plots'),
        ('export', '--out', 'table.csv'),
    ):
        assert main([command, bag, option, str(tmp_path / out)]) == 0
    out, errors = capfd.readouterr()
    assert errors == ''
    assert ('VIOLATED, first by elbow at 0.100 s' in out) is not np.isnan(value)


# A safe stop, with its reason and time. The sample that causes it is published without
# its error: only the journal has the cause.

STOP_S = 2.345
LATE = 40 * MILLISECOND  # from the stamp of a message to its reception


def stopped(folder, reason=Reason.OUTSIDE_BOUND):
    """Bag of a run whose controller stops at `STOP_S`.

    Its messages are received late.
    """
    stop = START + round(STOP_S * 1e3) * MILLISECOND
    text = (
        "joint 'elbow' is +0.0023 rad from its reference: past its bound of 0.002 rad"
    )
    event = Event(2, EventType.STOP, stop, 1, 1, {'reason': reason, 'text': text})
    messages = [
        (topic, stamp + LATE, raw)
        for topic, stamp, raw in Synthetic(4000).messages()
        if topic not in (TRACKING_ERROR, REFERENCE, MONITOR) or stamp < stop
    ]
    messages.append((JOURNAL, stop + 2 * LATE, event.encode()))
    return recorded_run.write_made(
        folder / 'bag', sorted(messages, key=lambda entry: entry[1])
    )


@pytest.mark.parametrize(
    ('reason', 'held', 'violated', 'bound'),
    [
        (Reason.OUTSIDE_BOUND, False, STOP_S, 'VIOLATED, first by elbow at 2.345 s'),
        (Reason.VELOCITY, True, np.nan, 'held by every joint until the stop'),
    ],
)
def test_stop_outside_the_bound_is_a_violation_at_the_stamp_of_the_last_state(
    tmp_path, reason, held, violated, bound
):
    """A stop for another reason keeps the bound held until then."""
    run = read_run(stopped(tmp_path, reason))
    assert np.nanmax(np.abs(run.error)) < recorded_run.BOUND_RAD
    metrics = measure(run)
    assert metrics.held is held
    assert metrics.first_violation == pytest.approx(violated, nan_ok=True)
    assert metrics.violating_joint == ('' if held else 'elbow')
    assert [stop['time'] for stop in metrics.stops] == [pytest.approx(STOP_S)]
    table = format_table(metrics)
    assert f'bound       {bound}' in table
    assert f"stopped     at 2.345 s, {reason}: joint 'elbow' is +0.0023 rad" in table


def test_figures_and_page_show_the_stop(tmp_path):
    path = stopped(tmp_path)
    run = read_run(path)
    shown = [
        panel
        for panel in panels([run])
        if panel.group in ('Motion', 'Tracking', 'Torque')
    ]
    assert len(shown) == 8
    for panel in shown:
        assert [(mark.text, mark.colour) for mark in panel.marks] == [
            ('stop: error past the bound', ALARM)
        ]
        assert panel.marks[0].time == pytest.approx(STOP_S)
        assert panel.marks[0].until == run.duration
    draw(run, tmp_path)
    figure = pixels(tmp_path / 'tracking.png')
    assert amount(figure, ALARM) > 100
    assert amount(figure, lightened(ALARM, 0.1)) > 50_000  # shaded after the stop
    bag = read_bag(path)
    ((time, text),) = (
        (time, text) for time, kind, text in bag.events if kind == 'stop'
    )
    assert time == pytest.approx(STOP_S)
    assert text.startswith("error past the bound: joint 'elbow'")


def test_stop_is_shaded_until_the_controller_restarts(tmp_path):
    stop, start = (START + k * MILLISECOND for k in (1000, 1800))
    events = [
        Event(
            1,
            EventType.STOP,
            stop,
            1,
            1,
            {'reason': Reason.VELOCITY, 'text': 'too fast'},
        ),
        Event(2, EventType.START, start, 1, 1, {'resumed': False}),
    ]
    messages = [
        *Synthetic(4000).messages(),
        *((JOURNAL, START, each.encode()) for each in events),
    ]
    path = recorded_run.write_made(tmp_path / 'bag', messages)
    bag = read_bag(path)
    (plot,) = (
        p for p in plots(panels([bag.run]), [bag]) if p['title'] == 'torque of elbow'
    )
    assert plot['marks'] == [
        (pytest.approx(1.0), 'stop: velocity not plausible', ALARM, pytest.approx(1.8))
    ]


@pytest.mark.parametrize(
    ('ends', 'written'),
    [
        ((2.0, 120.0), ['2', '5', '10', '20', '50', '100']),
        ((17.0, 24.0), ['18', '20', '22', '24']),
    ],
)
def test_logarithmic_axis_has_plain_numbers_to_read_it_by(ends, written, tmp_path):
    picture = figures.Picture(1, 1, 'response', (4.0, 3.0), share_time=False)
    axes = picture.axes[0, 0]
    axes.loglog(ends, ends)
    picture.save(tmp_path / 'response.png')
    low, high = axes.get_xlim()
    ticks = zip(axes.get_xticks(), axes.get_xticklabels(), strict=True)
    assert [label.get_text() for x, label in ticks if low <= x <= high] == written
    assert not any(each.get_text() for each in axes.get_xticklabels(minor=True))

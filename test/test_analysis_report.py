# SPDX-License-Identifier: Apache-2.0
"""Pictures and page show every panel of a run, keep its peaks, and mark its events."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
import recorded_run
from matplotlib import pyplot as plt
from matplotlib import rcParams
from matplotlib.colors import to_hex, to_rgb
from nights import at_night
from recorded_run import JOINTS, MILLISECOND, START, Synthetic

from blf_dsc_controller import draw, measure, read_run
from blf_dsc_controller.analysis.metrics_table import format_table
from blf_dsc_controller.analysis.report import read_bag, write_report
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.journal import Event, EventType
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
    for colour in ('#0072B2', '#D55E00'):
        assert amount(parameters, lightened(colour, 0.6)) > 500


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags')
    recorded_run.record(path / 'one')
    recorded_run.record(path / 'other', **{'two_link.feedback_gain': [30.0, 10.0]})
    synthetic = Synthetic(4000)
    synthetic.error[1234, 0] = -0.005  # one sample far outside
    synthetic.torque[2000:2010, 1] = 20.0  # ten samples at the limit
    synthetic.torque[3996:, 1] = -20.0  # and the last four
    data = json.dumps(
        {'stamp': START + 2_500_000_000, 'parameters': {'load.torque': [1.0, 0.0]}}
    )
    message = typestore().types[topics.CHANGES.type](data=data)
    change = (
        topics.CHANGES,
        START,
        bytes(typestore().serialize_cdr(message, topics.CHANGES.type)),
    )
    recorded_run.write_made(
        path / 'synthetic', [*synthetic.messages(with_timing=True), change]
    )
    return path


@pytest.fixture
def by_title(tmp_path):
    """Return a function from bags to the panels of their page, by title."""

    def read(*bags):
        write_report(bags, tmp_path / 'page.html')
        text = (tmp_path / 'page.html').read_text()
        data = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1]
        return {panel['title']: panel for panel in json.loads(data)['panels']}

    return read


def test_every_quantity_has_a_panel(folder, by_title):
    titles = set(by_title(read_bag(folder / 'synthetic')))
    expected = {
        f'{quantity} of {joint}'
        for quantity in ('error', '|error|', 'position', 'torque')
        for joint in JOINTS
    }
    expected |= {'(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2', 'relative parameter error'}
    expected |= {'minimum eigenvalue of Φ', 'disturbance estimates'}
    assert titles == expected


def test_peak_of_one_sample_survives_thinning(folder, by_title):
    panel = by_title(read_bag(folder / 'synthetic'))['error of shoulder']
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


def test_several_bags_are_overlaid_and_their_parameter_differences_listed(
    folder, by_title, tmp_path
):
    bags = [read_bag(folder / 'one'), read_bag(folder / 'other')]
    panel = by_title(*bags)['error of joint1']
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
    text = (tmp_path / 'page.html').read_text()
    assert text.count('Every joint stayed inside its bound.') == 2
    assert '<p>1 parameters differ.</p>' in text
    row = 'two_link.feedback_gain</td><td>[60.0, 20.0]</td><td>[30.0, 10.0]</td>'
    assert f'blf_dsc_controller: {row}' in text


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
    states = [
        entry for entry in Synthetic(500).messages() if entry[0] is topics.JOINT_STATES
    ]
    recorded_run.write_made(tmp_path / 'bag', states)
    assert (
        main(['report', str(tmp_path / 'bag'), '--out', str(tmp_path / 'page.html')])
        == 0
    )
    text = (tmp_path / 'page.html').read_text()
    assert 'not recorded in the bag' in text
    assert 'The bag has no bounds, or no errors, to compare.' in text
    assert (
        main(
            ['report', str(tmp_path / 'nowhere'), '--out', str(tmp_path / 'none.html')]
        )
        == 1
    )
    assert capsys.readouterr().err.startswith('blf_dsc report: ')
    assert not (tmp_path / 'none.html').exists()


@pytest.mark.parametrize('value', [np.nan, -1e308, *at_night(np.inf)])
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
        if topic not in (topics.TRACKING_ERROR, topics.REFERENCE, topics.MONITOR)
        or stamp < stop
    ]
    messages.append((topics.JOURNAL, stop + 2 * LATE, event.encode()))
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


def test_figures_and_page_show_the_stop(tmp_path, by_title):
    path = stopped(tmp_path)
    run, bag = read_run(path), read_bag(path)
    shown = by_title(bag).values()
    page = (tmp_path / 'page.html').read_text()
    assert f'elbow left its bound at {STOP_S} s.' in page
    marked = [p for p in shown if p['group'] in ('Motion', 'Tracking', 'Torque')]
    assert len(marked) == 8
    for panel in marked:
        ((time, text, colour, until),) = panel['marks']
        assert (time, until) == pytest.approx((STOP_S, run.duration))
        assert text == 'stop: error past the bound'
    draw(run, tmp_path)
    figure = pixels(tmp_path / 'tracking.png')
    assert amount(figure, colour) > 100
    assert amount(figure, lightened(colour, 0.1)) > 50_000  # shaded after the stop
    ((time, text),) = ((at, what) for at, kind, what in bag.events if kind == 'stop')
    assert time == pytest.approx(STOP_S)
    assert text.startswith("error past the bound: joint 'elbow'")

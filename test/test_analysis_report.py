# SPDX-License-Identifier: Apache-2.0
"""What the page of a bag is made of: every panel, event and parameter, without a browser."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import recorded_run
import synthetic_bag
from synthetic_bag import JOINTS, START, Synthetic

from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.analysis.report import arm, plots, write_report
from blf_dsc_controller.analysis.reported_bag import read_bags
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.topics import CHANGES, JOINT_STATES
from blf_dsc_controller.messages.types import typestore

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags')
    recorded_run.record(path / 'one')
    recorded_run.record(path / 'other', **{'feedback.gain': [30.0, 10.0]})
    made = Synthetic(4000)
    made.error[1234, 0] = -0.005  # one sample far outside
    made.torque[2000:2010, 1] = 20.0  # ten at the limit
    pushed = json.dumps({'stamp': START + 2_500_000_000, 'parameters': {'load.torque': [1.0, 0.0]}})
    message = typestore().types[CHANGES.type](data=pushed)
    change = (CHANGES, START, bytes(typestore().serialize_cdr(message, CHANGES.type)))
    synthetic_bag.write(path / 'synthetic', [*made.messages(with_timing=True), change])
    return path


def by_title(bags):
    return {plot['title']: plot for plot in plots(panels([bag.run for bag in bags]), bags)}


def test_every_quantity_has_its_panel(folder):
    titles = set(by_title(read_bags([folder / 'synthetic'])))
    expected = {
        f'{what} of {joint}'
        for what in ('error', '|error|', 'position', 'torque')
        for joint in JOINTS
    }
    expected |= {'(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2', 'relative parameter error'}
    expected |= {'minimum eigenvalue', *(f'disturbance {joint}' for joint in JOINTS)}
    expected |= {'period of the joint states, as received', 'state to torque'}
    assert titles == {*expected, 'computing time of the law'}


def test_a_peak_of_one_sample_is_not_thinned_away(folder):
    panel = by_title(read_bags([folder / 'synthetic']))['error of shoulder']
    error, bound, _ = panel['traces']
    k = int(np.argmin(error['y']))
    assert (error['x'][k], error['y'][k]) == (1.234, -5.0)
    assert len(error['x']) <= 3000
    assert set(bound['y']) == {2.0}


def test_events_are_violations_saturation_the_latch_and_changes_of_the_plant(folder):
    (bag,) = read_bags([folder / 'synthetic'])
    events = {(event.kind, round(event.time, 3)): event.text for event in bag.events}
    assert events == {
        ('violation', 1.234): 'shoulder outside its bound for 1 samples',
        ('learning', 1.5): 'first excited window: learning began',
        ('saturation', 2.0): 'elbow at its torque limit for 10 samples',
        ('plant', 2.5): 'load.torque: [1.0, 0.0]',
    }


def test_several_bags_lie_over_each_other_and_their_differences_are_listed(folder, tmp_path):
    bags = read_bags([folder / 'one', folder / 'other'])
    panel = by_title(bags)['error of joint1']
    names = [trace['name'] for trace in panel['traces']]
    assert names == [
        f'{bag}: {what}' for bag in ('one', 'other') for what in ('error', *['bound'] * 2)
    ]
    assert panel['traces'][0]['line']['color'] != panel['traces'][3]['line']['color']
    write_report(bags, tmp_path / 'page.html')
    text = (tmp_path / 'page.html').read_text()
    assert '<p>1 parameters differ.</p>' in text
    row = 'blf_dsc_controller: feedback.gain</td><td>[60.0, 20.0]</td><td>[30.0, 10.0]</td>'
    assert row in text


def test_legends_name_what_is_alike_in_all_bags_once(folder):
    bags = read_bags([folder / 'one', folder / 'other'])
    traces = by_title(bags)['error of joint1']['traces']
    shown = [trace['name'] for trace in traces if trace['showlegend']]
    assert shown == ['one: error', 'one: bound', 'other: error']


def test_the_page_says_how_long_series_are_thinned(folder, tmp_path):
    thinned = 'the largest sample of every 2.67 ms, zoomed or not; every sample is in the table'
    for name, words in (('synthetic', thinned), ('one', 'Lines show every sample.')):
        write_report(read_bags([folder / name]), tmp_path / f'{name}.html')
        assert words in (tmp_path / f'{name}.html').read_text()


def test_bags_of_one_name_are_numbered(folder):
    with_bag = [folder / 'one', folder / '..' / folder.name / 'other', folder / 'one']
    assert [one.name for one in read_bags(with_bag)] == ['one (1)', 'other', 'one (2)']


def test_the_arm_has_its_lengths_and_moves_as_measured(folder):
    (bag,) = read_bags([folder / 'one'])
    moving = arm(bag, 0)
    assert [joint.offset for joint in moving['joints']] == [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    assert moving['tip'] == [0.8, 0.0, 0.0]  # of the plant's configuration
    assert len(moving['time']) == 50  # a second, at fifty pictures
    assert moving['angles'][-1] == pytest.approx(bag.run.position[-1], abs=1e-4)
    assert moving['reference'][0] == pytest.approx(bag.run.reference[0], abs=1e-4)


def test_a_page_is_one_file_whose_data_no_name_can_break(folder, tmp_path):
    (bag,) = read_bags([folder / 'one'])
    nasty = '</script><b>&{{data}}'
    write_report([replace(bag, name=nasty)], tmp_path / 'page.html')
    text = (tmp_path / 'page.html').read_text()
    ours = text.split('<script>')[0] + text.rsplit('<script>', 1)[1]  # without plotly's own script
    assert not re.search(r'(?:src|href)="(?!#|data:)|https?:', ours)
    embedded = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1]
    assert json.loads(embedded)['arms'][0]['name'] == nasty
    assert '<b>' not in ours.replace(embedded, '')


def test_joint_states_alone_make_a_page(tmp_path):
    states = [one for one in Synthetic(500).messages() if one[0] is JOINT_STATES]
    synthetic_bag.write(tmp_path / 'bag', states)
    assert main(['report', str(tmp_path / 'bag'), '--out', str(tmp_path / 'page.html')]) == 0
    assert 'not recorded in the bag' in (tmp_path / 'page.html').read_text()


def test_what_is_wrong_is_one_message(tmp_path, capsys):
    assert main(['report', str(tmp_path / 'nowhere'), '--out', str(tmp_path / 'page.html')]) == 1
    assert capsys.readouterr().err.startswith('blf_dsc report: ')
    assert not (tmp_path / 'page.html').exists()

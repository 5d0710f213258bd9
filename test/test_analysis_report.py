# SPDX-License-Identifier: Apache-2.0
"""Contents of the page of a bag, without a browser: panels, events and parameters."""

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
from blf_dsc_controller.analysis.report import plots, read_bags, write_report
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages.codecs import typestore
from blf_dsc_controller.messages.topics import CHANGES, JOINT_STATES

pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp('bags')
    recorded_run.record(path / 'one')
    recorded_run.record(path / 'other', **{'feedback.gain': [30.0, 10.0]})
    synthetic = Synthetic(4000)
    synthetic.error[1234, 0] = -0.005  # one sample far outside
    synthetic.torque[2000:2010, 1] = 20.0  # ten samples at the limit
    data = json.dumps({'stamp': START + 2_500_000_000, 'parameters': {'load.torque': [1.0, 0.0]}})
    message = typestore().types[CHANGES.type](data=data)
    change = (CHANGES, START, bytes(typestore().serialize_cdr(message, CHANGES.type)))
    synthetic_bag.write(path / 'synthetic', [*synthetic.messages(with_timing=True), change])
    return path


def by_title(bags):
    return {plot['title']: plot for plot in plots(panels([bag.run for bag in bags]), bags)}


def test_every_quantity_has_a_panel(folder):
    titles = set(by_title(read_bags([folder / 'synthetic'])))
    expected = {
        f'{quantity} of {joint}'
        for quantity in ('error', '|error|', 'position', 'torque')
        for joint in JOINTS
    }
    expected |= {'(m1+m2)*l1^2', 'm2*l2^2', 'm2*l1*l2', 'relative parameter error'}
    expected |= {'minimum eigenvalue', *(f'disturbance {joint}' for joint in JOINTS)}
    expected |= {'period of the joint states, as received', 'state to torque'}
    assert titles == {*expected, 'computing time of the law'}


def test_peak_of_one_sample_survives_thinning(folder):
    panel = by_title(read_bags([folder / 'synthetic']))['error of shoulder']
    error, bound, _ = panel['traces']
    k = int(np.argmin(error['y']))
    assert (error['x'][k], error['y'][k]) == (1.234, -5.0)
    assert len(error['x']) <= 3000
    assert set(bound['y']) == {2.0}


def test_events_list_violation_latch_saturation_and_plant_change(folder):
    (bag,) = read_bags([folder / 'synthetic'])
    events = {(kind, round(time, 3)): text for time, kind, text in bag.events}
    assert events == {
        ('violation', 1.234): 'shoulder outside its bound for 1 samples',
        ('learning', 1.5): 'first excited window: learning began',
        ('saturation', 2.0): 'elbow at its torque limit for 10 samples',
        ('plant', 2.5): 'load.torque: [1.0, 0.0]',
    }


def test_several_bags_are_overlaid_and_their_parameter_differences_listed(folder, tmp_path):
    bags = read_bags([folder / 'one', folder / 'other'])
    panel = by_title(bags)['error of joint1']
    names = [trace['name'] for trace in panel['traces']]
    assert names == [
        f'{bag}: {line}' for bag in ('one', 'other') for line in ('error', *['bound'] * 2)
    ]
    assert panel['traces'][0]['line']['color'] != panel['traces'][3]['line']['color']
    shown = [trace['name'] for trace in panel['traces'] if trace['showlegend']]
    assert shown == ['one: error', 'one: bound', 'other: error']  # what they share, once
    write_report(bags, tmp_path / 'page.html')
    text = (tmp_path / 'page.html').read_text()
    assert '<p>1 parameters differ.</p>' in text
    row = 'blf_dsc_controller: feedback.gain</td><td>[60.0, 20.0]</td><td>[30.0, 10.0]</td>'
    assert row in text


def test_page_explains_how_long_series_are_thinned(folder, tmp_path):
    thinned = 'the largest sample of every 2.67 ms, zoomed or not; every sample is in the table'
    for name, text in (('synthetic', thinned), ('one', 'Lines show every sample.')):
        write_report(read_bags([folder / name]), tmp_path / f'{name}.html')
        assert text in (tmp_path / f'{name}.html').read_text()


def test_bags_with_the_same_name_are_numbered(folder):
    paths = [folder / 'one', folder / '..' / folder.name / 'other', folder / 'one']
    assert [bag.name for bag in read_bags(paths)] == ['one (1)', 'other', 'one (2)']


def test_page_is_self_contained_and_escapes_names(folder, tmp_path):
    (bag,) = read_bags([folder / 'one'])
    nasty = '</script><b>&{{data}}'
    write_report([replace(bag, name=nasty)], tmp_path / 'page.html')
    text = (tmp_path / 'page.html').read_text()
    own = text.split('<script>')[0] + text.rsplit('<script>', 1)[1]  # without plotly's own script
    assert not re.search(r'(?:src|href)="(?!#|data:)|https?:', own)
    embedded = re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1]
    assert json.loads(embedded)['seconds'] == 1.0
    assert nasty not in text
    assert '<b>' not in own.replace(embedded, '')


def test_joint_states_alone_suffice_for_a_page(tmp_path, capsys):
    states = [entry for entry in Synthetic(500).messages() if entry[0] is JOINT_STATES]
    synthetic_bag.write(tmp_path / 'bag', states)
    assert main(['report', str(tmp_path / 'bag'), '--out', str(tmp_path / 'page.html')]) == 0
    assert 'not recorded in the bag' in (tmp_path / 'page.html').read_text()
    assert main(['report', str(tmp_path / 'nowhere'), '--out', str(tmp_path / 'none.html')]) == 1
    assert capsys.readouterr().err.startswith('blf_dsc report: ')
    assert not (tmp_path / 'none.html').exists()


@pytest.mark.usefixtures('blank_pictures')
@pytest.mark.parametrize('value', [np.nan, np.inf, -1e308])
def test_unknown_and_absurd_numbers_cause_no_warning(tmp_path, value):
    """Warnings are errors here: numpy's would be seen beside the page."""
    made = Synthetic(400)
    made.position[50, 0] = made.error[60, 1] = made.reference[70, 0] = value
    made.error[:, 0] = made.torque[:, 1] = made.estimate[:, 1] = value
    made.disturbance[100:, 0] = made.latched[:] = value
    bag = str(synthetic_bag.write(tmp_path / 'bag', made.messages(with_timing=True)))
    for command, out in (('report', 'page.html'), ('plot', 'plots'), ('export', 'table.csv')):
        assert main([command, bag, '--out', str(tmp_path / out)]) == 0

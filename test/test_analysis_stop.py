# SPDX-License-Identifier: Apache-2.0
"""Table, summary, figures and page show a safe stop with its reason and time.

The sample that causes it is published without its error: only the journal has the cause.
"""

from __future__ import annotations

import numpy as np
import pytest
import synthetic_bag
from synthetic_bag import MILLISECOND, START, Synthetic
from test_analysis_figures import amount, lightened, pixels

from blf_dsc_controller.analysis.figures import draw
from blf_dsc_controller.analysis.panels import panels
from blf_dsc_controller.analysis.report import read_bags
from blf_dsc_controller.analysis.style import ALARM
from blf_dsc_controller.analysis.summary import format_table, summarize
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.messages.journal import Event, EventType
from blf_dsc_controller.messages.topics import (
    JOURNAL,
    LEARNING,
    REFERENCE,
    TRACKING_ERROR,
)
from blf_dsc_controller.supervision.checks import Reason

STOP_S = 2.345
LATE = 40 * MILLISECOND  # from the stamp of a message to its reception


def stopped(folder, reason=Reason.OUTSIDE_BOUND):
    """Bag of a run whose controller stops at `STOP_S`; its messages are received late."""
    stop = START + round(STOP_S * 1e3) * MILLISECOND
    text = "joint 'elbow' is +0.0023 rad from its reference: past its bound of 0.002 rad"
    event = Event(2, EventType.STOP, stop, 1, 1, {'reason': reason, 'text': text})
    messages = [
        (topic, stamp + LATE, raw)
        for topic, stamp, raw in Synthetic(4000).messages()
        if topic not in (TRACKING_ERROR, REFERENCE, LEARNING) or stamp < stop
    ]
    messages.append((JOURNAL, stop + 2 * LATE, event.encode()))
    return synthetic_bag.write(folder / 'bag', sorted(messages, key=lambda entry: entry[1]))


def test_stop_outside_the_bound_is_a_violation_at_the_stamp_of_the_last_state(tmp_path):
    run = read_run(stopped(tmp_path))
    assert np.nanmax(np.abs(run.error)) < synthetic_bag.BOUND_RAD
    tracking = summarize(run)['tracking']
    assert tracking['held'] is False
    assert tracking['first_violation'] == {'time_s': pytest.approx(STOP_S), 'joint': 'elbow'}
    (stop,) = tracking['stops']
    assert (stop['time_s'], stop['stamp_ns']) == (pytest.approx(STOP_S), START + 2345 * MILLISECOND)
    table = format_table(summarize(run))
    assert 'bound       VIOLATED, first by elbow at 2.345 s' in table
    assert "stopped     at 2.345 s, error past the bound: joint 'elbow' is +0.0023 rad" in table
    assert 'held' not in table


def test_stop_for_another_reason_keeps_the_bound_held_until_then(tmp_path):
    summary = summarize(read_run(stopped(tmp_path, Reason.VELOCITY)))
    assert summary['tracking']['held'] is True
    table = format_table(summary)
    assert 'bound       held by every joint until the stop' in table
    assert 'stopped     at 2.345 s, velocity not plausible' in table


def test_figures_and_page_show_the_stop(tmp_path):
    path = stopped(tmp_path)
    run = read_run(path)
    shown = [panel for panel in panels([run]) if panel.group in ('Motion', 'Tracking', 'Torque')]
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
    (bag,) = read_bags([path])
    ((time, text),) = ((time, text) for time, kind, text in bag.events if kind == 'stop')
    assert time == pytest.approx(STOP_S)
    assert text.startswith("error past the bound: joint 'elbow'")


def test_stop_is_shaded_until_the_controller_restarts(tmp_path):
    stop, start = (START + k * MILLISECOND for k in (1000, 1800))
    events = [
        Event(1, EventType.STOP, stop, 1, 1, {'reason': Reason.VELOCITY, 'text': 'too fast'}),
        Event(2, EventType.START, start, 1, 1, {'resumed': False}),
    ]
    messages = [*Synthetic(4000).messages(), *((JOURNAL, START, each.encode()) for each in events)]
    path = synthetic_bag.write(tmp_path / 'bag', messages)
    (bag,) = read_bags([path])
    pytest.importorskip('plotly', reason='needs plotly: pip install blf_dsc_controller[report]')
    from blf_dsc_controller.analysis.report import plots

    (plot,) = (p for p in plots(panels([bag.run]), [bag]) if p['title'] == 'torque of elbow')
    assert plot['marks'] == [
        (pytest.approx(1.0), 'stop: velocity not plausible', ALARM, pytest.approx(1.8))
    ]

# SPDX-License-Identifier: Apache-2.0
"""A bag replays to exactly the numbers it holds.

Any difference is located and named.
"""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest
import recorded_run
from command import OLDER, finished
from random_arm import random_urdf
from recorded_run import MILLISECOND, START, compared, of

from blf_dsc_controller import BlfDscError, load_loop, read_run, simulate, verify
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateEncoder
from blf_dsc_controller.messages.journal import EventType, decode
from blf_dsc_controller.simulation.loop import write_bag

OF_URDF = """
/**:
  ros__parameters:
    robot: {{urdf: {urdf}, tip: tip}}
/sim_plant:
  ros__parameters: {{duration: 0.2, truth.mass_deviation: 0.3}}
"""
SAMPLES = 1001

DIFFERENT, PARTIAL = 3, 4  # exit codes of a replay


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp('recorded') / 'bag'
    return recorded_run.record(path, **{'telemetry.decimation': 1})


@pytest.fixture
def entries(bag):
    """Messages of the bag, which a test may change."""
    return recorded_run.messages(bag)


def test_every_number_is_reproduced(bag, tmp_path):
    """The tracking error is never decimated: it tells the replay which states the law used."""
    result = verify(bag)
    assert (result.difference, result.remarks) == (None, ())
    counts = {
        'commands': 2 * (SAMPLES + 1),  # the last one when the run ends
        'tracking_error': 6 * SAMPLES,
        'reference': 4 * SAMPLES,
        # Two ratios, two distances, three parameters, two biases, two disturbances,
        # three more.
        'monitor': 14 * SAMPLES,
        'bound': 4,
    }
    assert compared(result) == counts
    assert [item.left_out for item in result.comparisons if item.left_out] == [
        'compute_time'
    ]
    run = read_run(bag)
    # Otherwise this would not cover the composite learning.
    assert run.monitor.column('latched')[-1] == 1.0

    for decimation, given in ((10, {}), (7, {'telemetry.decimation': 7})):
        sparse = recorded_run.record(tmp_path / f'{decimation}', **given)
        result = verify(sparse)
        few = -(-SAMPLES // decimation)
        assert (result.difference, result.compared) == (None, 1.0)
        assert compared(result) == counts | {'reference': 4 * few, 'monitor': 14 * few}
        thinned = read_run(sparse)
        np.testing.assert_array_equal(thinned.error, run.error)
        np.testing.assert_allclose(
            thinned.reference, run.reference, rtol=0.0, atol=1e-15
        )
        assert np.isfinite(thinned.reference_velocity[:, 0]).sum() == few


@pytest.mark.parametrize(
    'given',
    [
        {'law': 'backstepping'},
        {'law': 'slotine_li'},
        {'feedback.joint_damping_lag': [0.003, 0.003]},
    ],
)
def test_other_laws_and_a_narrowing_bound_replay_from_compressed_bags(tmp_path, given):
    result = verify(str(recorded_run.record(tmp_path / 'bag', 0.3, 'zstd', **given)))
    assert (result.difference, result.remarks) == (None, ())
    assert EventType.PARAMETERS not in [item.type for item in result.events]


@pytest.mark.parametrize(
    ('topic', 'at', 'field'),
    [
        (topics.COMMANDS, -8, 'effort of joint2'),
        (topics.TRACKING_ERROR, -8, 'effort of joint2'),
        (
            topics.REFERENCE,
            -8 - 4,
            'velocity of joint2',
        ),  # followed by the empty effort
        # before model_changes, compute_time, velocity and effort
        (topics.MONITOR, -32, 'latched'),
    ],
)
def test_flipped_bit_is_located_and_named_and_the_earliest_counts(
    entries, tmp_path, capsys, topic, at, field
):
    for flipped, k, place in (
        (topic, 700, at),
        (topics.COMMANDS, 800, -8),
        (topics.MONITOR, 900, -40),
    ):
        entry = of(entries, flipped)[k]
        raw = bytearray(entry[3])
        raw[place] ^= 1
        entry[3] = bytes(raw)
    path = recorded_run.write(tmp_path / 'bag', entries)
    result = verify(path)
    difference = result.difference
    assert (difference.topic, difference.field) == (topic.resolved, field)
    assert difference.stamp == START + 700 * MILLISECOND
    assert difference.time == pytest.approx(0.7)
    assert difference.recorded != difference.replayed
    assert difference.recorded == pytest.approx(difference.replayed, abs=1e-12)
    assert main(['replay', str(path)]) == DIFFERENT
    *lines, last = capsys.readouterr().out.splitlines()
    assert last.startswith(
        'DIFFERENT, first at 0.700000 s (stamp 1700000000 ns), /blf_dsc_c'
    )
    assert f'recorded {difference.recorded!r}, replayed {difference.replayed!r}' in last
    for found in result.comparisons:
        assert (found.difference is None) == (
            found.topic not in (topic.resolved, *FLIPPED)
        )
        assert (found.largest > 0.0) == (found.difference is not None)
    largest = max(
        found.largest for found in result.comparisons if found.topic == topic.resolved
    )
    assert any(
        f'{topic.resolved}: ' in x and f'at most {largest:.3g}' in x for x in lines
    )


FLIPPED = topics.COMMANDS.resolved, topics.MONITOR.resolved


def test_repeated_and_unused_states_are_skipped(entries, tmp_path):
    states = of(entries, topics.JOINT_STATES)
    at = START + 300 * MILLISECOND + 5
    late = JointStateEncoder(('joint1', 'joint2')).encode(at, [9, 9], [9, 9], [9, 9])
    place = entries.index(states[301])
    entries.insert(
        place, [topics.JOINT_STATES.resolved, topics.JOINT_STATES.type, at, late]
    )
    result = verify(recorded_run.write(tmp_path / 'bag', [states[0], *entries]))
    assert (result.difference, result.skipped, result.samples) == (None, 2, SAMPLES)


@pytest.mark.parametrize(
    ('topic', 'number', 'publishers', 'percent', 'commands'),
    [
        (topics.JOINT_STATES, 333, 0, 33.2, 333),  # ends the replay
        # Two of the 24 numbers of a sample are commands.
        (topics.COMMANDS, 333, 0, 91.4, 0),
        (topics.COMMANDS, 333, 2, 91.4, 0),  # have no common order
        (topics.COMMANDS, 333, 1, None, SAMPLES),
        (topics.COMMANDS, 0, 1, None, SAMPLES),
    ],
)
def test_lost_message_leaves_the_others_to_compare(
    entries, tmp_path, capsys, topic, number, publishers, percent, commands
):
    lost = of(entries, topic)[number]
    lost[3] = None
    path = recorded_run.write(tmp_path / 'bag', entries, publishers=publishers)
    result = verify(path)
    assert result.difference is None
    assert compared(result)['commands'] == 2 * commands
    if topic is topics.JOINT_STATES:
        assert result.samples == number
        stamp = f'the state with stamp {lost[2]} ns was used but is not in the bag'
        assert any(remark.startswith(stamp) for remark in result.remarks)
        assert (
            result.comparisons[0].left_out
            == '669 torques that the replay does not reach'
        )
    if percent:
        assert main(['replay', str(path)]) == PARTIAL
        last = capsys.readouterr().out.splitlines()[-1]
        found = float(last.removeprefix('PARTLY COMPARED: ').split()[0])
        assert found == pytest.approx(percent, abs=1.5)


def replayed(path, capsys):
    """Return the exit code of the command, and what it prints."""
    code = main(['replay', str(path)])
    return code, capsys.readouterr().out


@pytest.mark.parametrize(
    'topic', [topics.COMMANDS, topics.REFERENCE, topics.MONITOR, topics.BOUND]
)
def test_missing_topic_is_named_in_the_verdict(entries, tmp_path, capsys, topic):
    kept = [entry for entry in entries if entry[0] != topic.resolved]
    code, text = replayed(recorded_run.write(tmp_path / 'bag', kept), capsys)
    assert code == PARTIAL
    missing = {topics.BOUND: 1, topics.COMMANDS: SAMPLES + 1}.get(topic, SAMPLES)
    assert f'MISSING in the bag: {missing} messages of {topic.resolved}' in text
    assert 'INCOMPLETE' in text.splitlines()[-1]


@pytest.mark.parametrize('publishers', [0, 1], ids=['no numbers', 'numbers'])
@pytest.mark.parametrize('number', [0, 333, SAMPLES - 1])
def test_missing_answer_makes_no_difference(
    entries, tmp_path, capsys, number, publishers
):
    """Without sequence numbers its state may as well have been dropped by the middleware."""
    of(entries, topics.TRACKING_ERROR)[number][3] = None
    path = recorded_run.write(tmp_path / 'bag', entries, publishers=publishers)
    result = verify(path)
    assert result.difference is None
    assert compared(result)['tracking_error'] == 6 * number
    assert compared(result)['commands'] >= 2 * number
    code, text = replayed(path, capsys)
    assert code == PARTIAL
    assert 'could not be compared' in text.splitlines()[-1]


def test_recording_that_was_cut_is_incomplete(entries, tmp_path, capsys):
    """Whoever recorded it: a node, a loop without ROS, an offline run."""
    half = [entry for entry in entries if entry[2] < START + 500 * MILLISECOND]
    code, text = replayed(recorded_run.write(tmp_path / 'bag', half), capsys)
    assert code == PARTIAL
    assert 'MISSING in the bag: the end of the run' in text
    assert 'has no release' in text


@pytest.mark.parametrize(
    ('keep', 'words'),
    [
        (
            lambda name, _: name == topics.JOINT_STATES.resolved,
            r'/joint_states \(1001\)',
        ),
        (lambda name, _: 'jo' in name, r'/joint_states \(1001\)'),  # and the journal
        (
            lambda name, at: name == topics.JOURNAL.resolved or at >= 200,
            f'stamp {START} ns, .* start the',
        ),
        (
            lambda name, at: name != topics.JOURNAL.resolved or at,
            'the beginning of /blf_.*/journal: start',
        ),
    ],
)
def test_bag_without_what_a_replay_needs_is_refused(entries, tmp_path, keep, words):
    kept = [
        entry for entry in entries if keep(entry[0], (entry[2] - START) / MILLISECOND)
    ]
    path = recorded_run.write(tmp_path / 'bag', kept)
    with pytest.raises(BlfDscError, match=words):
        verify(path)
    if not of(kept, topics.JOURNAL):
        with pytest.raises(BlfDscError, match='not hold the configuration'):
            read_content(path).controller_config()


def configured(entries, change):
    """Change the content of the first event."""
    first = of(entries, topics.JOURNAL)[0]
    event = decode(first[3])
    change(event.content)
    first[3] = event.encode()


def test_journal_of_a_later_format_is_refused(entries, tmp_path):
    def change(content):
        content.update(format=content['format'] + 1, version='9.0.0')

    configured(entries, change)
    path = recorded_run.write(tmp_path / 'bag', entries)
    with pytest.raises(BlfDscError, match=r'format 2, recorded by version 9\.0\.0'):
        verify(path)


# The command.

WITHOUT_ROS = """
import sys
sys.modules['rclpy'] = None  # any import of it fails
from blf_dsc_controller.cli.main import main
sys.exit(main(['replay', *sys.argv[1:]]))
"""


def test_identical_replay_exits_with_zero_and_a_verdict_on_an_older_processor(bag):
    command = [sys.executable, '-c', WITHOUT_ROS, str(bag)]
    # of the bag, which is recorded without
    run = finished(*command, env=os.environ | OLDER)
    assert run.returncode == 0, run.stderr
    assert '/blf_dsc_controller/commands: 2004 values bit-equal' in run.stdout
    assert 'x real time' in run.stdout


def test_bag_replays_without_its_urdf_file_and_is_read_with_unknown_parameters(
    tmp_path, monkeypatch
):
    urdf = tmp_path / 'arm.urdf'
    file = tmp_path / 'arm.yaml'
    urdf.write_text(random_urdf(3, seed=5)[0])
    file.write_text(OF_URDF.format(urdf=urdf))
    loop, bag = load_loop(file), tmp_path / 'bag'
    write_bag(bag, simulate(loop.controller, loop.plant), loop.plant)
    for text in (random_urdf(3, seed=6)[0], None):  # changed, then deleted
        urdf.unlink() if text is None else urdf.write_text(text)
        assert read_content(bag).controller_config() == loop.controller
        assert verify(bag).difference is None
        assert read_run(bag).arm is not None
    entries = recorded_run.messages(bag)
    configured(
        entries, lambda content: content['parameters'].update({'barrier.shape': 2})
    )
    bag = recorded_run.write(tmp_path / 'newer', entries)
    monkeypatch.setattr('blf_dsc_controller.bags.content.__version__', '9.9.9')
    with pytest.raises(
        BlfDscError, match=r'(?s)by version 0\.1\.0, not 9.*barrier\.shape'
    ):
        verify(bag)
    run = read_run(bag)
    assert run.arm is not None
    assert run.notes == (
        'recorded parameters that this version does not have: barrier.shape',
    )

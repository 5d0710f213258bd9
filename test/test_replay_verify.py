# SPDX-License-Identifier: Apache-2.0
"""A bag replays to exactly the numbers it holds; any difference is located and named."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import recorded_run
from recorded_run import compared, of

from blf_dsc_controller import __version__
from blf_dsc_controller.analysis.summary import summarize
from blf_dsc_controller.bags.content import read_content
from blf_dsc_controller.bags.reader import read_run
from blf_dsc_controller.bags.sources import BagError
from blf_dsc_controller.bags.topic_messages import UnreadableMessageError
from blf_dsc_controller.cli.bags import DIFFERENT, PARTIAL
from blf_dsc_controller.cli.main import main
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import BlfDscError, ConfigurationError
from blf_dsc_controller.law.factory import controller_of, estimate_names
from blf_dsc_controller.law.telemetry import ControllerTelemetry
from blf_dsc_controller.messages.codecs import JointStateDecoder, JointStateEncoder
from blf_dsc_controller.messages.journal import Event, EventType, decode
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    JOINT_STATES,
    JOURNAL,
    LEARNING,
    REFERENCE,
    TRACKING_ERROR,
)
from blf_dsc_controller.replay.verify import verify
from blf_dsc_controller.replay.what_if import what_if
from blf_dsc_controller.supervision.handover import apply_bumpless

START = 1_000_000_000  # ns
MILLISECOND = 1_000_000  # ns
SAMPLES = 1001


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    return recorded_run.record(tmp_path_factory.mktemp('recorded') / 'bag')


@pytest.fixture(scope='module')
def entries(bag):
    return recorded_run.messages(bag)


@pytest.fixture
def rewritten(entries, tmp_path):
    """Writes a copy of the bag with other messages."""

    def write(changed=entries, **facts):
        return recorded_run.write(tmp_path / 'changed', changed, **facts)

    return write


def test_decimated_telemetry_replays_bit_for_bit(bag, tmp_path):
    """The tracking error is not decimated: it tells the replay which states the law used."""
    sparse = recorded_run.record(tmp_path / 'sparse', **{'telemetry.decimation': 7})
    result, complete = verify(sparse), verify(bag)
    assert result.difference is None
    assert result.compared == 1.0
    counts, full = compared(result), compared(complete)
    assert counts['learning'] < full['learning'] / 6.9
    assert counts['tracking_error'] == full['tracking_error']
    assert counts['commands'] == full['commands']
    run, whole = read_run(sparse), read_run(bag)
    np.testing.assert_array_equal(run.error, whole.error)
    np.testing.assert_allclose(run.reference, whole.reference, rtol=0.0, atol=1e-15)
    assert run.learning.stamp.size == -(-SAMPLES // 7)


def test_every_number_is_reproduced(bag):
    result = verify(bag)
    assert result.difference is None
    assert result.remarks == ()
    assert compared(result) == {
        'commands': 2 * SAMPLES,
        'tracking_error': 6 * SAMPLES,
        'reference': 4 * SAMPLES,
        'learning': 10 * SAMPLES,  # three parameters, two biases, two disturbances, three more
        'monitor': 11 * 101,  # two ratios, two distances, five estimates, two more
        'bound': 4,
    }
    assert [item.left_out for item in result.comparisons if item.left_out] == ['compute_time']
    # Otherwise this would not cover the composite learning.
    assert read_run(bag).learning.column('latched')[-1] == 1.0


def test_other_laws_and_a_narrowing_bound_replay_from_compressed_bags(tmp_path):
    funnel = {'barrier.initial_bound': [0.02, 0.01], 'barrier.funnel_rate': 5.0}
    for name, given in (
        ('backstepping', {'law': 'backstepping'}),
        ('slotine', {'law': 'slotine_li'}),
        ('funnel', funnel),
    ):
        result = verify(recorded_run.record(tmp_path / name, 0.3, 'zstd', **given))
        assert (result.difference, result.remarks) == (None, ())
        assert EventType.PARAMETERS not in [item.type for item in result.events]


@pytest.mark.parametrize(
    ('topic', 'at', 'field'),
    [
        (COMMANDS, -8, 'effort of joint2'),
        (TRACKING_ERROR, -8, 'effort of joint2'),
        (REFERENCE, -8 - 4, 'velocity of joint2'),  # followed by the empty effort
        (LEARNING, -32, 'latched'),  # before model_changes, compute_time, velocity and effort
    ],
)
def test_flipped_bit_is_located_and_named_and_the_earliest_counts(
    entries, rewritten, topic, at, field
):
    changed = [list(entry) for entry in entries]
    for one, k, place in ((topic, 700, at), (COMMANDS, 800, -8), (LEARNING, 900, -40)):
        raw = bytearray(of(changed, one)[k][3])
        raw[place] ^= 1
        of(changed, one)[k][3] = bytes(raw)
    difference = verify(rewritten(changed)).difference
    assert (difference.topic, difference.field) == (topic.resolved, field)
    assert difference.stamp == START + 700 * MILLISECOND
    assert difference.time == pytest.approx(0.7)
    assert difference.recorded != difference.replayed
    assert difference.recorded == pytest.approx(difference.replayed, abs=1e-12)
    assert f'recorded {difference.recorded!r}, replayed {difference.replayed!r}' in str(difference)


def test_repeated_and_unused_states_are_skipped(entries, rewritten):
    states = of(entries, JOINT_STATES)
    late = JointStateEncoder(('joint1', 'joint2')).encode(
        START + 300 * MILLISECOND + 5, [9, 9], [9, 9], [9, 9]
    )
    at = entries.index(states[301])
    changed = [
        states[0],
        *entries[:at],
        [JOINT_STATES.resolved, JOINT_STATES.type, START + 300 * MILLISECOND + 5, late],
        *entries[at:],
    ]
    result = verify(rewritten(changed))
    assert result.difference is None
    assert result.passed_over == 2
    assert result.samples == SAMPLES


def test_lost_state_ends_the_replay_with_a_remark(entries, rewritten):
    lost = of(entries, JOINT_STATES)[500]
    result = verify(rewritten([entry for entry in entries if entry is not lost]))
    assert result.difference is None
    assert result.samples == 500
    assert any(f'stamp {START + 500 * MILLISECOND} ns' in remark for remark in result.remarks)


def test_recording_that_started_late_is_rejected(entries, rewritten):
    late = [entry for entry in entries if entry[2] > START + 200 * MILLISECOND]
    journal = of(entries, JOURNAL)
    with pytest.raises(BlfDscError, match=f'with the stamp {START} ns, .* start the recorder'):
        verify(rewritten([*journal, *late]))


@pytest.mark.parametrize('number', [0, 500])
def test_missing_command_leaves_the_others_compared_if_they_are_numbered(entries, tmp_path, number):
    lost = of(entries, COMMANDS)[number]
    kept = [[*entry[:3], None] if entry is lost else entry for entry in entries]
    for numbered, count in ((True, 2 * (SAMPLES - 1)), (False, 0)):
        result = verify(recorded_run.write(tmp_path / f'{numbered}', kept, numbered=numbered))
        assert result.difference is None
        assert compared(result)['commands'] == count


def retuned(bag):
    """Messages of the bag as if feedback.gain and barrier.bound had been changed at 0.5 s."""
    config = recorded_run.loop_config().controller
    recorded = of(recorded_run.messages(bag), JOINT_STATES)
    states = read_content(bag).topics[JOINT_STATES].joint_states(config.joints)
    values = np.stack([states.field(k) for k in range(3)], axis=1)
    telemetry = ControllerTelemetry(config.joints, estimate_names(config), 1)
    law = controller_of(config)
    before = START - MILLISECOND
    yield from of(recorded_run.messages(bag), JOURNAL)
    for k, now in enumerate(states.stamp.tolist()):
        yield recorded[k]
        if k == 500:
            changes = {'feedback.gain': [50.0, 25.0], 'barrier.bound': [0.004, 0.003]}
            for number, (name, value) in enumerate(changes.items(), 3):
                config = change(config, {name: tuple(value)})
                t = (now - MILLISECOND - START) * 1e-9
                apply_bumpless(law, config, t, values[k - 1].ravel())
                given = {'parameters': {name: value}}
                event = Event(number, EventType.PARAMETERS, now - MILLISECOND, k, k, given)
                yield [JOURNAL.resolved, JOURNAL.type, now, event.encode()]
        law.update((now - START) * 1e-9, (now - before) * 1e-9, values[k].ravel())
        before = now
        for topic, raw in telemetry.sample(now, law.sample, 0.0):
            yield [topic.resolved, topic.type, now, raw]


def test_parameter_changes_replay_where_they_took_effect(bag, rewritten, capsys):
    path = rewritten(list(retuned(bag)))
    result = verify(path)
    assert [event.type for event in result.events].count(EventType.PARAMETERS) == 2
    assert result.difference is None
    assert main(['replay', str(path)]) == 0
    assert '2 parameter changes replayed' in capsys.readouterr().out


def test_event_lost_by_the_recorder_ends_the_replay(bag, rewritten):
    messages = list(retuned(bag))
    lost = of(messages, JOURNAL)[3]
    result = verify(rewritten([entry for entry in messages if entry is not lost]))
    assert result.difference is None
    assert result.remarks == ('an event of the journal is not in the bag: the replay ends there',)


def test_other_gains_run_in_open_loop(bag):
    config = recorded_run.loop_config().controller
    same = what_if(bag, config)
    assert np.abs(same.difference).max() == 0.0
    stiffer = replace(config, feedback=replace(config.feedback, gain=(70.0, 20.0)))
    found = what_if(bag, stiffer)
    # Before anything is adapted, (28) alone: at the first sample, the gain change times xi2.
    recorded = read_content(bag).topics[TRACKING_ERROR]
    errors = recorded.joint_states(config.joints, ('velocity',))
    expected = -10.0 * errors.field(1)[0, 0]
    assert found.difference[0, 0] == pytest.approx(expected, rel=1e-9)
    assert found.difference[0, 1] == 0.0
    assert found.error_ratio == pytest.approx(same.error_ratio)


def test_replayed_run_has_the_metrics_of_its_bag(bag):
    config = recorded_run.loop_config().controller
    replayed, recorded = what_if(bag, config).run, read_run(bag)
    for part in ('tracking', 'learning'):
        mine, theirs = (
            summarize(run)[part] for run in (replace(replayed, truth=recorded.truth), recorded)
        )
        assert mine == theirs
    assert set(replayed.learning.names) <= set(recorded.learning.names)


def test_open_loop_learns_from_the_applied_torques(bag):
    config = recorded_run.loop_config().controller
    softer = replace(config, feedback=replace(config.feedback, gain=(6.0, 2.0)))
    estimate = what_if(bag, softer).run.learning.values
    own = what_if(bag, config).run.learning.values
    # The window is of the same arm under the same torques, so both find the same parameters.
    assert estimate[-1, :3] == pytest.approx(own[-1, :3], rel=0.05)


def test_journal_holds_the_configuration(entries, tmp_path):
    path = recorded_run.write(tmp_path / 'bag', entries)
    assert verify(path).difference is None
    with pytest.raises(BagError, match='--config recommended'):
        read_content(
            recorded_run.write(tmp_path / 'none', of(entries, JOINT_STATES))
        ).controller_config()


@pytest.mark.parametrize('topics', [[JOINT_STATES], [JOURNAL, JOINT_STATES]])
def test_bag_without_a_controller_has_nothing_to_compare(entries, rewritten, topics):
    kept = [entry for topic in topics for entry in of(entries, topic)]
    with pytest.raises(BlfDscError, match=r'/joint_states \(1001\)'):
        verify(rewritten(kept))


def test_what_limits_a_result_is_remarked(bag, entries, tmp_path, monkeypatch):
    """Another version, processor or law, and messages that the recorder missed."""
    changed = [list(entry) for entry in entries]
    first = of(changed, JOURNAL)[0]
    event = decode(first[3])
    event.content['machine'] |= {'tunables': 'glibc.cpu.hwcaps=-FMA', 'libc': 'glibc 2.99'}
    del event.content['parameters']['learning.compensation']
    first[3] = event.encode()
    lost = '0 missed, 201 sent before the recorder connected'
    facts = {'package_version': __version__, 'messages /joint_states': f'800 written, {lost}'}
    path = recorded_run.write(tmp_path / 'bag', changed, **facts)
    missed, newer, libc, tunables = verify(path).remarks
    assert missed == f'the recorder missed messages of /joint_states: {lost}'
    assert 'before the law had learning.compensation' in newer
    assert libc.startswith('recorded with libc glibc 2.99 and replayed with')
    assert tunables.startswith('recorded with tunables glibc.cpu.hwcaps=-FMA and replayed with')
    monkeypatch.setattr('blf_dsc_controller.replay.verify.__version__', '9.9.9')
    (remark,) = verify(bag).remarks
    assert 'recorded by version 0.1.0 and replayed by 9.9.9' in remark


def test_bag_of_an_earlier_version_is_read_and_its_replay_is_refused(capsys):
    """Recorded at 31c6ec4, the version before its controller said which states it used."""
    bag = Path(__file__).with_name('earlier_version.mcap')
    run = read_run(bag)
    assert run.stamp.size == 21
    assert np.isfinite([run.position, run.error, run.torque, run.bound]).all()
    assert main(['replay', str(bag)]) == 1
    assert 'recorded by an earlier version, whose controller did not' in capsys.readouterr().err
    assert main(['replay', str(bag), '--config', 'recommended']) == 0


def test_configuration_of_another_version_is_rejected(entries, tmp_path, monkeypatch):
    changed = [list(entry) for entry in entries]
    first = of(changed, JOURNAL)[0]
    event = decode(first[3])
    event.content['parameters']['barrier.shape'] = 2.0
    first[3] = event.encode()
    path = recorded_run.write(tmp_path / 'bag', changed, package_version='0.1.0')
    with pytest.raises(ConfigurationError, match=r'barrier\.shape'):
        verify(path)
    monkeypatch.setattr('blf_dsc_controller.bags.content.__version__', '9.9.9')
    with pytest.raises(ConfigurationError, match=r'journal by version 0\.1\.0, not 9\.9\.9'):
        verify(path)


def test_bag_of_another_robot_is_rejected_by_its_joint_names(entries, rewritten):
    states = of(entries, JOINT_STATES)
    decoder = JointStateDecoder(('joint1', 'joint2'))
    other = JointStateEncoder(('wheel', 'arm'))
    foreign = []
    for topic, type_name, at, raw in states:
        stamp = decoder.decode(raw)
        renamed = other.encode(stamp, decoder.position, decoder.velocity, decoder.effort)
        foreign.append([topic, type_name, at, renamed])
    with pytest.raises(UnreadableMessageError, match=r"'joint1' is not in .*names wheel, arm"):
        verify(rewritten([*of(entries, JOURNAL), *of(entries, TRACKING_ERROR), *foreign]))


# The command.

WITHOUT_ROS = """
import sys
sys.modules['rclpy'] = None  # any import of it fails
from blf_dsc_controller.cli.main import main
sys.exit(main(['replay', *sys.argv[1:]]))
"""


def test_identical_replay_exits_with_zero_and_a_verdict(bag):
    command = [sys.executable, '-c', WITHOUT_ROS, str(bag)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert '/blf_dsc_controller/commands: 2002 values bit-equal' in run.stdout
    assert 'x real time' in run.stdout


def test_difference_sets_the_exit_code_and_the_last_line(entries, rewritten, capsys):
    changed = [list(entry) for entry in entries]
    second = of(changed, COMMANDS)[1]
    second[3] = second[3][:-1] + bytes([second[3][-1] ^ 0x80])  # the sign
    assert main(['replay', str(rewritten(changed))]) == DIFFERENT
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith('DIFFERENT, first at 0.001000 s (stamp 1001000000 ns), /blf_dsc_c')
    assert 'effort of joint2: recorded ' in last


@pytest.mark.parametrize('topic', [JOINT_STATES, COMMANDS])
def test_partial_comparison_has_a_verdict_of_its_own(entries, rewritten, capsys, topic):
    """A lost state ends the replay after a third; a lost command leaves the others to compare."""
    lost = of(entries, topic)[333]
    assert main(['replay', str(rewritten([one for one in entries if one is not lost]))]) == PARTIAL
    last = capsys.readouterr().out.splitlines()[-1]
    percent = float(last.removeprefix('PARTLY COMPARED: ').split()[0])
    # Two of the 24 numbers of a sample are commands.
    assert percent == pytest.approx(33.2 if topic is JOINT_STATES else 91.4, abs=1.5)


def test_replay_with_another_configuration_is_reported_as_open_loop(bag, capsys):
    assert main(['replay', str(bag), '--config', 'recommended']) == 0
    output = capsys.readouterr().out
    assert 'OPEN LOOP' in output
    assert 'joint2: torque differs from the recorded one by rms' in output


def test_states_that_are_not_finite_are_left_out_of_an_open_loop(entries, tmp_path, capsys):
    decoder, encoder = (
        codec(('joint1', 'joint2')) for codec in (JointStateDecoder, JointStateEncoder)
    )
    states = [list(entry) for entry in of(entries, JOINT_STATES)]
    for k, entry in enumerate(states):
        stamp, values = decoder.decode(entry[3]), decoder.values.reshape(3, 2).copy()
        values[0, 1] = np.nan if k == 200 else values[0, 1]
        values[2] = np.nan if k < 40 else values[2]  # no torque yet
        entry[3] = encoder.encode(stamp, *values)
    path = recorded_run.write(tmp_path / 'bag', states)
    assert main(['replay', str(path), '--config', 'recommended']) == 0
    output = capsys.readouterr().out
    assert 'note: 41 states left out: not finite' in output
    assert 'nan' not in output


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['nowhere'], 'nowhere cannot be read as a bag: there is no such folder'),
        (['nowhere', '--config', 'recomended'], 'recomended does not exist'),
        (['nowhere', '--config', 'recommended', '--map', 'joint1'], 'one side is missing'),
    ],
)
def test_error_is_reported_in_one_message(arguments, message, capsys):
    assert main(['replay', *arguments]) == 1
    error = capsys.readouterr().err
    assert error.startswith('blf_dsc replay: ')
    assert message in error

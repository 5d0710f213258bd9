# SPDX-License-Identifier: Apache-2.0
"""A bag replays to exactly the numbers it holds; any difference is located and named."""

from __future__ import annotations

from dataclasses import replace

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
from blf_dsc_controller.supervision.retuning import apply_bumpless

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


@pytest.mark.parametrize('law', ['backstepping', 'slotine_li'])
def test_other_laws_replay_from_compressed_bags(tmp_path, law):
    path = recorded_run.record(tmp_path / law, 0.3, 'zstd', law=law)
    assert verify(path).difference is None


def test_narrowing_bound_replays(tmp_path):
    funnel = {'barrier.initial_bound': [0.02, 0.01], 'barrier.funnel_rate': 5.0}
    result = verify(recorded_run.record(tmp_path / 'bag', 0.3, **funnel))
    assert result.difference is None
    assert ([item.type for item in result.events].count(EventType.PARAMETERS), result.remarks) == (
        0,
        (),
    )


def test_learning_has_started_in_the_bag(bag):
    # Otherwise the replays above would not cover the composite learning.
    content = read_content(bag)
    latched = content.topics[LEARNING].joint_states(('latched',), ('position',))
    assert latched.field(0)[-1, 0] == 1.0


@pytest.mark.parametrize(
    ('topic', 'at', 'field'),
    [
        (COMMANDS, -8, 'effort of joint2'),
        (TRACKING_ERROR, -8, 'effort of joint2'),
        (REFERENCE, -8 - 4, 'velocity of joint2'),  # followed by the empty effort
        (LEARNING, -24, 'latched'),  # before model_changes, compute_time, velocity and effort
    ],
)
def test_flipped_bit_is_located_and_named(entries, rewritten, topic, at, field):
    changed = [list(entry) for entry in entries]
    raw = bytearray(of(changed, topic)[700][3])
    at = at if topic is not LEARNING else at - 8
    raw[at] ^= 1
    of(changed, topic)[700][3] = bytes(raw)
    difference = verify(rewritten(changed)).difference
    assert difference.topic == topic.resolved
    assert difference.field == field
    assert difference.stamp == START + 700 * MILLISECOND
    assert difference.time == pytest.approx(0.7)
    assert difference.recorded != difference.replayed
    assert difference.recorded == pytest.approx(difference.replayed, abs=1e-12)
    assert f'recorded {difference.recorded!r}, replayed {difference.replayed!r}' in str(difference)


def test_earliest_of_several_differences_is_reported(entries, rewritten):
    changed = [list(entry) for entry in entries]
    for topic, k in ((COMMANDS, 500), (TRACKING_ERROR, 400), (LEARNING, 600)):
        of(changed, topic)[k][3] = of(entries, topic)[k - 100][3][:20] + bytes(
            len(of(entries, topic)[k][3]) - 20
        )
    for topic, k in ((TRACKING_ERROR, 400), (LEARNING, 600)):
        of(changed, topic)[k][3] = of(entries, topic)[k][3][:-40] + bytes(40)
    difference = verify(rewritten(changed)).difference
    assert (difference.topic, difference.stamp) == (
        TRACKING_ERROR.resolved,
        START + 400 * MILLISECOND,
    )


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


def test_messages_missed_by_the_recorder_are_remarked(entries, rewritten):
    counts = '800 written, 0 missed, 201 sent before the recorder connected'
    result = verify(rewritten(entries, **{'messages /joint_states': counts}))
    lost = '/joint_states: 0 missed, 201 sent before the recorder connected'
    assert result.remarks == (f'the recorder missed messages of {lost}',)


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


def test_recording_by_another_version_is_remarked(bag, monkeypatch):
    monkeypatch.setattr('blf_dsc_controller.replay.verify.__version__', '9.9.9')
    result = verify(bag)
    assert result.difference is None
    assert any('recorded by version 0.1.0 and replayed by 9.9.9' in text for text in result.remarks)


def test_bag_that_is_older_than_a_parameter_is_remarked(entries, rewritten):
    changed = [list(entry) for entry in entries]
    first = of(changed, JOURNAL)[0]
    event = decode(first[3])
    del event.content['parameters']['learning.compensation']
    first[3] = event.encode()
    remarks = verify(rewritten(changed)).remarks
    assert any('before the law had learning.compensation' in text for text in remarks)


def test_recording_on_another_processor_is_remarked(entries, tmp_path):
    first = of([list(entry) for entry in entries], JOURNAL)[0]
    event = decode(first[3])
    event.content['machine'] |= {'tunables': 'glibc.cpu.hwcaps=-FMA', 'libc': 'glibc 2.99'}
    first[3] = event.encode()
    others = [entry for entry in entries if entry[0] != JOURNAL.resolved]
    path = recorded_run.write(
        tmp_path / 'bag', [first, *of(entries, JOURNAL)[1:], *others], package_version=__version__
    )
    libc, tunables = verify(path).remarks
    assert libc.startswith('recorded with libc glibc 2.99 and replayed with')
    assert tunables.startswith('recorded with tunables glibc.cpu.hwcaps=-FMA and replayed with')


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

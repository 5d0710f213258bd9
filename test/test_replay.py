# SPDX-License-Identifier: Apache-2.0
"""A bag replays into the very numbers it holds, and what does not is found and named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import recorded_run

from blf_dsc_controller.bags import context as contexts
from blf_dsc_controller.bags.batch import decode_joint_states
from blf_dsc_controller.bags.content import Content, TopicMessages, read_content
from blf_dsc_controller.bags.context import read_context
from blf_dsc_controller.bags.errors import BagError, UnreadableMessageError
from blf_dsc_controller.configuration.params_file import dumps
from blf_dsc_controller.configuration.schema import change
from blf_dsc_controller.errors import ConfigurationError
from blf_dsc_controller.law.factory import controller_of, estimate_names
from blf_dsc_controller.messages.decoders import JointStateDecoder
from blf_dsc_controller.messages.encoders import Float64MultiArrayEncoder, JointStateEncoder
from blf_dsc_controller.messages.telemetry import ControllerTelemetry
from blf_dsc_controller.messages.topics import (
    COMMANDS,
    JOINT_STATES,
    JOINT_TRAJECTORY,
    LEARNING,
    PARAMETER_EVENTS,
    REFERENCE,
    TRACKING_ERROR,
)
from blf_dsc_controller.messages.types import typestore
from blf_dsc_controller.replay.comparison import Commands, compare
from blf_dsc_controller.replay.errors import NothingToCompareError
from blf_dsc_controller.replay.open_loop import answer
from blf_dsc_controller.replay.recorded import replay
from blf_dsc_controller.replay.states import States
from blf_dsc_controller.supervision.retuning import transfer

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
def rewritten(bag, entries, tmp_path):
    """Writes the bag again with other messages, under its own configuration."""
    configuration = read_context(bag).configuration

    def write(changed=entries, **facts):
        return recorded_run.write(tmp_path / 'changed', changed, configuration, **facts)

    return write


def of(entries, topic):
    return [entry for entry in entries if entry[0] == topic.resolved]


def test_every_number_is_the_same(bag):
    outcome = replay(bag)
    assert outcome.difference is None
    assert outcome.remarks == ()
    compared = {one.topic.rsplit('/', 1)[-1]: one.values for one in outcome.comparisons}
    assert compared == {
        'commands': 2 * SAMPLES,
        'tracking_error': 6 * SAMPLES,
        'reference': 4 * SAMPLES,
        'learning': 9 * SAMPLES,  # three parameters, two biases, two disturbances, two more
        'monitor': 11 * 101,  # two ratios, two distances, five estimates, two more
    }
    assert [one.left_out for one in outcome.comparisons if one.left_out] == ['compute_time']


@pytest.mark.parametrize('law', ['backstepping', 'slotine_li'])
def test_every_law_and_a_compressed_bag_replay(tmp_path, law):
    path = recorded_run.record(tmp_path / law, 0.3, 'zstd', law=law)
    assert replay(path).difference is None


def test_trajectories_that_were_sent_are_told_of(entries, rewritten):
    sent = [JOINT_TRAJECTORY.resolved, JOINT_TRAJECTORY.type, START, b'']
    outcome = replay(rewritten([*entries, sent]))
    assert 'trajectories were sent' in outcome.remarks[0]


def test_a_bound_that_narrows_replays_too(tmp_path):
    funnel = {'barrier.initial_bound': [0.02, 0.01], 'barrier.funnel_rate': 5.0}
    outcome = replay(recorded_run.record(tmp_path / 'bag', 0.3, **funnel))
    assert outcome.difference is None
    assert (outcome.changes, outcome.remarks) == (0, ())


def test_the_learning_has_begun_in_that_bag(bag):
    # Else the replay above would not have seen the composite learning at all.
    content = read_content(bag)
    _, values = decode_joint_states(content.topics[LEARNING], ('latched',), ('position',))
    assert values[-1, 0, 0] == 1.0


@pytest.mark.parametrize(
    ('topic', 'at', 'field'),
    [
        (COMMANDS, -8, 'effort of joint2'),
        (TRACKING_ERROR, -8, 'effort of joint2'),
        (REFERENCE, -8 - 4, 'velocity of joint2'),  # behind it the empty effort
        (LEARNING, -16, 'latched'),  # behind it compute_time, velocity and effort
    ],
)
def test_one_flipped_bit_is_found_and_named(entries, rewritten, topic, at, field):
    changed = [list(entry) for entry in entries]
    raw = bytearray(of(changed, topic)[700][3])
    at = at if topic is not LEARNING else at - 8
    raw[at] ^= 1
    of(changed, topic)[700][3] = bytes(raw)
    difference = replay(rewritten(changed)).difference
    assert difference.topic == topic.resolved
    assert difference.field == field
    assert difference.stamp == START + 700 * MILLISECOND
    assert difference.time == pytest.approx(0.7)
    assert difference.recorded != difference.replayed
    assert difference.recorded == pytest.approx(difference.replayed, abs=1e-12)
    assert f'recorded {difference.recorded!r}, replayed {difference.replayed!r}' in str(difference)


def test_the_earliest_of_several_differences_is_told(entries, rewritten):
    changed = [list(entry) for entry in entries]
    for topic, k in ((COMMANDS, 500), (TRACKING_ERROR, 400), (LEARNING, 600)):
        of(changed, topic)[k][3] = of(entries, topic)[k - 100][3][:20] + bytes(
            len(of(entries, topic)[k][3]) - 20
        )
    for topic, k in ((TRACKING_ERROR, 400), (LEARNING, 600)):
        of(changed, topic)[k][3] = of(entries, topic)[k][3][:-40] + bytes(40)
    difference = replay(rewritten(changed)).difference
    assert (difference.topic, difference.stamp) == (
        TRACKING_ERROR.resolved,
        START + 400 * MILLISECOND,
    )


def test_repeated_and_unanswered_states_are_passed_over(entries, rewritten):
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
    outcome = replay(rewritten(changed))
    assert outcome.difference is None
    assert outcome.states.passed_over == 2
    assert outcome.states.stamp.size == SAMPLES


def test_a_lost_state_ends_the_replay_there_and_says_so(entries, rewritten):
    lost = of(entries, JOINT_STATES)[500]
    outcome = replay(rewritten([entry for entry in entries if entry is not lost]))
    assert outcome.difference is None
    assert outcome.states.stamp.size == 500
    assert any(f'stamp {START + 500 * MILLISECOND} ns' in remark for remark in outcome.remarks)


def test_a_recording_that_began_late_is_recognised(entries, rewritten):
    late = [entry for entry in entries if entry[2] > START + 200 * MILLISECOND]
    said = '800 written, 0 missed, 201 sent before the recorder heard them'
    outcome = replay(rewritten(late, **{'messages /joint_states': said}))
    assert outcome.difference.time == 0.0
    lost = '/joint_states: 0 missed, 201 sent before the recorder heard them'
    assert f'the recorder did not get all of {lost}' in outcome.remarks
    assert any('begun after the controller' in remark for remark in outcome.remarks)


def test_without_its_telemetry_the_torques_are_still_compared(entries, rewritten):
    told = {COMMANDS.resolved, JOINT_STATES.resolved}
    outcome = replay(rewritten([entry for entry in entries if entry[0] in told]))
    assert [one.topic for one in outcome.comparisons] == [COMMANDS.resolved]
    assert outcome.difference is None


def test_commands_that_cannot_be_told_apart_are_left_out_in_words(entries, rewritten):
    lost = of(entries, COMMANDS)[500]
    outcome = replay(rewritten([entry for entry in entries if entry is not lost]))
    commands = next(one for one in outcome.comparisons if one.topic == COMMANDS.resolved)
    assert commands.left_out.startswith('1000 commands for 1001 answered states')
    assert outcome.difference is None


def event(node, name, value):
    types = typestore().types
    content = types['rcl_interfaces/msg/ParameterValue'](
        type=8,
        bool_value=False,
        integer_value=0,
        double_value=0.0,
        string_value='',
        byte_array_value=np.zeros(0, np.uint8),
        bool_array_value=np.zeros(0, bool),
        integer_array_value=np.zeros(0, np.int64),
        double_array_value=np.array(value),
        string_array_value=[],
    )
    message = types[PARAMETER_EVENTS.type](
        stamp=types['builtin_interfaces/msg/Time'](0, 0),
        node=node,
        new_parameters=[],
        changed_parameters=[types['rcl_interfaces/msg/Parameter'](name=name, value=content)],
        deleted_parameters=[],
    )
    return bytes(typestore().serialize_cdr(message, PARAMETER_EVENTS.type))


def retuned(bag):
    """The bag as it would be, had feedback.gain and barrier.bound been changed at 0.5 s."""
    config = recorded_run.loop_config().controller
    content = read_content(bag)
    stamp, values = decode_joint_states(content.topics[JOINT_STATES], config.joints)
    telemetry = ControllerTelemetry(config.joints, estimate_names(config))
    law = controller_of(config)
    before = START - MILLISECOND
    for k, now in enumerate(stamp.tolist()):
        yield [JOINT_STATES.resolved, JOINT_STATES.type, now, content.topics[JOINT_STATES].raw[k]]
        if k == 0:
            told = telemetry.bound(now, np.array(config.barrier.bound), np.array([20.0, 20.0]))
            yield [told[0].resolved, told[0].type, now, told[1]]
        if k == 500:
            for name, value, bound in (
                ('feedback.gain', [50.0, 25.0], (0.002, 0.002)),
                ('barrier.bound', [0.004, 0.003], (0.004, 0.003)),
            ):
                config = change(config, {name: tuple(value)})
                transfer(law, config, (now - MILLISECOND - START) * 1e-9, values[k - 1].ravel())
                raw = event('/blf_dsc_controller', name, value)
                yield [PARAMETER_EVENTS.resolved, PARAMETER_EVENTS.type, now, raw]
                raw = event('/another_node', 'feedback.gain', [1.0, 1.0])
                yield [PARAMETER_EVENTS.resolved, PARAMETER_EVENTS.type, now, raw]
                told = telemetry.bound(now - MILLISECOND, np.array(bound), np.array([20.0, 20.0]))
                yield [told[0].resolved, told[0].type, now, told[1]]
        law.update((now - START) * 1e-9, (now - before) * 1e-9, values[k].ravel())
        before = now
        for topic, raw in telemetry.sample(now, law.sample, 0.0):
            yield [topic.resolved, topic.type, now, raw]


def test_parameters_changed_on_the_way_are_replayed_where_they_took_effect(bag, rewritten):
    messages = list(retuned(bag))
    outcome = replay(rewritten(messages))
    assert outcome.changes == 2
    assert outcome.difference is None


def test_changes_that_the_bag_does_not_hold_are_told_of(bag, rewritten):
    messages = [entry for entry in retuned(bag) if entry[0] != PARAMETER_EVENTS.resolved]
    outcome = replay(rewritten(messages))
    assert outcome.difference.stamp == START + 500 * MILLISECOND
    assert outcome.remarks[0].startswith('2 changes of parameters took effect, but the bag tells')


def test_another_configuration_answers_in_open_loop(bag):
    config = recorded_run.loop_config().controller
    same = answer(bag, config)
    assert np.abs(same.difference).max() == 0.0
    stiffer = replace(config, feedback=replace(config.feedback, gain=(70.0, 20.0)))
    found = answer(bag, stiffer)
    # By (28) alone, as long as nothing is adapted: at the first sample the gain times xi2.
    expected = -10.0 * found.replayed.told.xi2[0, 0]
    assert found.difference[0, 0] == pytest.approx(expected, rel=1e-9)
    assert found.difference[0, 1] == 0.0
    assert found.error_ratio == pytest.approx(same.error_ratio)


def test_open_loop_learns_from_the_torques_that_acted(bag):
    config = recorded_run.loop_config().controller
    softer = replace(config, feedback=replace(config.feedback, gain=(6.0, 2.0)))
    estimate = answer(bag, softer).replayed.told.estimate
    own = answer(bag, config).replayed.told.estimate
    # The window is of the same arm under the same torques, so both find the same parameters.
    assert estimate[-1, :3] == pytest.approx(own[-1, :3], rel=0.05)


def test_a_bag_without_configuration_is_told(entries, tmp_path):
    path = recorded_run.write(tmp_path / 'bag', entries)
    with pytest.raises(BagError, match='--config recommended'):
        replay(path)


def test_a_bag_without_the_controller_has_nothing_to_compare(entries, rewritten):
    with pytest.raises(NothingToCompareError, match=r'/joint_states \(1001\)'):
        replay(rewritten(of(entries, JOINT_STATES)))


def test_another_version_is_remarked(bag, monkeypatch):
    monkeypatch.setattr('blf_dsc_controller.replay.recorded.__version__', '9.9.9')
    outcome = replay(bag)
    assert outcome.difference is None
    assert any('recorded by version 0.1.0 and replayed by 9.9.9' in one for one in outcome.remarks)


def test_a_configuration_of_another_version_is_refused_as_that(entries, tmp_path, monkeypatch):
    config = dumps({'blf_dsc_controller': recorded_run.loop_config().controller})
    newer = config + '    barrier.shape: 2.0\n'
    path = recorded_run.write(tmp_path / 'bag', entries, newer)
    with pytest.raises(ConfigurationError, match=r'barrier\.shape'):
        replay(path)
    monkeypatch.setattr(contexts, '__version__', '9.9.9')
    with pytest.raises(ConfigurationError, match=r'yaml by version 0\.1\.0, not 9\.9\.9'):
        replay(path)


def test_the_bag_of_another_robot_is_told_by_its_joints(entries, rewritten):
    states = of(entries, JOINT_STATES)
    decoder = JointStateDecoder(('joint1', 'joint2'))
    other = JointStateEncoder(('wheel', 'arm'))
    foreign = []
    for topic, type_name, at, raw in states:
        stamp = decoder.decode(raw)
        told = other.encode(stamp, decoder.position, decoder.velocity, decoder.effort)
        foreign.append([topic, type_name, at, told])
    with pytest.raises(UnreadableMessageError, match=r"'joint1' is not in .*names wheel, arm"):
        replay(rewritten(foreign))


@pytest.mark.parametrize('in_step', [True, False])
def test_a_safe_torque_that_does_not_match_may_be_another_states_in_real_time(in_step):
    """Of four commands the law's are two; the last is of a state that the replay does not know."""
    torque = np.arange(8.0).reshape(4, 2)
    encoder = Float64MultiArrayEncoder(2)
    raw = [encoder.encode(row) for row in (*torque[:3], torque[3] + 1.0)]
    content = Content({COMMANDS: TopicMessages(COMMANDS.resolved, COMMANDS.type, [0] * 4, raw)}, {})
    of_law = np.array([True, True, False, False])
    stamp = START + np.arange(4) * MILLISECOND
    commands = Commands(stamp, torque, of_law, 4, '', in_step)
    states = States(stamp[:2], torque[:2])
    columns = {COMMANDS: {'effort of joint1': torque[:2, 0], 'effort of joint2': torque[:2, 1]}}
    (found,) = compare(content, states, columns, (), commands)
    if in_step:
        assert found.difference.stamp == stamp[3]
        assert found.left_out == ''
    else:
        assert found.difference is None
        assert found.values == 2 * 3
        assert found.left_out.startswith('1 torques from one on that does not match')

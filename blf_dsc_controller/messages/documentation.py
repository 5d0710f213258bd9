# SPDX-License-Identifier: Apache-2.0
"""Generator of the page on all topics.

`python -m blf_dsc_controller.messages.documentation doc/topics.md` writes it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.topics import Quality, Topic

_PREFACE = """\
# Topics

Names are the defaults; those with the name of a node are private to it. Joints are matched by name;
stamps are the plant's time. A JointState without joints holds named values: `position` has the
values, `name` their names. *Kept* is the number of messages that a publisher keeps (for
`joint_trajectory`: the subscriber); *latched* topics send them to late subscribers, too. All topics
are reliable. `reference`, `tracking_error` and `learning` are published while any of the three has
a subscriber (checked every 10th sample).

This page is generated: `python -m blf_dsc_controller.messages.documentation doc/topics.md`.

| topic | type | kept | when | content |
| --- | --- | --- | --- | --- |
"""

_NAMED = 'by name: '
_OFTEN = 'every `telemetry.decimation`-th sample'
_ABOUT = {
    topics.JOINT_STATES: (
        'each sample',
        'position and velocity as measured; effort: torque applied since the previous sample',
    ),
    topics.COMMANDS: ('each sample', 'torque [N m], in the order of `joints`'),
    topics.REFERENCE: (_OFTEN, 'position and velocity of the reference'),
    topics.TRACKING_ERROR: (
        'each sample',
        r'position: $\xi_1$ [rad], velocity: $\xi_2$ [rad/s], effort: torque after saturation',
    ),
    topics.LEARNING: (
        _OFTEN,
        (
            f'{_NAMED}each estimate, `{topics.DISTURBANCE}<joint>` (with the learned friction), '
            f'`{topics.LAMBDA_MIN}`, `{topics.LATCHED}`, `{topics.MODEL_CHANGES}` (number of '
            f'detected changes of the arm), `{topics.COMPUTE_TIME}` [s]'
        ),
    ),
    topics.JOINT_TRAJECTORY: ('subscribed', 'new reference: [references.md](references.md)'),
    topics.JOURNAL: (
        'each event',
        (
            'JSON: activations, trajectories, changed parameters, stops, each with the joint state '
            'that it follows; see [operation.md](operation.md#the-journal)'
        ),
    ),
    topics.BOUND: ('at the start, on change', 'position: $k_c$ [rad], effort: torque limit'),
    topics.STATE: ('on change', 'starting, approaching, tracking, or stopped and why'),
    topics.MONITOR: (
        'every 10th sample',
        (
            f'{_NAMED}`{topics.RATIO}<joint>`, `{topics.DISTANCE}<joint>` [rad], estimates (NaN: a '
            f'rejected disturbance column), `{topics.LAMBDA_MIN}`, `{topics.LATCHED}`; where '
            f'`truth.parameters` are given, the Lyapunov function `{topics.LYAPUNOV}<term>` [J] '
            'and its bound'
        ),
    ),
    topics.TRUTH: ('every 10th sample', f'{_NAMED}the true values, named as the estimates'),
    topics.CHANGES: (
        'on change',
        (
            'JSON: `parameters` of the plant changed while it runs, and the `stamp` [ns] of the '
            'first sample with them'
        ),
    ),
    topics.TIMING: (
        'each sample in real time',
        f'{_NAMED}`{topics.LATENCY}` and `{topics.LATENESS}` [s], `{topics.LATE_STEPS}`',
    ),
    topics.ROBOT_DESCRIPTION: ('at the start', 'URDF of the simulated arm'),
    topics.MARKERS: (
        'every `period`',
        'reference as a ghost, bound around its tip, torques: for RViz and Foxglove',
    ),
    topics.CLOCK: ('each sample, if `publish_clock`', "the plant's time"),
    topics.DIAGNOSTICS: ('every second, on change', 'health of controller, plant and watchdog'),
}


def topic_page() -> str:
    """Return the Markdown page of all topics."""
    return _PREFACE + ''.join(map(_row, _all()))


def _all() -> list[Topic]:
    """Return every topic of the package, those of the control loop first."""
    return [one for one in vars(topics).values() if isinstance(one, Topic)]


def _row(topic: Topic) -> str:
    when, content = _ABOUT[topic]
    kind = topic.type.replace('/msg/', '/')
    cells = f'`{_written(topic)}`', kind, _kept(topic.offered), when, content
    return f'| {" | ".join(cells)} |\n'


def _written(topic: Topic) -> str:
    return topic.resolved if topic.name.startswith('/') else topic.relative


def _kept(quality: Quality) -> str:
    latched = ', latched' if quality.durability == 'transient_local' else ''
    return f'{quality.depth}{latched}'


if __name__ == '__main__':
    Path(sys.argv[1]).write_text(topic_page(), encoding='utf-8')

# SPDX-License-Identifier: Apache-2.0
"""The bag of an offline run: the topics and messages that the nodes would have published."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blf_dsc_controller.bags.writer import BagWriter
from blf_dsc_controller.configuration.controller import ControllerConfig
from blf_dsc_controller.configuration.plant import PlantConfig
from blf_dsc_controller.configuration.schema import flatten
from blf_dsc_controller.law.factory import estimate_names
from blf_dsc_controller.law.telemetry import (
    DECIMATION,
    ControllerTelemetry,
    Message,
    PlantTelemetry,
)
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.journal import encode_change
from blf_dsc_controller.simulation.loop import START, Record


def write_bag(
    path: Path,
    record: Record,
    config: ControllerConfig,
    compression: str,
    plant: PlantConfig | None = None,
) -> None:
    """Write a run as a bag, with the configuration of the controller and, if given, of the plant.

    `compression` is `none` or `zstd`. Raises BagError if `path` exists already.
    """
    with BagWriter(path, compression=compression, flush_interval=None) as bag:
        handles: dict[topics.Topic, int] = {}
        sent: Counter[topics.Topic] = Counter()

        def write(stamp: int, topic: topics.Topic, raw: bytes) -> None:
            if topic not in handles:
                handles[topic] = bag.add_topic(topic.resolved, topic.type, [topic.offered])
            sent[topic] += 1
            bag.write(handles[topic], raw, stamp, sequence=sent[topic])

        if plant is not None:
            write(START, topics.CHANGES, encode_change(START, flatten(plant), configured=True))
        for stamp, message in _messages(record, config):
            write(stamp, *message)


def _messages(record: Record, config: ControllerConfig) -> Iterator[tuple[int, Message]]:
    plant = PlantTelemetry(config.joints, record.parameters)
    controller = ControllerTelemetry(config, estimate_names(config))
    limit = np.array(config.torque.limit)
    events = deque(record.journal.pending)
    ratio = np.zeros(len(record.config.joints))
    for row, elapsed in enumerate(record.stamps.tolist()):
        stamp = START + elapsed
        sample = record.sample(row)
        while events and events[0].messages <= row:
            yield stamp, (topics.JOURNAL, events.popleft().encode())
        yield stamp, plant.joint_states(stamp, record.measurements[row])
        yield stamp, controller.command(sample.torque)
        if row % DECIMATION == 0:
            yield stamp, plant.truth(stamp, record.truths[row])
        if np.isnan(sample.qr[0]):  # stopped
            continue
        np.maximum(ratio, np.abs(sample.xi1) / sample.bound, out=ratio)
        for message in controller.sample(stamp, sample, limit, ratio, float('nan')):
            yield stamp, message
    for event in events:
        yield START + int(record.stamps[-1]), (topics.JOURNAL, event.encode())

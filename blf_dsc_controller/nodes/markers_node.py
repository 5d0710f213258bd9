# SPDX-License-Identifier: Apache-2.0
"""The node `arm_markers`: the reference as a ghost, the bound at its tip, torques as arrows.

It polls for the newest messages a few times a second instead of handling each in a callback.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from blf_dsc_controller.arms.geometry import skeleton, tip_radius
from blf_dsc_controller.configuration.nodes import MarkersConfig
from blf_dsc_controller.messages import topics
from blf_dsc_controller.messages.codecs import JointStateDecoder, MessageError
from blf_dsc_controller.nodes.endpoints import create_steady_timer, qos_profile
from blf_dsc_controller.nodes.parameters import declare
from blf_dsc_controller.nodes.process import PlainNode, run
from blf_dsc_controller.nodes.raw_subscriptions import RawSubscriptions

_DEPTH = 1  # only the newest message matters
_GHOST = ColorRGBA(r=0.2, g=0.8, b=0.3, a=0.5)
_BOUND = ColorRGBA(r=0.9, g=0.7, b=0.1, a=0.5)
_TORQUE = ColorRGBA(r=0.9, g=0.2, b=0.2, a=0.9)
_WIDTH = 0.01  # m


class MarkersNode(PlainNode):
    """Publishes `~/markers`; raises ConfigurationError if a parameter is invalid."""

    def __init__(self, **options: Any) -> None:
        super().__init__(topics.MARKERS_NODE, **options)
        self._config = declare(self, MarkersConfig)
        joints = self._config.joints
        self._chain = self._config.chain
        watched = (topics.JOINT_STATES, topics.REFERENCE, topics.BOUND)
        self._decoders = [JointStateDecoder(joints, required=('position',)) for _ in watched]
        self._raw_subscriptions = RawSubscriptions(self, _DEPTH)
        for handle, topic in enumerate(watched):
            name = self.resolve_topic_name(topic.relative)
            self._raw_subscriptions.subscribe(name, topic.type, [topic.offered], handle)
        quality = qos_profile(topics.MARKERS.offered)
        self._markers = self.create_publisher(MarkerArray, topics.MARKERS.name, quality)
        create_steady_timer(self, self._config.period, self._draw)

    def close(self) -> None:
        """End the subscriptions."""
        self._raw_subscriptions.close()

    def _draw(self) -> None:
        for message in self._raw_subscriptions.take():
            try:
                self._decoders[message.handle].decode(message.raw)
            except MessageError as error:
                self.get_logger().warning(f'not drawn: {error}', throttle_duration_sec=10.0)
        state, reference, bound = self._decoders
        markers = [
            *self._torques(state.position, state.effort),
            *self._ghost(reference.position, bound.position),
        ]
        if markers:
            self._markers.publish(MarkerArray(markers=markers))

    def _torques(self, q: np.ndarray, torque: np.ndarray) -> list[Marker]:
        """Return the torques as arrows along the joint axes."""
        if not (np.isfinite(q).all() and np.isfinite(torque).all()):
            return []
        arrows = []
        corners, axes = skeleton(self._chain, q)
        lengths = self._config.torque_scale * torque[:, None] * axes
        for number, (at, along) in enumerate(zip(corners[1:-1], lengths, strict=True)):
            arrow = self._marker('torque', number, Marker.ARROW, _TORQUE)
            arrow.scale.x, arrow.scale.y, arrow.scale.z = _WIDTH, 3 * _WIDTH, 3 * _WIDTH
            arrow.points = [_point(at), _point(at + along)]
            arrows.append(arrow)
        return arrows

    def _ghost(self, q: np.ndarray, bound: np.ndarray) -> list[Marker]:
        """Return the arm at its reference, and the ball that its tip must stay in."""
        if not np.isfinite(q).all():
            return []
        corners = skeleton(self._chain, q)[0]
        ghost = self._marker('reference', 0, Marker.LINE_STRIP, _GHOST)
        ghost.scale.x = _WIDTH
        ghost.points = [_point(corner) for corner in corners]
        if not np.isfinite(bound).all():
            return [ghost]
        ball = self._marker('bound', 0, Marker.SPHERE, _BOUND)
        ball.pose.position = _point(corners[-1])
        diameter = 2.0 * tip_radius(self._chain, q, bound)
        ball.scale.x = ball.scale.y = ball.scale.z = diameter
        return [ghost, ball]

    def _marker(self, kind: str, number: int, shape: int, colour: ColorRGBA) -> Marker:
        marker = Marker(ns=kind, id=number, type=shape, action=Marker.ADD, color=colour)
        marker.header.frame_id = self._config.frame
        marker.pose.orientation.w = 1.0
        return marker


def _point(at: np.ndarray) -> Point:
    x, y, z = at.tolist()
    return Point(x=x, y=y, z=z)


main = partial(run, MarkersNode)

if __name__ == '__main__':
    sys.exit(main())

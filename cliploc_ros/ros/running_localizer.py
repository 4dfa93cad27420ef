# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The localizer that takes poses from `initialpose`: AMCL, slam_toolbox, or any other.

`initialpose` is volatile: the publisher may have discovered a subscription that has not yet
discovered the publisher. DDS also reports a localizer that was killed or hangs as alive. Only the
pose that the localizer shows afterwards proves that it took the given pose.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.topic_endpoint_info import TopicEndpointInfo

from cliploc_ros.core.geometry.transforms import TAKEN, pose_error
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import pose_with_covariance_msg
from cliploc_ros.ros.inputs.coordinate_frames import (
    CoordinateFrames,
    NoTransformError,
    matrix_from_msg,
)
from cliploc_ros.ros.parameters import AUTO, RelocalizerParameters

_TYPE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


class RunningLocalizer:
    """Gives poses to the localizer on `initialpose`, and receives the poses that it shows.

    With ``localizer_pose: auto``, the localizer is the node that subscribes to `initialpose` and
    publishes a pose. If that node is silent or publishes none, its transform from the map shows
    where it is. `transforms` looks up the rest of the way to the robot.
    """

    def __init__(self, node: Node, transforms: CoordinateFrames) -> None:
        self._node, self._transforms = node, transforms
        #: Notified when the localizer appears or shows a pose
        self.changed = threading.Condition()
        #: Full name of the topic of its pose; empty: unknown, or the pose is in tf
        self.pose_topic = ''
        self.shown_at = -math.inf  #: When its last pose was received (monotonic clock) [s]
        self._parameters: RelocalizerParameters | None = None  # None while closed
        # The last given pose, and what the localizer has shown since.
        self._given: PoseWithCovarianceStamped | None = None
        self._shown: PoseWithCovarianceStamped | None = None
        self._transform: TransformStamped | None = None
        self._listeners: list[Callable[[PoseWithCovarianceStamped], None]] = []
        self._finding = threading.Lock()
        self._subscription: qos.AdaptiveSubscription | None = None
        self._publisher = node.create_publisher(
            PoseWithCovarianceStamped, 'initialpose', qos.POSE,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: self.wake()))
        transforms.listeners.append(self._hear_transform)

    def on_shown(self, listener: Callable[[PoseWithCovarianceStamped], None]) -> None:
        """Register a non-blocking function that is called with each pose of the localizer."""
        self._listeners.append(listener)

    def open(self, parameters: RelocalizerParameters) -> None:
        """Subscribe to the pose of the localizer, as soon as it is found."""
        self._parameters = parameters
        self.find()

    def close(self) -> None:
        """Unsubscribe, and forget the localizer."""
        with self._finding:
            self._parameters = self._given = None
            self._listen('')

    def wake(self) -> None:
        """Notify those who wait for a change."""
        with self.changed:
            self.changed.notify_all()

    def missing(self) -> str:
        """Return why there is no localizer, and what to do; empty if there is one."""
        if not self._publisher.get_subscription_count():
            return (f'nobody subscribes to {self._publisher.topic_name}: start the localizer '
                    '(AMCL), then retry; without one, set require_localizer: false')
        return self.find()

    def find(self) -> str:
        """Find the localizer's pose, and listen to it; return what is wrong, empty if nothing."""
        with self._finding:
            parameters = self._parameters
            if parameters is None or not parameters.localizer_pose:
                return ''
            if parameters.localizer_pose != AUTO:
                topic = str(self._node.resolve_topic_name(parameters.localizer_pose))
            else:
                topic, problem = self._discover()
                if problem:
                    return problem
            self._listen(topic)
            return not_one_publisher(topic, self._node.get_publishers_info_by_topic(topic)) \
                if topic else self._open_tf(parameters)

    def give(self, pose: PoseWithCovarianceStamped) -> None:
        """Publish a pose on `initialpose`, and forget what the localizer has shown before."""
        with self.changed:
            is_silent = self._given is not None and self.shown() is None
            self._given, self._shown, self._transform = pose, None, None
        parameters = self._parameters
        if is_silent and parameters is not None and parameters.localizer_pose == AUTO:
            self._open_tf(parameters)
        self._publisher.publish(pose)

    def shown(self) -> PoseWithCovarianceStamped | None:
        """Return the newest pose that it has shown since the last given one; None without one.

        A transform is extended by odometry at the stamp of the given pose: there it may be
        compared although the robot has driven off.
        """
        given, transform, parameters = self._given, self._transform, self._parameters
        if self._shown is not None or transform is None or given is None or parameters is None:
            return self._shown
        with suppress(NoTransformError):
            return pose_with_covariance_msg(
                given.header, matrix_from_msg(transform.transform) @ self._transforms.lookup(
                    transform.child_frame_id, parameters.base_frame, given.header.stamp, 0.0),
                np.zeros((6, 6)))
        return None

    def silence(self, times: int) -> str:
        """Return what to do about a localizer that shows no pose after `times` given ones."""
        source = f'message on {self.pose_topic}' if self.pose_topic else 'transform from the map'
        return (f'no {source} since initialpose was published {times} times: '
                f'{silence_of_localizer(self._node)}')

    def where(self) -> str:
        """Return where the localizer shows its pose, for a message."""
        return f'on {self.pose_topic}' if self.pose_topic else 'in tf, or it is not checked'

    def _discover(self) -> tuple[str, str]:
        """Return the topic of its pose, empty if it is in tf alone; and what is wrong."""
        node, given_on = self._node, self._publisher.topic_name
        inputs = given_on, node.resolve_topic_name('~/prior')
        takers = node.get_subscriptions_info_by_topic(given_on)
        shown = list[tuple[str, str]]()
        for name, space in sorted({(one.node_name, one.node_namespace) for one in takers}):
            with suppress(NodeNameNonExistentError):  # it has ended, or is not fully discovered
                shown += [(f'{space.rstrip("/")}/{name}', topic) for topic, types in
                          node.get_publisher_names_and_types_by_node(name, space)
                          if _TYPE in types and topic not in inputs]
        if len(shown) > 1:
            return '', (f'several localizers: {", ".join(" shows ".join(one) for one in shown)}; '
                        'stop all but one, or set localizer_pose to its topic')
        if shown:
            return shown[0][1], ''
        in_tf = _names(takers) & _names(node.get_publishers_info_by_topic(
            node.resolve_topic_name('/tf')))
        if len(in_tf) == 1:
            return '', ''
        names = ', '.join(sorted(in_tf or _names(takers)))
        return '', (f'several localizers, {names}: stop all but one' if in_tf else
                    f'no node that subscribes to {given_on} shows a pose ({names}): start the '
                    'localizer (AMCL); if it has just started, retry; or set localizer_pose')

    def _listen(self, topic: str) -> None:
        """Listen to this topic in place of the former one."""
        if topic == self.pose_topic:
            return
        if self._subscription is not None:
            self._subscription.destroy()
        # Volatile, so that no earlier pose of the localizer is delivered.
        self._subscription = qos.AdaptiveSubscription(
            self._node, PoseWithCovarianceStamped, topic, self._hear, qos.POSE) if topic else None
        self.pose_topic = topic

    def _open_tf(self, parameters: RelocalizerParameters) -> str:
        """Listen to transforms; return why they cannot show the localizer's pose, else ''."""
        remedy = 'set localizer_pose to the topic of its pose'
        if parameters.publish_tf or not parameters.base_frame:
            return (f'the localizer shows its pose in tf alone: {remedy}, or '
                    f'{"publish_tf: false" if parameters.publish_tf else "set base_frame"}')
        try:
            self._transforms.open('the localizer shows its pose in tf alone', remedy=remedy)
        except NoTransformError as error:
            return str(error)
        return ''

    def _hear(self, shown: PoseWithCovarianceStamped) -> None:
        with self.changed:
            parameters = self._parameters
            if parameters is not None and parameters.localizer_pose == AUTO \
                    and shown == self._given:
                return  # a relay, as from initialpose to set_pose, is no localizer
            self._shown, self.shown_at = shown, time.monotonic()
            self.changed.notify_all()
        for listener in self._listeners:
            listener(shown)

    def _hear_transform(self, transform: TransformStamped, is_static: bool) -> None:
        given, parameters = self._given, self._parameters
        if is_static or given is None or parameters is None or parameters.publish_tf \
                or parameters.localizer_pose != AUTO or not _same_frame(transform, given):
            return
        with self.changed:
            self._transform = transform
            self.changed.notify_all()


def not_one_publisher(topic: str, publishers: Sequence[TopicEndpointInfo]) -> str:
    """Return why the topic of the localizer's pose has no single source; empty if it has one."""
    names = _names(publishers)
    if len(names) > 1:
        return f'{len(names)} nodes publish {topic}: {", ".join(sorted(names))}; stop all but one'
    return '' if names else (
        f'nobody publishes {topic}: start the localizer (AMCL); if it has just started, retry; or '
        'set localizer_pose to the topic of its pose')


def silence_of_localizer(node: Node) -> str:
    """Return what to do about a localizer that publishes no pose."""
    topic = node.resolve_topic_name('map')
    no_map = '' if node.count_publishers(topic) else (
        f'nobody publishes {topic}, without which AMCL has no pose: start its map server; ')
    return f'{no_map}check that the localizer is active and receives scans'


def difference(given: PoseWithCovarianceStamped, shown: PoseWithCovarianceStamped) -> str:
    """Return how the localizer's pose `shown` differs from the given one; empty if they agree."""
    if not _same_frame(given, shown):
        return (f"is in frame '{shown.header.frame_id}', the pose in '{given.header.frame_id}': "
                "correct the map's frame_id")
    covariance = np.array(given.pose.covariance).reshape(6, 6)
    deviation_m = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    near = TAKEN.wider(3.0 * deviation_m, math.degrees(3.0 * math.sqrt(covariance[5, 5])))
    if near.agree(_planar(given), _planar(shown)):
        return ''
    if not np.isfinite(_planar(shown)).all():
        return 'has NaN'
    distance_m, angle_deg = pose_error(_planar(given), _planar(shown))
    return (f'differs from it by {distance_m:.2f} m and {angle_deg:.0f} degrees (limits '
            f'{near.distance_m:.2f} and {near.angle_deg:.0f})')


def _names(endpoints: Sequence[TopicEndpointInfo]) -> set[str]:
    """Return the nodes; a localizer that was killed and started again may be listed twice."""
    return {f'{one.node_namespace.rstrip("/")}/{one.node_name}' for one in endpoints}


def _same_frame(one: PoseWithCovarianceStamped | TransformStamped,
                other: PoseWithCovarianceStamped) -> bool:
    return bool(one.header.frame_id.lstrip('/') == other.header.frame_id.lstrip('/'))


def _planar(msg: PoseWithCovarianceStamped) -> NDArray[np.float64]:
    """Return the part of a pose that AMCL uses, x, y and yaw, as a transform (4, 4)."""
    p, q = msg.pose.pose.position, msg.pose.pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    planar = np.eye(4)
    planar[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    planar[:2, 3] = p.x, p.y
    return planar

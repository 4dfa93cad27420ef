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
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node, NodeNameNonExistentError

from cliploc_ros.core.geometry.transforms import TAKEN, pose_error
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import matrix_from_msg, pose_with_covariance_msg
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.parameters import AUTO, RelocalizerParameters

_TYPE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
# Localizers broadcast their former transform until the next scan, which comes within this time.
_SCAN_S = 0.5


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
        self.shown_at = -math.inf  #: When its topic was last heard (monotonic clock) [s]
        #: Called with each pose on its topic; must not block
        self.listeners: list[Callable[[PoseWithCovarianceStamped], None]] = []
        self._name, self._parameters = '', RelocalizerParameters()  # no name while closed
        # The last given pose and when it was given, what the localizer has shown since, and
        # whether its transforms count.
        self._given: PoseWithCovarianceStamped | None = None
        self._shown: PoseWithCovarianceStamped | None = None
        self._transform: TransformStamped | None = None
        self._given_at, self._is_in_tf = -math.inf, False
        self._finding = threading.Lock()
        self._subscription: qos.AdaptiveSubscription | None = None
        self._publisher = node.create_publisher(
            PoseWithCovarianceStamped, 'initialpose', qos.POSE,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: self.wake()))
        transforms.listeners.append(self._hear_transform)

    def open(self, parameters: RelocalizerParameters) -> None:
        """Subscribe to the pose of the localizer, as soon as it is found."""
        self._name, self._parameters = parameters.localizer_pose, parameters
        self.find()

    def close(self) -> None:
        """Unsubscribe, and forget the localizer."""
        self._name, self._given = '', None
        self.find()

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
            takers = self._nodes('subscriptions', self._publisher.topic_name)
            topics = self._topics(takers)
            found = sorted((topic, name) for topic in topics
                           for name in self._nodes('publishers', topic))
            in_tf = [('tf', name) for name in sorted(takers & self._nodes(
                'publishers', self._node.resolve_topic_name('/tf')))
                if self._name == AUTO and not found]
            if len(several := found or in_tf) > 1:
                return (f'several localizers: {", ".join(f"{b} on {a}" for a, b in several)}; '
                        'stop all but one')
            self._listen(found[0][0] if found else ''.join(topics))
            if in_tf or found or not self._name:
                return self._open_tf() if in_tf else ''
            return (f'nobody publishes {", ".join(topics)}' if topics else
                    f'no subscriber of {self._publisher.topic_name} shows a pose') + (
                ': start the localizer (AMCL); if it has just started, retry; or set '
                'localizer_pose to the topic of its pose')

    def give(self, pose: PoseWithCovarianceStamped) -> None:
        """Publish a pose on `initialpose`, and forget what the localizer has shown before."""
        with self.changed:
            was_silent = self._given is not None and self.shown() is None
            self._is_in_tf = self._name == AUTO and (not self.pose_topic or was_silent)
            self._given, self._shown, self._transform = pose, None, None
            self._given_at = time.monotonic()
        if self._is_in_tf:
            self._open_tf()
        self._publisher.publish(pose)

    def shown(self) -> PoseWithCovarianceStamped | None:
        """Return the newest pose that it has shown since the last given one; None without one.

        A transform is extended by odometry at the stamp of the given pose: there it may be
        compared although the robot has driven off.
        """
        given, transform = self._given, self._transform
        if self._shown is not None or transform is None or given is None:
            return self._shown
        with suppress(NoTransformError):
            odom_from_base = self._transforms.lookup(
                transform.child_frame_id, self._parameters.base_frame, given.header.stamp, 0.0)
            return pose_with_covariance_msg(given.header, matrix_from_msg(
                transform.transform) @ odom_from_base, np.zeros((6, 6)))
        return None

    def silence(self) -> str:
        """Return what to do about a localizer that shows no pose."""
        topic = self._node.resolve_topic_name('map')
        no_map = '' if self._node.count_publishers(topic) else (
            f'nobody publishes {topic}, without which AMCL has no pose: start its map server; ')
        return f'{no_map}check that the localizer is active and receives scans'

    def _nodes(self, kind: str, topic: str) -> set[str]:
        """Return its publishers or subscriptions; after a restart, one is listed twice."""
        return {f'{one.node_namespace.rstrip("/")}/{one.node_name}' for one in getattr(
            self._node, f'get_{kind}_info_by_topic')(topic)}

    def _topics(self, takers: set[str]) -> set[str]:
        """Return the topics with poses of these nodes, or the topic that a parameter names."""
        if self._name != AUTO:
            return {self._node.resolve_topic_name(self._name)} if self._name else set()
        found = set[str]()
        for taker in takers:
            space, _, name = taker.rpartition('/')
            with suppress(NodeNameNonExistentError):  # it has ended, or is not fully discovered
                found |= {topic for topic, types in
                          self._node.get_publisher_names_and_types_by_node(name, space or '/')
                          if _TYPE in types}
        return found - {self._publisher.topic_name, self._node.resolve_topic_name('~/prior')}

    def _listen(self, topic: str = '') -> None:
        """Listen to this topic in place of the former one."""
        if topic == self.pose_topic:
            return
        if self._subscription is not None:
            self._subscription.destroy()
        # Volatile, so that no earlier pose of the localizer is delivered.
        self._subscription = qos.AdaptiveSubscription(
            self._node, PoseWithCovarianceStamped, topic, self._hear, qos.POSE) if topic else None
        self.pose_topic = topic

    def _open_tf(self) -> str:
        """Listen to transforms; return why they cannot show the localizer's pose, else ''."""
        why, remedy = 'the localizer shows its pose in tf alone', 'set localizer_pose to its topic'
        if self._parameters.publish_tf or not self._parameters.base_frame:
            return f'{why}: set base_frame, and publish_tf: false; or {remedy}'
        try:
            self._transforms.open(why, remedy=remedy)
        except NoTransformError as error:
            return str(error)
        return ''

    def _hear(self, shown: PoseWithCovarianceStamped) -> None:
        if self._name == AUTO and shown == self._given:
            return  # a relay, as from initialpose to set_pose, is no localizer
        with self.changed:
            self._shown, self.shown_at = shown, time.monotonic()
            self.changed.notify_all()
        for listener in self.listeners:
            listener(shown)

    def _hear_transform(self, transform: TransformStamped, is_static: bool) -> None:
        if self._is_in_tf and not is_static and not self._parameters.publish_tf and (
                self._given is not None and _same_frame(transform, self._given)
                and time.monotonic() > self._given_at + _SCAN_S):
            with self.changed:
                self._transform = transform
                self.changed.notify_all()


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

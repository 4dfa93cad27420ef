# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Deliver an accepted pose: to a running localizer, or as the transform map -> odom.

`initialpose` is volatile: the publisher may have discovered a subscription that has not yet
discovered the publisher. DDS also reports a localizer that was killed or hangs as alive. Only the
pose that the localizer publishes proves that it took the given pose.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as Stamp
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.time import Time
from rclpy.timer import Timer
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_msgs.msg import Header
from std_srvs.srv import Empty

from cliploc_ros.core.geometry.transforms import SAME_SPOT, TAKEN, invert_transform, pose_error
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import pose_from_msg, pose_to_msg, stamp_ns
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.inputs.odometry import MOMENT_PATIENCE_S, OdometrySource
from cliploc_ros.ros.inputs.stamps import TimeJumpError, TimeJumps
from cliploc_ros.ros.node.threads import steady_timer
from cliploc_ros.ros.parameters import RelocalizerParameters

# Least variances of x, y, z [m^2] and of the rotations [rad^2]: a centimetre and a sixth of a
# degree. AMCL draws its particles from x, y and yaw; with zero variance they would coincide.
_MIN_VARIANCES = (1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5)
# Greatest age of odometry of a robot at rest: slow sources send at 1 Hz. Not measured.
_MAX_ODOM_AGE_S = 2.0
# Longest wait for the first message of odometry that has a publisher, including discovery.
_ODOM_PATIENCE_S = 2.0
# Longest wait for odometry at the pose of the localizer, whose scan may be newer.
_CARRY_S = 0.2
_POLL_S = 0.1
# AMCL publishes a new pose after its next scan. If it has not by then, initialpose was lost.
_REPEAT_S = 1.0
# With less time left, the localizer could not publish the pose even if it took it.
_LEAST_S = 0.5
# AMCL updates with its next scan; two calls before that scan count as one. Laser scanners usually
# publish at 5 Hz or more.
_UPDATE_PERIOD_S = 0.2
_UPDATE_PATIENCE_S = 2.0
# Period of broadcasts. Each is stamped with the time of the next one, so that a lookup at the
# present time does not wait.
_PERIOD_S = 0.1
# A transform of another node counts for this time: SLAM and AMCL broadcast at 1 Hz or more.
_RIVAL_S = 3.0


class HandOffError(CliplocError):
    """The pose was not delivered to the localizer; the message says why."""


class NoLocalizerError(HandOffError):
    """There is no localizer, or it does not take poses. Another frame would not help."""


class HandOff:
    """Publishes `initialpose` for a robot at rest, and lets its localizer converge.

    `odometry` must be open: it detects motion of the robot. `transforms` looks up its frame.
    """

    def __init__(self, node: Node, odometry: OdometrySource, transforms: CoordinateFrames) -> None:
        self._node, self._odometry, self._transforms = node, odometry, transforms
        self._base_frame = ''
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        # The localizer's latest pose since initialpose was last published.
        self._shown: PoseWithCovarianceStamped | None = None
        self._shown_at = -math.inf  # when it was received (monotonic clock) [s]
        self._pose_topic = ''
        self._listeners: list[Callable[[PoseWithCovarianceStamped], None]] = []
        self._subscription: qos.AdaptiveSubscription | None = None
        self._publisher = node.create_publisher(
            PoseWithCovarianceStamped, 'initialpose', qos.POSE,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: self._wake()))
        self._updater = node.create_client(Empty, 'request_nomotion_update',
                                           callback_group=ReentrantCallbackGroup())

    def on_shown(self, listener: Callable[[PoseWithCovarianceStamped], None]) -> None:
        """Register a non-blocking function that is called with each pose of the localizer."""
        self._listeners.append(listener)

    def open(self, pose_topic: str) -> None:
        """Allow hand-overs. `pose_topic` is the topic of the localizer's pose; empty: none."""
        self._stopped.clear()
        if pose_topic:
            self._pose_topic = str(self._node.resolve_topic_name(pose_topic))
            # Volatile, so that no earlier pose of the localizer is delivered.
            self._subscription = qos.AdaptiveSubscription(
                self._node, PoseWithCovarianceStamped, pose_topic, self._hear, qos.POSE)

    def close(self) -> None:
        """Abort the current hand-over, and unsubscribe from the localizer's pose."""
        self.stop()
        if self._subscription is not None:
            self._subscription.destroy()
            self._subscription = None

    def stop(self) -> None:
        """Abort the current hand-over."""
        self._stopped.set()
        self._wake()

    def missing(self) -> str:
        """Return why there is no localizer, and what to do; empty if there is one."""
        if not self._publisher.get_subscription_count():
            return (f'nobody subscribes to {self._publisher.topic_name}: start the localizer '
                    '(AMCL), then retry; without one, set require_localizer: false')
        return '' if self._subscription is None else not_one_publisher(
            self._pose_topic, self._node.get_publishers_info_by_topic(self._pose_topic))

    def hand_over(self, pose: PoseWithCovarianceStamped, parameters: RelocalizerParameters,
                  deadline: float, received_at: float, jumps: TimeJumps) -> None:
        """Publish a pose on `initialpose` until the localizer takes it, and let it converge.

        The localizer has taken the pose when it publishes a pose that agrees, after odometry has
        carried the given pose to its stamp. `initialpose` is then not repeated. The localizer must
        still run after it has converged: it answers each update or publishes another pose, and its
        topics exist at the end.

        Parameters
        ----------
        pose : PoseWithCovarianceStamped
            Accepted, in the map's coordinate frame, with the image's stamp.
        deadline, received_at : float
            When to return at the latest, and when the image arrived (monotonic clock) [s]. If
            nothing needs to be waited for, the pose is published even after the deadline.
        jumps : TimeJumps
            Time jumps of the node's clock.

        Raises
        ------
        HandOffError
            The robot moves or may be moving, or it has moved since the image.
        NoLocalizerError
            There is no localizer, it does not take the pose, or it died afterwards.
        TimeJumpError
            Time has jumped back since the image.
        """
        self._base_frame = parameters.base_frame
        if not parameters.base_frame:
            self._node.get_logger().warning(
                "base_frame is empty, so initialpose is the camera's pose; for AMCL set "
                "base_frame to AMCL's base_frame_id", once=True)
        until = deadline - _LEAST_S  # later, a localizer could not use the pose
        # discovery of a localizer that has just started takes up to three seconds
        while parameters.require_localizer and (missing := self.missing()) \
                and not self._stopped.is_set():
            if not _left_s(until):
                raise NoLocalizerError(missing)
            with self._changed:
                self._changed.wait(min(_POLL_S, _left_s(until)))
        must_show = parameters.require_localizer and self._subscription is not None
        given, times = pose, 0
        while not times or (must_show and not self._is_shown(given, deadline)):
            # first, because with any time left a robot that moves is told to stop
            self.check_rest(parameters.max_speed_m_s, parameters.max_turn_rad_s, deadline)
            if must_show and _left_s(deadline) < _LEAST_S:
                raise NoLocalizerError(self._not_taken(given, times))
            self._check_place(pose.header.stamp, deadline)
            jumps.check(pose.header.stamp, received_at)
            if self._stopped.is_set():
                raise HandOffError('the node was deactivated during the hand-over')
            given, times = usable_pose(pose, self._node.get_clock().now()), times + 1
            self._shown = None
            self._publisher.publish(given)
        silent = self._settle(parameters.nomotion_updates, deadline)
        if must_show and (gone := silent or self.missing()):
            raise NoLocalizerError('the localizer took the pose, but has ended or hangs: '
                                   f'{gone}; see its log, then retry')
        if must_show and not self._is_taken(given, _CARRY_S):
            raise NoLocalizerError(self._not_taken(given, times))
        if silent:
            self._node.get_logger().warning(
                f'{silent}: the localizer has the pose, but may not converge while the robot is '
                'at rest', throttle_duration_sec=5.0)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _hear(self, shown: PoseWithCovarianceStamped) -> None:
        with self._changed:
            self._shown, self._shown_at = shown, time.monotonic()
            self._changed.notify_all()
        for listener in self._listeners:
            listener(shown)

    def _is_shown(self, given: PoseWithCovarianceStamped, deadline: float) -> bool:
        """Return whether the localizer's pose agrees with `given`; wait briefly for that."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._stopped.is_set() or self._is_taken(given),
                min(_REPEAT_S, _left_s(deadline)))
            return self._is_taken(given)

    def _is_taken(self, given: PoseWithCovarianceStamped, patience_s: float = 0.0) -> bool:
        """Return whether the localizer's pose agrees with `given`; wait for odometry at it."""
        shown = self._shown
        return shown is not None and not difference(
            self._carried(given, shown.header.stamp, patience_s), shown)

    def _carried(self, given: PoseWithCovarianceStamped, stamp: Stamp, patience_s: float = 0.0
                 ) -> PoseWithCovarianceStamped:
        """Return a given pose, moved by odometry to a stamp; unchanged if that is unknown."""
        pose = pose_from_msg(given.pose.pose)
        try:
            motion, frame = self._odometry.motion(given.header.stamp, stamp, patience_s)
            base_from_body = np.eye(4) if frame == self._base_frame else self._transforms.lookup(
                self._base_frame, frame, given.header.stamp, 0.0)
        except CliplocError:
            return given
        assert pose is not None  # it was accepted
        carried = deepcopy(given)
        carried.pose.pose = pose_to_msg(
            pose @ base_from_body @ motion @ invert_transform(base_from_body))
        return carried

    def _not_taken(self, given: PoseWithCovarianceStamped, times: int) -> str:
        """Return why the localizer has not taken the given pose, for a message."""
        shown, why = self._shown, 'the localizer did not take the pose: '
        if not times:
            return 'too little time is left for the localizer to take the pose: retry'
        if shown is None:
            return (f'{why}no message on {self._pose_topic} since initialpose was published '
                    f'{times} times: {silence_of_localizer(self._node)}')
        given = self._carried(given, shown.header.stamp)
        return f'{why}{self._pose_topic} {difference(given, shown)}'

    def check_rest(self, max_speed_m_s: float, max_turn_rad_s: float, deadline: float) -> None:
        """Raise HandOffError unless odometry shows that the robot is at rest.

        Without a publisher of odometry, the robot is assumed to be at rest.
        """
        odometry = self._odometry.recent(_MAX_ODOM_AGE_S, min(_ODOM_PATIENCE_S, _left_s(deadline)))
        if odometry is None:
            if not self._odometry.is_published:
                self._node.get_logger().warning(
                    f'nobody publishes {self._odometry.topic}: the robot is assumed to be at rest',
                    once=True)
                return
            raise HandOffError(f'{self._odometry.topic} has a publisher but no messages, so the '
                               'robot may be moving: check the odometry')
        left_s = _left_s(deadline)
        by_poses = self._odometry.speeds_by_poses(left_s)
        if by_poses is None and left_s < MOMENT_PATIENCE_S:
            raise HandOffError(f'{self._odometry.topic} has just begun, and too little time is '
                               'left to check that the robot is at rest: retry')
        v, w = odometry.twist.twist.linear, odometry.twist.twist.angular
        by_twist = math.hypot(v.x, v.y, v.z), math.hypot(w.x, w.y, w.z)
        if by_poses is None and by_twist == (0.0, 0.0):
            raise HandOffError(f'the speed is unknown: {self._odometry.topic} has neither a twist '
                               'nor poses with valid stamps; publish either at 1 Hz or more')
        # np.maximum propagates NaN, which fails the comparison below
        speed_m_s, turn_rad_s = np.maximum(by_twist, by_poses or (0.0, 0.0))
        if not (speed_m_s <= max_speed_m_s and turn_rad_s <= max_turn_rad_s):
            raise HandOffError(f'the robot moves at {speed_m_s:.2f} m/s and {turn_rad_s:.2f} '
                               f'rad/s (limits {max_speed_m_s:g} and {max_turn_rad_s:g}): stop it')

    def _check_place(self, stamp: Stamp, deadline: float) -> None:
        """Raise HandOffError unless the robot is still where its image was taken.

        AMCL would correct the pose by tf, but robot_localization's set_pose does not.
        """
        is_published = self._odometry.is_published
        moved = self._odometry.moved_since(
            stamp, min(_ODOM_PATIENCE_S, _left_s(deadline)) if is_published else 0.0)
        if moved is None and is_published:
            raise HandOffError(f'{self._odometry.topic} does not cover the time since the image: '
                               'stamp both by the same clock, publish at 1 Hz or more, then retry')
        distance_m, angle_deg = moved or (0.0, 0.0)
        if distance_m > SAME_SPOT.distance_m or angle_deg > SAME_SPOT.angle_deg:
            raise HandOffError(
                f'the robot has moved by {distance_m:.2f} m and {angle_deg:.0f} degrees since its '
                f'image (limits {SAME_SPOT.distance_m:g} and {SAME_SPOT.angle_deg:g}): stop it')

    def _settle(self, updates: int, deadline: float) -> str:
        """Make AMCL process some scans while the robot is at rest, as far as time allows.

        Return an error message if a call times out and AMCL publishes no pose meanwhile; else ''.
        """
        for _ in range(updates):
            timeout_s = min(_UPDATE_PATIENCE_S, _left_s(deadline))
            if not self._updater.service_is_ready() or timeout_s < _LEAST_S:
                return ''
            called_at, answered = time.monotonic(), threading.Event()
            future = self._updater.call_async(Empty.Request())
            future.add_done_callback(lambda _, answered=answered: answered.set())
            if not answered.wait(timeout_s):
                self._updater.remove_pending_request(future)
                return '' if self._shown_at > called_at else \
                    f'{self._updater.service_name} did not answer within {timeout_s:.1f} s'
            if self._stopped.wait(_UPDATE_PERIOD_S):
                return ''
        return ''


def not_one_publisher(topic: str, publishers: Sequence[TopicEndpointInfo]) -> str:
    """Return why the topic of the localizer's pose has no single source; empty if it has one."""
    # by name: a localizer that was killed and started again may be listed twice
    names = {f'{one.node_namespace.rstrip("/")}/{one.node_name}' for one in publishers}
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


def _left_s(deadline: float) -> float:
    """Return the time left until a deadline (monotonic clock), at least 0 [s]."""
    return max(0.0, deadline - time.monotonic())


def difference(given: PoseWithCovarianceStamped, shown: PoseWithCovarianceStamped) -> str:
    """Return how the localizer's pose `shown` differs from the given one; empty if they agree."""
    frames = [pose.header.frame_id.lstrip('/') for pose in (shown, given)]
    if frames[0] != frames[1]:
        return f"is in frame '{frames[0]}', the pose in '{frames[1]}': correct the map's frame_id"
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


def _planar(msg: PoseWithCovarianceStamped) -> NDArray[np.float64]:
    """Return the part of a pose that AMCL uses, x, y and yaw, as a transform (4, 4)."""
    p, q = msg.pose.pose.position, msg.pose.pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    planar = np.eye(4)
    planar[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    planar[:2, 3] = p.x, p.y
    return planar


def usable_pose(pose: PoseWithCovarianceStamped, now: Time) -> PoseWithCovarianceStamped:
    """Return a pose that AMCL can use.

    A stamp in the future, for which AMCL has no odometry, is replaced by `now`, unless that is 0:
    simulated time has not begun. Small variances are raised, because otherwise all particles
    would coincide. AMCL reads elements 0, 1, 6, 7 and 35 of the covariance.
    """
    usable = deepcopy(pose)
    covariance = np.array(pose.pose.covariance).reshape(6, 6)
    usable.pose.covariance = (covariance + np.diag(np.maximum(
        0.0, _MIN_VARIANCES - np.diag(covariance)))).ravel()
    if 0 < now.nanoseconds < stamp_ns(pose.header.stamp):
        usable.header.stamp = now.to_msg()
    return usable


class MapToOdom:
    """Broadcasts the transform map -> odom.

    Odometry broadcasts odom -> base, and drifts. `transforms` looks up the robot's pose by
    odometry.
    """

    def __init__(self, node: Node, transforms: CoordinateFrames) -> None:
        self._node = node
        self._transforms = transforms
        self._broadcaster: Any = None
        self._timer: Timer | None = None
        # Set in the worker's thread, reset in the threads that receive /clock and odometry.
        self._lock = threading.Lock()
        self._transform: TransformStamped | None = None
        self._jumped_at = -math.inf
        self._began_ns = 0
        # Stamps of the newest own broadcasts [ns], and of each coordinate frame the parent in the
        # newest transform of another node, and until when it counts (monotonic clock) [s].
        self._sent: deque[int] = deque(maxlen=100)
        self._others: dict[str, tuple[str, float]] = {}
        transforms.on_transform = self.hear

    def hear(self, transform: TransformStamped, is_static: bool) -> None:
        """Process a transform that any node broadcasts."""
        child, stamp = transform.child_frame_id.lstrip('/'), stamp_ns(transform.header.stamp)
        if is_static or stamp not in self._sent:
            until = math.inf if is_static else time.monotonic() + _RIVAL_S
            self._others[child] = transform.header.frame_id, until

    def rival(self, odom_frame: str) -> str:
        """Return that another node broadcasts the pose of a frame, and what to do; else ''."""
        parent, until = self._others.get(odom_frame.lstrip('/'), ('', -math.inf))
        return '' if time.monotonic() > until else (
            f"another node broadcasts the transform '{parent}' -> '{odom_frame}', so publish_tf "
            'pauses: stop that node (SLAM or a localizer), or set publish_tf: false')

    def open(self) -> None:
        """Start broadcasting as soon as there is a pose. The transforms must be open."""
        if self._broadcaster is None:
            from tf2_ros import TransformBroadcaster
            self._broadcaster = TransformBroadcaster(self._node)
        self._timer = steady_timer(self._node, _PERIOD_S, self._broadcast)

    def close(self) -> None:
        """Stop broadcasting, and drop the transform."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        self._timer = None
        self.forget()

    def forget(self, began_ns: int = 0) -> None:
        """Drop the transform until the next accepted pose: time jumped, or odometry restarted.

        Images from before `began_ns`, the stamp of the first odometry after a restart [ns], are
        ignored even if they arrive later.
        """
        with self._lock:
            self._transform, self._jumped_at = None, time.monotonic()
            self._began_ns = began_ns

    def pause(self) -> None:
        """Drop the transform until the next update: answers contradict each other.

        NoTransformError: it is not closed.
        """
        with self._lock:
            self._transform = None
        if self._timer is not None:
            raise NoTransformError('this pose contradicts the earlier ones, carried by odometry: '
                                   'map -> odom pauses until the next pose decides')

    def update(self, header: Header, map_from_base: NDArray[np.float64],
               parameters: RelocalizerParameters, received_at: float) -> None:
        """Update the transform from a pose of the robot (4, 4); ignored while closed.

        The header has the stamp of the image and the coordinate frame of the map. `received_at`
        is when the image arrived (monotonic clock) [s].

        Raises
        ------
        NoTransformError
            The robot's pose by odometry is unknown, and the former transform is kept; or another
            node broadcasts the transform.
        TimeJumpError
            Time has jumped or odometry has restarted since the image.
        """
        if self._timer is None:
            return
        if rival := self.rival(parameters.odom_frame):
            raise NoTransformError(rival)
        base_from_odom = self._transforms.lookup(parameters.base_frame, parameters.odom_frame,
                                                 header.stamp, parameters.tf_timeout_s,
                                                 'correct odom_frame')
        transform = transform_msg(header, parameters.odom_frame, map_from_base @ base_from_odom)
        with self._lock:
            if received_at <= self._jumped_at or stamp_ns(header.stamp) < self._began_ns:
                raise TimeJumpError('odometry restarted or time jumped since the image was taken')
            self._transform = transform

    def _broadcast(self) -> None:
        with self._lock:
            transform = self._transform
            if transform is None or self.rival(transform.child_frame_id):
                return
            until = (self._node.get_clock().now() + Duration(seconds=_PERIOD_S)).to_msg()
            if transform.header.stamp == until:
                return  # simulated time is paused; tf2 warns of repeated stamps
            transform.header.stamp = until
            self._sent.append(stamp_ns(until))
            self._broadcaster.sendTransform(transform)


def transform_msg(header: Header, child_frame: str, parent_from_child: NDArray[np.float64]
                  ) -> TransformStamped:
    """Return a transform (4, 4), child to parent, as a message; the header names the parent."""
    pose = pose_to_msg(parent_from_child)
    msg = TransformStamped(header=Header(stamp=header.stamp, frame_id=header.frame_id),
                           child_frame_id=child_frame)
    translation = msg.transform.translation
    translation.x, translation.y, translation.z = pose.position.x, pose.position.y, pose.position.z
    msg.transform.rotation = pose.orientation
    return msg

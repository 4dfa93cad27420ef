# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Deliver an accepted pose: to a running localizer, or as map -> odom to the robot itself.

`initialpose` is volatile, so the publisher may have met a subscription that has not met it yet,
and for DDS a localizer that was killed or hangs is still alive. Only the pose that the localizer
publishes proves that it took the given pose.
"""

import math
import threading
import time
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as Stamp
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.time import Time
from rclpy.timer import Timer
from std_msgs.msg import Header
from std_srvs.srv import Empty

from cliploc_ros.core.geometry.transforms import SAME_SPOT, TAKEN, Tolerance, pose_error
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import pose_to_msg, stamp_ns
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.inputs.odometry import MOMENT_PATIENCE_S, OdometrySource
from cliploc_ros.ros.inputs.stamps import TimeJumpError, TimeJumps
from cliploc_ros.ros.parameters import RelocalizerParameters

# The least variances of x, y, z [m^2] and of the rotations [rad^2]: a centimetre and a sixth of a
# degree. AMCL draws its particles from x, y and yaw; without any scatter they would all be one.
_MIN_VARIANCES = (1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5)
# Odometry of a robot at rest may be this old (a guess): slow sources send at 1 Hz.
_MAX_ODOM_AGE_S = 2.0
# How long to wait for odometry that has a publisher: discovery takes its time, too.
_ODOM_PATIENCE_S = 2.0
_POLL_S = 0.1
# AMCL shows a new pose after its next scan. One that it does not show by then was lost.
_REPEAT_S = 1.0
# With less time left, a pose that the localizer takes could not be told from one that it does not.
_LEAST_S = 0.5
# AMCL updates with its next scan; two calls before that count as one. Scans come at 5 Hz or more.
_UPDATE_PERIOD_S = 0.2
_UPDATE_PATIENCE_S = 2.0
# Between broadcasts. Each is dated ahead to the next one, so that a lookup at now need not wait.
_PERIOD_S = 0.1


class HandOffError(CliplocError):
    """The localizer did not get the pose; the message says why."""


class NoLocalizerError(HandOffError):
    """There is no localizer, or it does not take the pose: another pose would not help."""


class HandOff:
    """Publishes `initialpose` for a robot at rest, and has its localizer settle there.

    `odometry` knows whether the robot moves; it has to be listening.
    """

    def __init__(self, node: Node, odometry: OdometrySource) -> None:
        self._node = node
        self._odometry = odometry
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        # The latest message of the localizer since the pose was last published.
        self._shown: PoseWithCovarianceStamped | None = None
        self._shown_at = -math.inf  # when it was heard (monotonic clock) [s]
        self._pose_topic = ''
        self._listeners: list[Callable[[PoseWithCovarianceStamped], None]] = []
        self._subscription: qos.AdaptiveSubscription | None = None
        self._publisher = node.create_publisher(
            PoseWithCovarianceStamped, 'initialpose', qos.POSE,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: self._wake()))
        self._updater = node.create_client(Empty, 'request_nomotion_update',
                                           callback_group=ReentrantCallbackGroup())

    def on_shown(self, listener: Callable[[PoseWithCovarianceStamped], None]) -> None:
        """Call a function with each pose of the localizer; it must not block."""
        self._listeners.append(listener)

    def open(self, pose_topic: str) -> None:
        """Allow hand-overs. The localizer shows its pose on `pose_topic`; empty: nowhere."""
        self._stopped.clear()
        if pose_topic:
            self._pose_topic = str(self._node.resolve_topic_name(pose_topic))
            # Volatile: an earlier pose of the localizer does not come late.
            self._subscription = qos.AdaptiveSubscription(
                self._node, PoseWithCovarianceStamped, pose_topic, self._hear, qos.POSE)

    def close(self) -> None:
        """End the hand-over under way, and listen no more."""
        self.stop()
        if self._subscription is not None:
            self._subscription.destroy()
            self._subscription = None

    def stop(self) -> None:
        """End the hand-over under way."""
        self._stopped.set()
        self._wake()

    def missing(self) -> str:
        """Return that there is no localizer, and what to do; empty if there is one."""
        if not self._publisher.get_subscription_count():
            return (f'nobody subscribes {self._publisher.topic_name}: start the localizer (AMCL); '
                    'if it has just started, request again; without AMCL require_localizer: false')
        if self._subscription is not None and not self._node.count_publishers(self._pose_topic):
            return (f'nobody publishes {self._pose_topic}: start the localizer (AMCL); if it has '
                    'just started, request again; name the topic of its pose by localizer_pose')
        return ''

    def hand_over(self, pose: PoseWithCovarianceStamped, parameters: RelocalizerParameters,
                  deadline: float, received_at: float, jumps: TimeJumps) -> None:
        """Publish a pose on `initialpose` until the localizer shows it, and let it settle.

        A localizer that shows the pose is not reset again. It still has to live when it has
        settled: it answers each update, or shows another pose, and is there at the end.

        Parameters
        ----------
        pose : PoseWithCovarianceStamped
            Accepted, in the map's coordinate frame, with the image's stamp.
        deadline, received_at : float
            When to return at the latest, and when the image arrived (monotonic clock) [s]. A
            hand-over that need not wait is made after the deadline, too.
        jumps : TimeJumps
            Time jumps of the node's clock.

        Raises
        ------
        HandOffError
            The robot moves or may do so, or has moved since its image.
        NoLocalizerError
            There is no localizer, it does not show the pose, or it has died since.
        TimeJumpError
            Time has jumped back since.
        """
        if not parameters.base_frame:
            self._node.get_logger().warning(
                "initialpose carries the camera's pose: base_frame is empty; for AMCL set it to "
                "AMCL's base_frame_id", once=True)
        if parameters.require_localizer:
            self._wait_for_localizer(deadline)
        must_show = parameters.require_localizer and self._subscription is not None
        given, times, begun_at = pose, 0, time.monotonic()
        while not times or (must_show and not self._shows(given, deadline)):
            if must_show and _left_s(deadline) < _LEAST_S:
                raise NoLocalizerError(self._not_taken(given, times, begun_at))
            self.check_rest(parameters.max_speed_m_s, parameters.max_turn_rad_s, deadline)
            self._check_place(pose.header.stamp, deadline)
            jumps.check(pose.header.stamp, received_at)
            if self._stopped.is_set():
                raise HandOffError('the node was deactivated during the hand-over')
            given, times = usable_pose(pose, self._node.get_clock().now()), times + 1
            self._shown = None
            self._publisher.publish(given)
        silent = self._settle(parameters.nomotion_updates, deadline)
        if must_show and (gone := silent or self.missing()):
            raise NoLocalizerError(f'the localizer took the pose and has ended or hangs since: '
                                   f'{gone}: see its log, request again')
        if must_show and not is_taken(given, self._shown):
            raise NoLocalizerError(self._not_taken(given, times, begun_at))
        if silent:
            self._node.get_logger().warning(
                f'{silent}: the localizer has the pose, but may not settle while the robot rests',
                throttle_duration_sec=5.0)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _hear(self, shown: PoseWithCovarianceStamped) -> None:
        with self._changed:
            self._shown, self._shown_at = shown, time.monotonic()
            self._changed.notify_all()
        for listener in self._listeners:
            listener(shown)

    def _wait_for_localizer(self, deadline: float) -> None:
        """Raise unless there is a localizer, or one is found while there is time to use it.

        One that has just started is found after up to three seconds.
        """
        until = deadline - _LEAST_S
        while (missing := self.missing()) and not self._stopped.is_set():
            if not _left_s(until):
                raise NoLocalizerError(missing)
            with self._changed:
                self._changed.wait(min(_POLL_S, _left_s(until)))

    def _shows(self, given: PoseWithCovarianceStamped, deadline: float) -> bool:
        """Return whether the localizer shows a pose, or soon does."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._stopped.is_set() or is_taken(given, self._shown),
                min(_REPEAT_S, _left_s(deadline)))
            return is_taken(given, self._shown)

    def _not_taken(self, given: PoseWithCovarianceStamped, times: int, begun_at: float) -> str:
        """Describe the localizer's pose, or its silence, where it did not take the given pose."""
        shown, why = self._shown, 'the localizer did not take the pose: '
        if not times:
            return 'too little time is left for the localizer to take the pose: request again'
        if shown is None:
            return (f'{why}{self._pose_topic} shows nothing since initialpose was published '
                    f'{times} times in {time.monotonic() - begun_at:.0f} s: see whether the '
                    'localizer is active and hears scans')
        frames = [one.header.frame_id.lstrip('/') for one in (shown, given)]
        if frames[0] != frames[1]:
            return (f"{why}{self._pose_topic} is in frame '{frames[0]}', the pose in "
                    f"'{frames[1]}': correct the map's frame_id")
        distance_m, angle_deg = pose_error(_planar(given), _planar(shown))
        near = tolerance_of(given)
        return (f'{why}{self._pose_topic} shows a pose {distance_m:.2f} m and {angle_deg:.0f} '
                f'degrees from it (limits {near.distance_m:.2f} and {near.angle_deg:.0f})')

    def check_rest(self, max_speed_m_s: float, max_turn_rad_s: float, deadline: float) -> None:
        """Raise unless odometry shows a robot at rest; without odometry it is taken to rest."""
        odometry = self._odometry.recent(_MAX_ODOM_AGE_S,
                                         min(_ODOM_PATIENCE_S, _left_s(deadline)))
        if odometry is None:
            if not self._odometry.is_published:
                self._node.get_logger().warning(
                    f'nobody publishes {self._odometry.topic}: the robot is taken to rest',
                    once=True)
                return
            raise HandOffError(f'{self._odometry.topic} has a publisher but no messages: the '
                               'robot may be moving')
        left_s = _left_s(deadline)
        by_poses = self._odometry.speeds_by_poses(left_s)
        if by_poses is None and left_s < MOMENT_PATIENCE_S:
            raise HandOffError(f'{self._odometry.topic} has just begun, and too little time is '
                               'left to see whether the robot moves: request again')
        v, w = odometry.twist.twist.linear, odometry.twist.twist.angular
        by_twist = math.hypot(v.x, v.y, v.z), math.hypot(w.x, w.y, w.z)
        if by_poses is None and by_twist == (0.0, 0.0):
            raise HandOffError(f'{self._odometry.topic} shows neither a twist nor poses that tell '
                               'a speed: the robot may be moving; stamp its poses, send at 1 Hz '
                               'or more')
        # np.maximum passes NaN on, which no limit allows
        speed_m_s, turn_rad_s = np.maximum(by_twist, by_poses or (0.0, 0.0))
        if not (speed_m_s <= max_speed_m_s and turn_rad_s <= max_turn_rad_s):
            raise HandOffError(f'the robot moves at {speed_m_s:.2f} m/s and {turn_rad_s:.2f} '
                               f'rad/s (limits {max_speed_m_s:g} and {max_turn_rad_s:g}): stop it')

    def _check_place(self, stamp: Stamp, deadline: float) -> None:
        """Raise unless odometry shows that the robot is where its image was taken.

        AMCL would move the pose on by tf, robot_localization's set_pose does not.
        """
        is_published = self._odometry.is_published
        moved = self._odometry.moved_since(
            stamp, min(_ODOM_PATIENCE_S, _left_s(deadline)) if is_published else 0.0)
        if moved is None and is_published:
            raise HandOffError(f'{self._odometry.topic} does not tell whether the robot has moved '
                               'since its image: stamp both by one clock, send at 1 Hz or more; '
                               'request again')
        distance_m, angle_deg = moved or (0.0, 0.0)
        if distance_m > SAME_SPOT.distance_m or angle_deg > SAME_SPOT.angle_deg:
            raise HandOffError(f'the robot has moved by {distance_m:.2f} m and {angle_deg:.0f} '
                               f'degrees since its image (limits {SAME_SPOT.distance_m:g} and '
                               f'{SAME_SPOT.angle_deg:g}): request again while it stands')

    def _settle(self, updates: int, deadline: float) -> str:
        """Have AMCL take in some scans though the robot rests, as far as time allows.

        Return which call was answered neither by the service nor by a pose that is shown; '' if
        none was.
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


def _left_s(deadline: float) -> float:
    """Return how long it is until a moment of the monotonic clock, at least 0 [s]."""
    return max(0.0, deadline - time.monotonic())


def is_taken(given: PoseWithCovarianceStamped, shown: PoseWithCovarianceStamped | None) -> bool:
    """Return whether a localizer that shows a pose has taken a given one."""
    return (shown is not None
            and shown.header.frame_id.lstrip('/') == given.header.frame_id.lstrip('/')
            and tolerance_of(given).agree(_planar(given), _planar(shown)))


def tolerance_of(given: PoseWithCovarianceStamped) -> Tolerance:
    """Return the allowed distance of a localizer's pose from the given one."""
    covariance = np.array(given.pose.covariance).reshape(6, 6)
    variance = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    return TAKEN.wider(3.0 * math.sqrt(variance), math.degrees(3.0 * math.sqrt(covariance[5, 5])))


def _planar(msg: PoseWithCovarianceStamped) -> NDArray[np.float64]:
    """Return x, y and yaw of a pose as a transform (4, 4), which is all that AMCL takes of it."""
    p, q = msg.pose.pose.position, msg.pose.pose.orientation
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
    planar = np.eye(4)
    planar[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    planar[:2, 3] = p.x, p.y
    return planar


def usable_pose(pose: PoseWithCovarianceStamped, now: Time) -> PoseWithCovarianceStamped:
    """Return a pose that AMCL can use.

    Its stamp is not in the future, for which AMCL has no odometry, and no variance is so small
    that all particles coincide. AMCL reads elements 0, 1, 6, 7 and 35 of the covariance. `now` is
    0 where simulated time has not begun.
    """
    usable = deepcopy(pose)
    covariance = np.array(pose.pose.covariance).reshape(6, 6)
    usable.pose.covariance = (covariance + np.diag(np.maximum(
        0.0, _MIN_VARIANCES - np.diag(covariance)))).ravel()
    if 0 < now.nanoseconds < stamp_ns(pose.header.stamp):
        usable.header.stamp = now.to_msg()
    return usable


class MapToOdom:
    """Broadcasts the transform from odometry's coordinate frame to the map.

    Odometry broadcasts odom -> base, and drifts from where it began. `transforms` knows where the
    robot was by odometry.
    """

    def __init__(self, node: Node, transforms: CoordinateFrames) -> None:
        self._node = node
        self._transforms = transforms
        self._broadcaster: Any = None
        self._timer: Timer | None = None
        # Set in the worker's thread, dropped in the threads that take /clock and odometry.
        self._lock = threading.Lock()
        self._transform: TransformStamped | None = None
        self._jumped_at = -math.inf
        self._began_ns = 0

    def open(self) -> None:
        """Broadcast from now on, as soon as there is a pose.

        NoTransformError: tf2_ros is not installed.
        """
        try:
            from tf2_ros import TransformBroadcaster
        except ImportError as error:
            raise NoTransformError('publish_tf is true, but tf2_ros is not installed: install it, '
                                   'or set publish_tf: false') from error
        if self._broadcaster is None:
            self._broadcaster = TransformBroadcaster(self._node)
        self._timer = self._node.create_timer(_PERIOD_S, self._broadcast, clock=Clock(
            clock_type=ClockType.STEADY_TIME))

    def close(self) -> None:
        """Stop broadcasting, and drop the transform."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        self._timer = None
        self.forget()

    def forget(self, began_ns: int = 0) -> None:
        """Drop the transform until the next accepted pose: time jumped, or odometry restarted.

        Images from before `began_ns`, the stamp of the first odometry after a restart [ns], do not
        count, even those that arrive later.
        """
        with self._lock:
            self._transform, self._jumped_at = None, time.monotonic()
            self._began_ns = began_ns

    def update(self, header: Header, map_from_base: NDArray[np.float64],
               parameters: RelocalizerParameters, received_at: float) -> None:
        """Take in where the robot was; does nothing while closed.

        The header has the stamp of the image and the coordinate frame of the map; the image
        arrived at `received_at` (monotonic clock) [s].

        Raises
        ------
        NoTransformError
            The robot's place by odometry is unknown; the former transform stays.
        TimeJumpError
            Time has jumped or odometry has restarted since the image.
        """
        if self._timer is None:
            return
        base_from_odom = self._transforms.lookup(parameters.base_frame, parameters.odom_frame,
                                                 header.stamp, parameters.tf_timeout_s,
                                                 'correct odom_frame')
        transform = transform_msg(header, parameters.odom_frame, map_from_base @ base_from_odom)
        with self._lock:
            if received_at <= self._jumped_at or stamp_ns(header.stamp) < self._began_ns:
                raise TimeJumpError('odometry restarted or time jumped since the image: the pose '
                                    'is from before')
            self._transform = transform

    def _broadcast(self) -> None:
        with self._lock:
            transform = self._transform
            if transform is None:
                return
            until = (self._node.get_clock().now() + Duration(seconds=_PERIOD_S)).to_msg()
            if transform.header.stamp == until:
                return  # simulated time stands still; tf2 warns of a stamp that comes twice
            transform.header.stamp = until
            self._broadcaster.sendTransform(transform)


def transform_msg(header: Header, child_frame: str, parent_from_child: NDArray[np.float64]
                  ) -> TransformStamped:
    """Return a transform (4, 4) from a child coordinate frame to the header's as a message."""
    pose = pose_to_msg(parent_from_child)
    msg = TransformStamped(header=Header(stamp=header.stamp, frame_id=header.frame_id),
                           child_frame_id=child_frame)
    translation = msg.transform.translation
    translation.x, translation.y, translation.z = pose.position.x, pose.position.y, pose.position.z
    msg.transform.rotation = pose.orientation
    return msg

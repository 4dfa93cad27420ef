# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Handing an accepted pose over to a running localizer: AMCL, or another with `initialpose`."""

import math
import threading
import time
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as Stamp
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.time import Time
from std_srvs.srv import Empty

from cliploc_ros.core.geometry.tolerances import SAME_SPOT
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros import qos
from cliploc_ros.ros.inputs.odometry import MOMENT_PATIENCE_S, OdometrySource
from cliploc_ros.ros.inputs.time_jumps import TimeJumpError

# The least variances of x, y, z [m^2] and of the rotations [rad^2]: a centimetre and a sixth of a
# degree. AMCL draws its particles from x, y and yaw; without any scatter they would all be one.
_MIN_VARIANCES = (1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5)
# Odometry of a robot at rest may be this old (a guess): slow sources send at 1 Hz.
_MAX_ODOM_AGE_S = 2.0
# How long to wait for odometry that has a publisher: discovery takes its time, too.
_ODOM_PATIENCE_S = 2.0
# How long to wait for a subscriber of initialpose; discovery of a running one takes less.
_SUBSCRIBER_PATIENCE_S = 2.0
# AMCL updates with its next scan; two calls before that count as one. Scans come at 5 Hz or more.
_UPDATE_PERIOD_S = 0.2
_UPDATE_PATIENCE_S = 2.0


class HandOffError(CliplocError):
    """The localizer did not get the pose; the message says why."""


class NoLocalizerError(HandOffError):
    """Nobody subscribes `initialpose`: another pose would not help."""


class HandOff:
    """Publishes `initialpose` for a robot at rest, and has its localizer settle there.

    Parameters
    ----------
    node : Node
    odometry : OdometrySource
        Knows whether the robot moves; has to be listening.
    """

    def __init__(self, node: Node, odometry: OdometrySource) -> None:
        self._node = node
        self._odometry = odometry
        self._changed = threading.Condition()
        self._stopped = threading.Event()
        self._jumped_at = -math.inf
        self._publisher = node.create_publisher(
            PoseWithCovarianceStamped, 'initialpose', qos.POSE,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: self._wake()))
        self._updater = node.create_client(Empty, 'request_nomotion_update',
                                           callback_group=ReentrantCallbackGroup())

    def open(self) -> None:
        """Allow hand-overs."""
        self._stopped.clear()

    def stop(self) -> None:
        """End the hand-over under way: the node is deactivated."""
        self._stopped.set()
        self._wake()

    def forget(self) -> None:
        """Withhold the pose of the hand-over under way: time jumped."""
        self._jumped_at = time.monotonic()

    def missing(self) -> str:
        """Return that there is no localizer, and what to do; empty if there is one."""
        if self._publisher.get_subscription_count():
            return ''
        return (f'nobody subscribes {self._publisher.topic_name}: start the localizer (AMCL), or '
                'set require_localizer: false')

    def hand_over(self, pose: PoseWithCovarianceStamped, values: Mapping[str, Any],
                  deadline: float, received_at: float) -> None:
        """Publish a pose on `initialpose`, and return when the localizer had time to settle.

        Parameters
        ----------
        pose : PoseWithCovarianceStamped
            Accepted, in the map's coordinate frame, with the image's stamp.
        values : mapping
            The relocalizer's parameters.
        deadline : float
            When to return at the latest (monotonic clock) [s]. A hand-over that need not wait is
            made after it, too.
        received_at : float
            When the image arrived (monotonic clock) [s].

        Raises
        ------
        HandOffError
            The robot moves or may do so, or has moved since its image; nothing was published.
        NoLocalizerError
            Nobody subscribes `initialpose`; nothing was published.
        TimeJumpError
            Time has jumped back since; nothing was published.
        """
        if not values['base_frame']:
            self._node.get_logger().warning(
                "initialpose carries the camera's pose: base_frame is empty; for AMCL set it to "
                "AMCL's base_frame_id", once=True)
        if values['require_localizer']:
            self._wait_for_localizer(deadline)
        self._check_rest(values['max_speed_m_s'], values['max_turn_rad_s'], deadline)
        self._check_place(pose.header.stamp, deadline)
        if self._jumped_at >= received_at:
            raise TimeJumpError('time jumped back before the hand-over: the pose is from before')
        if self._stopped.is_set():
            raise HandOffError('the node was deactivated during the hand-over')
        self._publisher.publish(usable_pose(pose, self._node.get_clock().now()))
        self._settle(values['nomotion_updates'], deadline)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _wait_for_localizer(self, deadline: float) -> None:
        """Raise unless somebody subscribes `initialpose`, or soon does."""
        with self._changed:
            self._changed.wait_for(lambda: self._stopped.is_set() or not self.missing(),
                                   min(_SUBSCRIBER_PATIENCE_S, _left_s(deadline)))
        if missing := self.missing():
            raise NoLocalizerError(missing)

    def _check_rest(self, max_speed_m_s: float, max_turn_rad_s: float, deadline: float) -> None:
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
                               'left to see whether the robot moves: ask again')
        by_twist = speeds(odometry)
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
        patience_s = min(_ODOM_PATIENCE_S, _left_s(deadline)) if self._odometry.is_published \
            else 0.0
        moved = self._odometry.moved_since(stamp, patience_s)
        if moved is None:
            if self._odometry.is_published:
                raise HandOffError(f'{self._odometry.topic} does not tell whether the robot has '
                                   'moved since its image: stamp both by one clock, send at 1 Hz '
                                   'or more; ask again')
            return
        distance_m, angle_deg = moved
        if distance_m > SAME_SPOT.distance_m or angle_deg > SAME_SPOT.angle_deg:
            raise HandOffError(f'the robot has moved by {distance_m:.2f} m and {angle_deg:.0f} '
                               f'degrees since its image (limits {SAME_SPOT.distance_m:g} and '
                               f'{SAME_SPOT.angle_deg:g}): ask again while it stands')

    def _settle(self, updates: int, deadline: float) -> None:
        """Have AMCL take in some scans though the robot rests, as far as time allows.

        The pose is delivered: what fails here is not worth an error.
        """
        for _ in range(updates):
            if (not self._updater.service_is_ready() or _left_s(deadline) < _UPDATE_PERIOD_S
                    or self._stopped.wait(_UPDATE_PERIOD_S)):
                return
            if not self._update(min(_UPDATE_PATIENCE_S, _left_s(deadline))):
                return

    def _update(self, timeout_s: float) -> bool:
        """Ask AMCL for one update; return whether it answers."""
        answered = threading.Event()
        future = self._updater.call_async(Empty.Request())
        future.add_done_callback(lambda _: answered.set())
        if answered.wait(timeout_s):
            return True
        self._updater.remove_pending_request(future)
        self._node.get_logger().warning(
            f'{self._updater.service_name} did not answer within {timeout_s:.1f} s: the '
            'localizer has the pose, but may not settle while the robot rests',
            throttle_duration_sec=5.0)
        return False


def _left_s(deadline: float) -> float:
    """Return how long it is until a moment of the monotonic clock, at least 0 [s]."""
    return max(0.0, deadline - time.monotonic())


def speeds(odometry: Odometry) -> tuple[float, float]:
    """Return how fast a robot drives [m/s] and turns [rad/s]."""
    v, w = odometry.twist.twist.linear, odometry.twist.twist.angular
    return math.hypot(v.x, v.y, v.z), math.hypot(w.x, w.y, w.z)


def usable_pose(pose: PoseWithCovarianceStamped, now: Time) -> PoseWithCovarianceStamped:
    """Return a pose that AMCL can use.

    Its stamp is not in the future, for which AMCL has no odometry, and no variance is so small
    that all particles coincide. AMCL reads elements 0, 1, 6, 7 and 35 of the covariance.

    Parameters
    ----------
    pose : PoseWithCovarianceStamped
    now : Time
        0 where simulated time has not begun.
    """
    usable = deepcopy(pose)
    covariance = np.array(pose.pose.covariance).reshape(6, 6)
    usable.pose.covariance = (covariance + np.diag(np.maximum(
        0.0, _MIN_VARIANCES - np.diag(covariance)))).ravel()
    if 0 < now.nanoseconds < Time.from_msg(pose.header.stamp).nanoseconds:
        usable.header.stamp = now.to_msg()
    return usable

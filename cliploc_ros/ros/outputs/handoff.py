# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Telling a running localizer where the robot is: AMCL, or whoever else takes `initialpose`."""

import math
import threading
from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.time import Time
from std_srvs.srv import Empty

from cliploc_ros.errors import CliplocError
from cliploc_ros.ros import qos
from cliploc_ros.ros.inputs.odometry import OdometrySource

# The least variances of x, y, z [m^2] and of the rotations [rad^2]: a centimetre and a sixth of a
# degree. AMCL draws its particles from x, y and yaw; without any scatter they would all be one.
_MIN_VARIANCES = (1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5)
# How long odometry that somebody publishes may let wait: discovery takes its time, too.
_ODOM_PATIENCE_S = 2.0
# AMCL updates with its next scan; two calls before that count as one. Scans come at 5 Hz or more.
_UPDATE_PERIOD_S = 0.2
_UPDATE_PATIENCE_S = 1.0


class HandOffError(CliplocError):
    """The localizer was not told; the message says why."""


class HandOff:
    """Publishes `initialpose` for a robot at rest, and has its localizer settle there.

    Parameters
    ----------
    node : Node
    odometry : OdometrySource
        Tells whether the robot moves, while somebody listens to it.
    """

    def __init__(self, node: Node, odometry: OdometrySource) -> None:
        self._node = node
        self._odometry = odometry
        self._publisher = node.create_publisher(PoseWithCovarianceStamped, 'initialpose',
                                                qos.POSE)
        self._updater = node.create_client(Empty, 'request_nomotion_update',
                                           callback_group=ReentrantCallbackGroup())
        self._stopped = threading.Event()

    def open(self) -> None:
        """Be ready to hand over."""
        self._stopped.clear()

    def stop(self) -> None:
        """Let go a hand-off that is under way."""
        self._stopped.set()

    def hand_over(self, pose: PoseWithCovarianceStamped, values: Mapping[str, Any],
                  deadline: float) -> None:
        """Publish a pose on `initialpose`, and return when the localizer had time to settle.

        Parameters
        ----------
        pose : PoseWithCovarianceStamped
            Accepted, in the map's frame, with the image's stamp.
        values : mapping
            Of the relocalizer's parameters.

        Raises
        ------
        HandOffError
            The robot moves, or nobody can tell; nothing was published.
        """
        if not values['base_frame']:
            self._node.get_logger().warning(
                "initialpose carries the camera's pose, for base_frame is empty: set it to what "
                'AMCL calls base_frame_id, where AMCL listens', once=True)
        self._check_rest(values['max_speed_m_s'], values['max_turn_rad_s'])
        self._publisher.publish(usable_pose(pose, self._node.get_clock().now()))
        for _ in range(values['nomotion_updates']):
            if not self._updater.service_is_ready() or self._stopped.wait(_UPDATE_PERIOD_S):
                return
            answered = threading.Event()
            self._updater.call_async(Empty.Request()).add_done_callback(
                lambda _, done=answered: done.set())
            answered.wait(_UPDATE_PATIENCE_S)

    def _check_rest(self, max_speed_m_s: float, max_turn_rad_s: float) -> None:
        """Raise unless odometry says that the robot rests; without odometry it is believed to."""
        odometry = self._odometry.recent(_ODOM_PATIENCE_S)
        if odometry is None:
            if not self._odometry.is_published:
                self._node.get_logger().warning(
                    f'nobody publishes {self._odometry.topic}: the robot is taken to stand',
                    once=True)
                return
            raise HandOffError(f'{self._odometry.topic} has a publisher that says nothing, so the '
                               'robot may be moving: initialpose is withheld')
        # np.maximum passes NaN on, which no limit allows
        speed_m_s, turn_rad_s = np.maximum(speeds(odometry), self._odometry.speeds_by_poses(2.0))
        if not (speed_m_s <= max_speed_m_s and turn_rad_s <= max_turn_rad_s):
            raise HandOffError(f'the robot moves at {speed_m_s:.2f} m/s and {turn_rad_s:.2f} '
                               'rad/s: initialpose is withheld, ask again when it stands')


def speeds(odometry: Odometry) -> tuple[float, float]:
    """Return how fast a robot drives [m/s] and turns [rad/s]."""
    v, w = odometry.twist.twist.linear, odometry.twist.twist.angular
    return math.hypot(v.x, v.y, v.z), math.hypot(w.x, w.y, w.z)


def usable_pose(pose: PoseWithCovarianceStamped, now: Time) -> PoseWithCovarianceStamped:
    """Return a pose as AMCL can use it.

    Its stamp is not in the future, which AMCL has no odometry for, and no variance is so small
    that all particles would be the same. AMCL reads elements 0, 1, 6, 7 and 35 of the covariance.

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

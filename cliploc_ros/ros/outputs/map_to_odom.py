# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""map -> odom of REP 105: for a robot without another localizer that broadcasts it."""

import math
import threading
import time
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.timer import Timer
from std_msgs.msg import Header

from cliploc_ros.ros.conversions import pose_to_msg, stamp_ns
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.inputs.time_jumps import TimeJumpError
from cliploc_ros.ros.parameters import RelocalizerParameters

# Between broadcasts. Each is dated ahead to the next one, so that a lookup at now need not wait.
_PERIOD_S = 0.1


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

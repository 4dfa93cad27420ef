# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""map -> odom of REP 105: for a robot without another localizer that broadcasts it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.timer import Timer
from std_msgs.msg import Header

from cliploc_ros.ros.conversions import pose_to_msg
from cliploc_ros.ros.inputs.coordinate_frames import BaseFrame, FrameError

# Between broadcasts. Each is dated until the next one, so that who asks about now need not wait.
_PERIOD_S = 0.1


class OdomFrame:
    """Broadcasts where odometry began: odom -> base, which others broadcast, drifts from there.

    Parameters
    ----------
    node : Node
    base : BaseFrame
        Knows where the robot was by odometry.
    """

    def __init__(self, node: Node, base: BaseFrame) -> None:
        self._node = node
        self._base = base
        self._broadcaster: Any = None
        self._timer: Timer | None = None
        self._transform: TransformStamped | None = None

    def open(self) -> None:
        """Begin to broadcast, as soon as there is a pose.

        Raises
        ------
        FrameError
            tf2_ros is not installed.
        """
        try:
            from tf2_ros import TransformBroadcaster
        except ImportError as error:
            raise FrameError('publish_tf is set, but tf2_ros is not installed') from error
        if self._broadcaster is None:
            self._broadcaster = TransformBroadcaster(self._node)
        self._timer = self._node.create_timer(_PERIOD_S, self._broadcast, clock=Clock(
            clock_type=ClockType.STEADY_TIME))

    def close(self) -> None:
        """Broadcast no longer, and forget the pose."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
        self._timer = self._transform = None

    def update(self, header: Header, map_from_base: NDArray[np.float64],
               values: Mapping[str, Any]) -> None:
        """Take in where the robot was; does nothing while closed.

        Parameters
        ----------
        header : Header
            Stamp of the image, frame of the map.
        map_from_base : ndarray (4, 4)
        values : mapping
            Of the relocalizer's parameters.

        Raises
        ------
        FrameError
            Nobody says where the robot was by odometry; the former transform stays.
        """
        if self._timer is None:
            return
        base_from_odom = self._base.lookup(values['base_frame'], values['odom_frame'],
                                           header.stamp, values['tf_timeout_s'])
        self._transform = transform_msg(header, values['odom_frame'],
                                        map_from_base @ base_from_odom)

    def _broadcast(self) -> None:
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
    """Return a transform (4, 4) from a child frame to the header's as a message."""
    pose = pose_to_msg(parent_from_child)
    msg = TransformStamped(header=Header(stamp=header.stamp, frame_id=header.frame_id),
                           child_frame_id=child_frame)
    translation = msg.transform.translation
    translation.x, translation.y, translation.z = pose.position.x, pose.position.y, pose.position.z
    msg.transform.rotation = pose.orientation
    return msg

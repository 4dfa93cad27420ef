# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Broadcast the robot's pose as the transform map -> odom, for robots without a localizer."""

import math
import threading
import time
from collections import deque
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.timer import Timer
from std_msgs.msg import Header

from cliploc_ros.ros.conversions import stamp_ns, transform_msg
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.inputs.stamps import TimeJumpError
from cliploc_ros.ros.node.threads import steady_timer
from cliploc_ros.ros.parameters import RelocalizerParameters

# Period of broadcasts. Each is stamped with the time of the next one, so that a lookup at the
# present time does not wait.
_PERIOD_S = 0.1
# A transform of another node counts for this time: SLAM and AMCL broadcast at 1 Hz or more.
_RIVAL_S = 3.0


class MapToOdom:
    """Broadcasts the transform map -> odom.

    Odometry broadcasts odom -> base, and drifts. `transforms` looks up the robot's pose by
    odometry.
    """

    def __init__(self, node: Node, transforms: CoordinateFrames) -> None:
        self._node, self._transforms = node, transforms
        self._broadcaster: Any = None
        self._timer: Timer | None = None
        # Set in the worker's thread, reset in the threads that receive /clock and odometry.
        self._lock = threading.Lock()
        self._transform: TransformStamped | None = None
        self._jumped_at, self._began_ns = -math.inf, 0
        # Stamps of the newest own broadcasts [ns], and of each coordinate frame the parent in the
        # newest transform of another node, and until when it counts (monotonic clock) [s].
        self._sent: deque[int] = deque(maxlen=100)
        self._others: dict[str, tuple[str, float]] = {}
        transforms.listeners.append(self.hear)

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
            raise NoTransformError('this pose contradicts the earlier poses and odometry: map -> '
                                   'odom pauses until another pose agrees with one of them')

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

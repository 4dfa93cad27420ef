# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Transforms: the camera's mount from parameters or tf2, others from tf2; map -> odom to tf2."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time as RclTime
from rclpy.timer import Timer
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import invert_transform, transform_from_pose
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros.conversions import matrix_from_msg, pose_to_msg, stamp_ns
from cliploc_ros.ros.inputs.stamps import StampOrder, TimeJumpError
from cliploc_ros.ros.node.threads import steady_timer
from cliploc_ros.ros.parameters import RelocalizerParameters

# Period of broadcasts. Each is stamped with the time of the next one, so that a lookup at the
# present time does not wait.
_PERIOD_S = 0.1
# A transform of another node counts for this time: SLAM and AMCL broadcast at 1 Hz or more.
_RIVAL_S = 3.0


class NoTransformError(CliplocError):
    """A transform is missing; the message names it and the remedy."""


class CoordinateFrames:
    """Looks up transforms between coordinate frames at the stamp of an image.

    tf2_ros is imported when the first transform is needed. It is not needed if the mount is given
    as a parameter.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer: Any = None
        #: Called with each transform that is received, and whether it is static
        self.listeners: list[Callable[[TransformStamped, bool], None]] = []

    def open(self, missing: str = 'no transforms', *, remedy: str) -> Any:
        """Subscribe to transforms, so that they are known when the first image arrives.

        NoTransformError: tf2_ros is not installed; `missing` and `remedy` are in the message.
        """
        buffer = self._buffer
        if buffer is None:
            try:
                buffer = self._buffer = _make_buffer(self._node, self)
            except ImportError as error:
                raise NoTransformError(f'{missing}: tf2_ros is not installed; install it, or '
                                       f'{remedy}') from error
        return buffer

    def close(self) -> None:
        """Unsubscribe, and forget all transforms."""
        buffer, self._buffer = self._buffer, None
        if buffer is not None:
            buffer.close()

    def forget(self) -> None:
        """Forget all transforms except static ones: time jumped."""
        buffer = self._buffer
        if buffer is not None:
            buffer.clear()

    def camera_from_base(self, base_frame: str, mount: list[float], camera_frame: str,
                         stamp: Time, timeout_s: float) -> NDArray[np.float64]:
        """Return camera_from_base (4, 4).

        Parameters
        ----------
        base_frame : str
            Empty: the camera's own frame, for which the result is the identity.
        mount : list of float
            base_from_camera as x, y, z [m] and quaternion x, y, z, w; all zeros: use tf2.
        camera_frame, stamp
            Coordinate frame and stamp of the image. The mount may move.
        timeout_s : float
            Longest wait for tf2 [s].

        Raises
        ------
        NoTransformError
            tf2 is not installed or has no such transform.
        """
        if not base_frame:
            return np.eye(4)
        if any(mount):
            return invert_transform(transform_from_pose(np.array(mount[:3]), np.array(mount[3:])))
        return self.lookup(camera_frame, base_frame, stamp, timeout_s)

    def lookup(self, target_frame: str, source_frame: str, stamp: Time, timeout_s: float,
               remedy: str = 'set base_from_camera') -> NDArray[np.float64]:
        """Return target_from_source (4, 4) at a stamp from tf2; wait for it up to `timeout_s`.

        The error message proposes to publish the transform, or `remedy`.

        NoTransformError: tf2 is not installed or has no such transform in time.
        """
        missing = f"no transform from '{source_frame}' to '{target_frame}'"
        buffer = self.open(missing, remedy=remedy)
        try:
            found = buffer.lookup_transform(target_frame, source_frame, RclTime.from_msg(stamp),
                                            Duration(seconds=timeout_s)).transform
        except Exception as error:  # tf2 raises a different type for each cause
            raise NoTransformError(f'{missing}: {error}; publish it, or {remedy}') from error
        return matrix_from_msg(found)


def _make_buffer(node: Node, frames: CoordinateFrames) -> Any:
    """Return a buffer of `/tf` and `/tf_static`; ImportError: tf2_ros is not installed."""
    from tf2_ros import Buffer, TransformListener

    class TransformBuffer(Buffer):
        """A buffer that is cleared when the stamps of a transform go back.

        tf2 itself refuses transforms that are ten seconds older than the newest one, and
        interpolates across shorter jumps. Jazzy's Buffer is cleared only if it is given a node,
        and its first releases raise TypeError then. Transforms from before the jump may also
        arrive after the clock has jumped. clear() keeps static transforms.
        """

        def __init__(self) -> None:
            super().__init__()
            self._stamps = StampOrder()
            self._listener = TransformListener(self, node)

        def set_transform(self, transform: TransformStamped, authority: str) -> None:
            """Add a transform; forget the other transforms if time jumped back."""
            if self._stamps.goes_back(transform.child_frame_id, stamp_ns(transform.header.stamp)):
                super().clear()
            super().set_transform(transform, authority)
            for listener in frames.listeners:
                listener(transform, False)

        def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
            """Add a static transform."""
            super().set_transform_static(transform, authority)
            for listener in frames.listeners:
                listener(transform, True)

        def clear(self) -> None:
            """Forget all transforms except static ones."""
            self._stamps.clear()
            super().clear()

        def close(self) -> None:
            """Unsubscribe."""
            self._listener.unregister()
    return TransformBuffer()


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


def transform_msg(header: Header, child_frame: str, parent_from_child: NDArray[np.float64]
                  ) -> TransformStamped:
    """Return a transform (4, 4), child to parent, as a message; the header names the parent."""
    pose = pose_to_msg(parent_from_child)
    msg = TransformStamped(header=Header(stamp=header.stamp, frame_id=header.frame_id),
                           child_frame_id=child_frame)
    p, t = pose.position, msg.transform.translation
    t.x, t.y, t.z, msg.transform.rotation = p.x, p.y, p.z, pose.orientation
    return msg

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the camera's frame to the robot's."""

from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time as RclTime

from cliploc_ros.core.geometry.transforms import invert_transform, transform_from_pose
from cliploc_ros.errors import CliplocError

# An image so much older than another tells that time jumped; tf2 keeps ten seconds.
_JUMP_BACK_NS = 10_000_000_000


class FrameError(CliplocError):
    """A transform that nobody gives."""


class BaseFrame:
    """Where the robot's base stands when its camera is somewhere.

    tf2_ros is imported only when it is asked: a mount given as a parameter needs none.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._buffer: Any = None
        self._listener: Any = None
        self._newest_ns = 0

    def camera_from_base(self, base_frame: str, mount: list[float], camera_frame: str,
                         stamp: Time, timeout_s: float) -> NDArray[np.float64]:
        """Return the pose (4, 4) of the frame to publish, seen from the camera.

        Parameters
        ----------
        base_frame : str
            Empty: the camera itself.
        mount : list of float
            base_from_camera as x, y, z [m] and quaternion x, y, z, w; all zeros: ask tf2.
        camera_frame : str
            frame_id of the image.
        stamp : Time
            Of the image: the mount may move.
        timeout_s : float
            How long tf2 may take [s].

        Raises
        ------
        FrameError
            tf2 is not installed or has no such transform.
        """
        if not base_frame:
            return np.eye(4)
        if any(mount):
            return invert_transform(transform_from_pose(np.array(mount[:3]),
                                                        np.array(mount[3:])))
        return self.lookup(camera_frame, base_frame, stamp, timeout_s)

    def lookup(self, target_frame: str, source_frame: str, stamp: Time, timeout_s: float
               ) -> NDArray[np.float64]:
        """Return target_from_source (4, 4) as tf2 has it at a time.

        Raises
        ------
        FrameError
            tf2 is not installed or has no such transform in time.
        """
        self.listen()
        at = RclTime.from_msg(stamp)
        if at.nanoseconds < self._newest_ns - _JUMP_BACK_NS:
            # simulated time began anew; tf2 would refuse what comes now as too old
            self._buffer.clear()
            self._newest_ns = 0
        self._newest_ns = max(at.nanoseconds, self._newest_ns)
        try:
            found = self._buffer.lookup_transform(target_frame, source_frame, at,
                                                  Duration(seconds=timeout_s)).transform
        except Exception as error:  # tf2 raises many types, all of which mean: not now
            raise FrameError(f"no transform from '{source_frame}' to '{target_frame}': {error}; "
                             'publish it, or set base_from_camera') from error
        t, q = found.translation, found.rotation
        return transform_from_pose(np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w]))

    def listen(self) -> None:
        """Begin to hear of transforms, so that those of the first image are known.

        Raises
        ------
        FrameError
            tf2 is not installed.
        """
        if self._buffer is not None:
            return
        try:
            from tf2_ros import Buffer, TransformListener
        except ImportError as error:
            raise FrameError('a transform is needed, but tf2_ros is not installed: install it, '
                             'or set base_from_camera') from error
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self._node)

    def forget(self) -> None:
        """Hear of transforms no longer."""
        if self._listener is not None:
            self._listener.unregister()
        self._buffer = self._listener = None
        self._newest_ns = 0

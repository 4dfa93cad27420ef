# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the camera's frame to the robot's."""

from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node

from cliploc_ros.core.transforms import invert_transform, transform_from_pose
from cliploc_ros.errors import CliplocError


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
        self.listen()
        try:
            found = self._buffer.lookup_transform(camera_frame, base_frame, stamp,
                                                  Duration(seconds=timeout_s)).transform
        except Exception as error:  # tf2 raises many types, all of which mean: not now
            raise FrameError(f"no transform from '{base_frame}' to '{camera_frame}': {error}; "
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
            raise FrameError('base_frame is set, but tf2_ros is not installed: install it, or '
                             'set base_from_camera') from error
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self._node)

    def forget(self) -> None:
        """Hear of transforms no longer."""
        if self._listener is not None:
            self._listener.unregister()
        self._buffer = self._listener = None

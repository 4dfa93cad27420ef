# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Transforms: the camera's mount from parameters or tf2, all others from tf2."""

from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time as RclTime

from cliploc_ros.core.geometry.transforms import invert_transform, transform_from_pose
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros.conversions import matrix_from_msg, stamp_ns
from cliploc_ros.ros.inputs.stamps import StampOrder


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

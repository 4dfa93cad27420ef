# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A tf2 buffer that handles time jumps. This module needs tf2_ros."""

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from tf2_ros import Buffer, TransformListener

from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.stamps import StampOrder


class TransformBuffer(Buffer):
    """A buffer of `/tf` and `/tf_static` that is cleared when the stamps of a transform go back.

    tf2 itself refuses transforms that are ten seconds older than the newest one, and interpolates
    across shorter jumps. Jazzy's Buffer is cleared only if it is given a node, and its first
    releases raise TypeError then. Transforms from before the jump may also arrive after the clock
    has jumped. clear() keeps static transforms.
    """

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._stamps = StampOrder()
        self._listener = TransformListener(self, node)

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        """Add a transform; forget the other transforms if time jumped back."""
        if self._stamps.goes_back(transform.child_frame_id, stamp_ns(transform.header.stamp)):
            super().clear()
        super().set_transform(transform, authority)

    def clear(self) -> None:
        """Forget all transforms except static ones."""
        self._stamps.clear()
        super().clear()

    def close(self) -> None:
        """Unsubscribe."""
        self._listener.unregister()

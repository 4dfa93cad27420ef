# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Images for the detector."""

import time
from collections.abc import Callable
from typing import NamedTuple

from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from cliploc_ros.ros import qos
from cliploc_ros.ros.inputs.subscription import AdaptiveSubscription
from cliploc_ros.ros.node.diagnostics import Health


class TimedImage(NamedTuple):
    """An image, and when it arrived (monotonic clock) [s]."""

    msg: Image | CompressedImage
    received_at: float


class ImageSource:
    """Subscribes to images while it is open.

    Parameters
    ----------
    node : Node
    transport : str
        'raw' or 'compressed'.
    on_image : callable
        Takes each TimedImage, in the executor's thread.
    """

    def __init__(self, node: Node, transport: str, on_image: Callable[[TimedImage], None]
                 ) -> None:
        self._node = node
        self._type = Image if transport == 'raw' else CompressedImage
        self._name = 'image' if transport == 'raw' else 'image/compressed'
        self._on_image = on_image
        self._subscription: AdaptiveSubscription | None = None
        self._heard_at = 0.0
        self.received = 0

    @property
    def is_open(self) -> bool:
        """Return whether it subscribes."""
        return self._subscription is not None

    def open(self) -> None:
        """Subscribe, if it does not yet."""
        if self._subscription is None:
            self._heard_at = time.monotonic()  # silence counts from here
            self._subscription = AdaptiveSubscription(self._node, self._type, self._name,
                                                      self._take, qos.IMAGE)

    def close(self) -> None:
        """Unsubscribe."""
        if self._subscription is not None:
            self._subscription.destroy()
            self._subscription = None

    def examine(self, health: Health, stale_after_s: float) -> None:
        """Report a topic without a publisher, and silence."""
        topic = self._node.resolve_topic_name(self._name)
        silent_s = time.monotonic() - self._heard_at
        if self._node.count_publishers(topic) == 0:
            health.warn(f'no image: nobody publishes {topic}; remap it, or start its publisher')
        elif self.is_open and silent_s > stale_after_s:
            health.warn(f'no image on {topic} for {silent_s:.1f} s')

    def _take(self, msg: Image | CompressedImage) -> None:
        self.received += 1
        self._heard_at = time.monotonic()
        self._on_image(TimedImage(msg, self._heard_at))

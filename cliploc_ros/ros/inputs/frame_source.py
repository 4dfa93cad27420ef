# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames from the wire: image, camera_info and detections of the same stamp."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from vision_msgs.msg import Detection2DArray

from cliploc_ros.errors import CliplocError, StoppedError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.pairing import ExactPairing
from cliploc_ros.ros.inputs.subscription import AdaptiveSubscription
from cliploc_ros.ros.node.diagnostics import Health, Rates

# What may wait for its counterparts: ten seconds of 30 Hz VGA images for a slow detector.
_MAX_WAITING = 2000
_MAX_IMAGE_BYTES = 256 * 2**20
_MAX_DETECTIONS_BYTES = 16 * 2**20
# A guess at what one detection holds in Python's memory.
_DETECTION_BYTES = 2000


class NoFrameError(CliplocError):
    """No complete frame came in time; the message says what was missing."""


@dataclass(frozen=True)
class Frame:
    """The messages of one instant, and when the image arrived (monotonic clock) [s]."""

    image: Image | CompressedImage
    camera_info: CameraInfo
    detections: Detection2DArray
    received_at: float


class FrameSource:
    """Subscribes while somebody needs frames, and only then.

    Parameters
    ----------
    node : Node
    transport : str
        'raw' or 'compressed'.
    on_frame : callable
        Called with each complete frame, in the executor's thread.
    """

    def __init__(self, node: Node, transport: str, on_frame: Callable[[Frame], None]) -> None:
        self._node = node
        self._image_type = Image if transport == 'raw' else CompressedImage
        self._topics = {'image': 'image' if transport == 'raw' else 'image/compressed',
                        'camera_info': 'camera_info', 'detections': 'detections'}
        self._on_frame = on_frame
        self._pairing = ExactPairing({'image': _MAX_IMAGE_BYTES, 'camera_info': 2**20,
                                      'detections': _MAX_DETECTIONS_BYTES}, _MAX_WAITING)
        self._changed = threading.Condition()
        self._heard_at: dict[str, float] = {}
        self._subscriptions: list[AdaptiveSubscription] = []
        self._listeners = 0
        self._listening_since = 0.0
        self._rates = Rates()
        self._newest: Frame | None = None
        self._stopped = ''

    @property
    def image_topic(self) -> str:
        """Return where images come from."""
        return self._resolved('image')

    def open(self) -> None:
        """Listen until closed as often as opened."""
        with self._changed:
            if self._listeners == 0:
                self._listening_since = time.monotonic()
                self._subscribe()
            self._listeners += 1

    def close(self) -> None:
        """End what one open began; with the last one the subscriptions end."""
        with self._changed:
            self._listeners -= 1
            if self._listeners == 0:
                self._unsubscribe()

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Listen for the length of a with statement."""
        self.open()
        try:
            yield
        finally:
            self.close()

    def wait_for_fresh(self, timeout_s: float) -> Frame:
        """Return the first complete frame whose image arrives from now on.

        Parameters
        ----------
        timeout_s : float
            [s]

        Raises
        ------
        NoFrameError
            None came in time; the message says what was missing.
        StoppedError
            Somebody called stop; the message says why.
        """
        now = time.monotonic()
        with self._changed:
            self._changed.wait_for(lambda: self._stopped or self._newest_since(now) is not None,
                                   timeout_s)
            if self._stopped:
                raise StoppedError(self._stopped)
            frame = self._newest_since(now)
            if frame is None:
                raise NoFrameError(f'no fresh frame within {timeout_s:g} s: '
                                   f'{self._why_none(now)}')
            return frame

    def stop(self, reason: str) -> None:
        """Release for good everybody who waits, with a reason to give them."""
        with self._changed:
            self._stopped = reason
            self._changed.notify_all()

    def forget(self) -> None:
        """Forget all messages: time jumped."""
        with self._changed:
            self._pairing.clear()
            self._newest = None

    def examine(self, health: Health, stale_after_s: float) -> None:
        """Say what is missing of the input, how often it comes, and what waits or was lost."""
        now = time.monotonic()
        with self._changed:
            for name in self._topics:
                silent_s = now - max(self._heard_at.get(name, 0.0), self._listening_since)
                nobody = self._node.count_publishers(self._resolved(name)) == 0
                if nobody or (self._listeners and silent_s > stale_after_s):
                    # without intrinsics there is never a pose; images and detections may pause
                    tell = health.fail if name == 'camera_info' else health.warn
                    tell(self._silence(name) if nobody else
                         f'no {name} on {self._resolved(name)} for {silent_s:.1f} s')
            rates = self._rates.update(self._pairing.received)
            oldest = self._pairing.oldest('image')
            health.values |= {f'{name} rate [Hz]': f'{rate:.1f}' for name, rate in rates.items()}
            health.values |= {
                'images dropped unpaired': self._pairing.dropped['image'],
                'queue age [s]': f'{now - oldest[1] if oldest else 0.0:.2f}'}

    def _newest_since(self, moment: float) -> Frame | None:
        newest = self._newest
        return newest if newest is not None and newest.received_at >= moment else None

    def _subscribe(self) -> None:
        self._unsubscribe()  # what a failed attempt left behind
        for name, message_type, profile in (('image', self._image_type, qos.IMAGE),
                                            ('camera_info', CameraInfo, qos.CAMERA_INFO),
                                            ('detections', Detection2DArray, qos.DETECTIONS_IN)):
            self._subscriptions.append(AdaptiveSubscription(
                self._node, message_type, self._topics[name], self._receiver(name), profile))

    def _unsubscribe(self) -> None:
        for subscription in self._subscriptions:
            subscription.destroy()
        self._subscriptions.clear()
        self._pairing.clear()
        self._newest = None

    def _receiver(self, name: str) -> Callable[[Any], None]:
        def receive(msg: Any) -> None:
            self._take(name, msg)
        return receive

    def _take(self, name: str, msg: Any) -> None:
        """Take one message in, and pass the frame on that it completes."""
        size = {'image': lambda: len(msg.data), 'camera_info': lambda: 1000,
                'detections': lambda: _DETECTION_BYTES * (1 + len(msg.detections))}[name]()
        with self._changed:
            if not self._listeners:
                return
            self._heard_at[name] = time.monotonic()
            complete = self._pairing.add(name, stamp_ns(msg.header.stamp),
                                         (msg, time.monotonic()), size)
            if complete is None:
                return
            image, received_at = complete['image']
            frame = Frame(image, complete['camera_info'][0], complete['detections'][0],
                          received_at)
            self._newest = frame
            self._changed.notify_all()
        self._on_frame(frame)

    def _why_none(self, since: float) -> str:
        """Say what was missing since a moment of the monotonic clock."""
        missing = [self._silence(name) for name in self._topics
                   if self._heard_at.get(name, -math.inf) < since]
        if missing:
            return '; '.join(missing)
        stamps = ', '.join(f'{self._resolved(name)} {stamp / 1e9:.6f}'
                           for name, stamp in self._pairing.last_stamp_ns.items())
        return (f'stamps never match (last seen: {stamps}): camera_info and detections must '
                "carry their image's header; if detections are merely late, the detector is too "
                'slow for timeout_s')

    def _silence(self, name: str) -> str:
        topic = self._resolved(name)
        publishers = self._node.count_publishers(topic)
        if publishers:
            return (f'no {name} on {topic}, though it has {publishers} publisher(s): is it '
                    'sending, and is its QoS compatible?')
        return f'no {name}: nobody publishes {topic}; remap it, or start its publisher'

    def _resolved(self, name: str) -> str:
        return str(self._node.resolve_topic_name(self._topics[name]))

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The detector node: images in, detections out, and only while something listens."""

import threading
import time
from collections.abc import Mapping
from typing import Any, NamedTuple, NoReturn

from rclpy.event_handler import PublisherEventCallbacks
from sensor_msgs.msg import CompressedImage, Image
from vision_msgs.msg import Detection2DArray

from cliploc_ros.errors import CliplocError
from cliploc_ros.messages import image_from_msg
from cliploc_ros.models.yolo_detector import YoloDetector, YoloOptions
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import detections_to_msg
from cliploc_ros.ros.inputs.subscription import AdaptiveSubscription
from cliploc_ros.ros.node.diagnostics import Health, Rates, StageTimes
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.node.parameters import Value
from cliploc_ros.ros.node.process import run_node
from cliploc_ros.ros.node.worker import LatestOnly
from cliploc_ros.ros.parameter_tables import DETECTOR

_LOG_PERIOD_S = 5.0


class TimedImage(NamedTuple):
    """An image, and when it arrived (monotonic clock) [s]."""

    msg: Image | CompressedImage
    received_at: float


class DetectorNode(ManagedNode):
    """Publishes what a YOLO network sees in the newest image."""

    def __init__(self) -> None:
        super().__init__('detector', DETECTOR, detector_options)
        self._detector: YoloDetector | None = None
        self._images: LatestOnly[TimedImage] = LatestOnly(self.worker, self._detect)
        self._received, self._heard_at = 0, 0.0
        self._published = 0
        self._last_error = ''
        self._rates = Rates()
        # matched in one thread, activated in another
        self._lock = threading.Lock()
        self._open = False
        self._subscription: AdaptiveSubscription | None = None
        self._publisher = self.create_publisher(
            Detection2DArray, 'detections', qos.DETECTIONS_OUT,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: self._listen_if_wanted()),
            qos_overriding_options=qos.overridable())

    def load(self) -> str:
        """Load the network."""
        self._detector = YoloDetector(detector_options(self.settings.snapshot()))
        return f"detector {self.settings['model']}"

    def unload(self) -> None:
        """Let go the network."""
        self._detector = None

    def open(self) -> None:
        """Listen to images while somebody listens to detections."""
        self._open = True
        self._listen_if_wanted()

    def close(self) -> None:
        """Listen to nothing."""
        self._open = False
        self._listen_if_wanted()

    def _listen_if_wanted(self) -> None:
        """Listen to images exactly while this node is open and its detections are heard."""
        with self._lock:
            wanted = self._open and self._publisher.get_subscription_count() > 0
            if wanted and self._subscription is None:
                self._heard_at = time.monotonic()  # from now on images are missed
                raw = self.settings['image_transport'] == 'raw'
                self._subscription = AdaptiveSubscription(
                    self, Image if raw else CompressedImage, self._topic, self._on_image,
                    qos.IMAGE)
            elif not wanted and self._subscription is not None:
                self._subscription.destroy()
                self._subscription = None

    @property
    def _topic(self) -> str:
        raw = self.settings['image_transport'] == 'raw'
        return self.resolve_topic_name('image' if raw else 'image/compressed')

    def _on_image(self, msg: Image | CompressedImage) -> None:
        self._received += 1
        self._heard_at = time.monotonic()
        self._images.offer(TimedImage(msg, self._heard_at))

    def _detect(self, image: TimedImage) -> None:
        """Detect in one image and publish; in the worker's thread."""
        if not self.active or self._detector is None:
            return  # deactivated while the image waited
        times = StageTimes(image.received_at)
        times.mark('waiting')
        try:
            self._detector.configure(detector_options(self.settings.snapshot()))
            pixels = image_from_msg(image.msg)
            times.mark('decoding')
            detections = self._detector.detect(pixels)
        except CliplocError as error:
            self._last_error = str(error)
            self.get_logger().error(self._last_error, throttle_duration_sec=_LOG_PERIOD_S)
            return
        times.mark('detection')
        self._last_error = ''
        self.stages.add(times.ms)
        if self.active:
            self._published += 1
            self._publisher.publish(detections_to_msg(detections, image.msg.header))

    def examine(self, health: Health) -> None:
        """Say whether images come, how many are worked on, and where."""
        now, waiting = time.monotonic(), self._images.waiting
        silent_s = now - self._heard_at
        if self.count_publishers(self._topic) == 0:
            health.warn(f'no image: nobody publishes {self._topic}; remap it, or start its '
                        'publisher')
        elif self._subscription is not None and silent_s > self.settings['stale_after_s']:
            health.warn(f'no image on {self._topic} for {silent_s:.1f} s')
        if self._last_error:
            health.warn(self._last_error)
        rates = self._rates.update({'image': self._received, 'detections': self._published})
        health.values |= {f'{name} rate [Hz]': f'{rate:.1f}' for name, rate in rates.items()}
        health.values |= {'listened to': self._subscription is not None,
                          'images dropped': self._images.dropped,
                          'queue age [s]': f'{now - waiting.received_at if waiting else 0.0:.2f}'}
        if self._detector is not None:
            health.values['device'] = self._detector.device


def detector_options(values: Mapping[str, Value]) -> YoloOptions:
    """Return the network's options from the values of the detector's parameters."""
    fields: Any = {name: values[name] for name in YoloOptions.__dataclass_fields__
                   if name in values}
    return YoloOptions(**fields)


def main() -> NoReturn:
    """Run the node until it is told to stop."""
    run_node(DetectorNode)


if __name__ == '__main__':
    main()

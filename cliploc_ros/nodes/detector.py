# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The detector node: images in, detections out, and only while something listens."""

from collections.abc import Mapping
from typing import Any, NoReturn

from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from sensor_msgs.msg import CompressedImage, Image
from vision_msgs.msg import Detection2DArray

from cliploc_ros.errors import CliplocError
from cliploc_ros.messages import image_from_msg
from cliploc_ros.models.yolo_detector import YoloDetector, YoloOptions
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import detections_to_msg
from cliploc_ros.ros.parameters import NodeParameters, Value
from cliploc_ros.ros.process import WorkingNode, run_node
from cliploc_ros.ros.subscription import AdaptiveSubscription
from cliploc_ros.ros.tables import DETECTOR
from cliploc_ros.ros.worker import LatestOnly, Retrying

_RETRY_PAUSE_S = 5.0
_LOG_PERIOD_S = 5.0


class DetectorNode(WorkingNode):
    """Publishes what a YOLO network sees in the newest image."""

    def __init__(self) -> None:
        super().__init__('detector')
        self._settings = NodeParameters(self, DETECTOR, detector_options)
        self._detector = Retrying(self._load, _RETRY_PAUSE_S)
        self._images: LatestOnly[Image | CompressedImage] = LatestOnly(self.worker, self._detect)
        self._subscription: AdaptiveSubscription | None = None
        self._publisher = self.create_publisher(
            Detection2DArray, 'detections', qos.DETECTIONS_OUT,
            event_callbacks=PublisherEventCallbacks(matched=self._on_matched),
            qos_overriding_options=qos.overridable())
        self.worker.submit(self._load_ahead)

    def _load(self) -> YoloDetector:
        return YoloDetector(detector_options(self._settings.snapshot()))

    def _load_ahead(self) -> None:
        """Load the network before the first image needs it."""
        try:
            self._detector.get()
            self.get_logger().info(f"detector ready: {self._settings['model']}")
        except CliplocError as error:
            self.get_logger().error(str(error))

    def _on_matched(self, info: QoSPublisherMatchedInfo) -> None:
        """Listen to images exactly while somebody listens to detections."""
        if info.current_count > 0 and self._subscription is None:
            raw = self._settings['image_transport'] == 'raw'
            self._subscription = AdaptiveSubscription(
                self, Image if raw else CompressedImage, 'image' if raw else 'image/compressed',
                self._images.offer, qos.IMAGE)
        elif info.current_count == 0 and self._subscription is not None:
            self._subscription.destroy()
            self._subscription = None

    def _detect(self, msg: Image | CompressedImage) -> None:
        """Detect in one image and publish; in the worker's thread."""
        try:
            detector = self._detector.get()
            detector.configure(detector_options(self._settings.snapshot()))
            detections = detector.detect(image_from_msg(msg))
        except CliplocError as error:
            self.get_logger().error(str(error), throttle_duration_sec=_LOG_PERIOD_S)
            return
        self._publisher.publish(detections_to_msg(detections, msg.header))


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

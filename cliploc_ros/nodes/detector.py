# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Publishes the detections of a network in the newest image, while they have a subscriber.

  in    image, image/compressed
  out   detections, /diagnostics

The network is that of the parameter model, or of profile.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, NoReturn

from rclpy.event_handler import PublisherEventCallbacks
from sensor_msgs.msg import CompressedImage, Image
from vision_msgs.msg import Detection2DArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CliplocError
from cliploc_ros.messages import image_from_msg
from cliploc_ros.models import protocols
from cliploc_ros.models.onnx_detector import GREY, is_grey, load_detector
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import detections_to_msg, of_camera, stamp_ns
from cliploc_ros.ros.node.diagnostics import Health, Rates, StageTimes
from cliploc_ros.ros.node.lifecycle import LOG_PERIOD_S, ManagedNode, run_node
from cliploc_ros.ros.node.threads import LatestOnly, Worker
from cliploc_ros.ros.parameters import DetectorParameters, RelocalizerParameters, path_of


class TimedImage(NamedTuple):
    """An image and its arrival (monotonic clock) [s]."""

    msg: Image | CompressedImage
    received_at: float


class NewestInstant:
    """Passes images of several cameras to a worker, one of each with the closest stamps.

    While the worker is busy, the two newest images of each camera wait. The other cameras may not
    have delivered an image of the newest instant yet.

    Parameters
    ----------
    work : callable
        Called with the name of a camera and an image, in the worker's thread.
    """

    def __init__(self, worker: Worker, work: Callable[[str, TimedImage], None]) -> None:
        self._work = work
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[TimedImage]] = {}
        self._signal = LatestOnly(worker, self._take)
        self.dropped = 0

    @property
    def waiting_since(self) -> float | None:
        """Return when the oldest waiting image arrived (monotonic clock) [s]; None without any."""
        with self._lock:
            return min((image.received_at for images in self._waiting.values()
                        for image in images), default=None)

    def offer(self, camera: str, image: TimedImage) -> None:
        """Queue an image of a camera."""
        with self._lock:
            images = self._waiting.setdefault(camera, deque(maxlen=2))
            self.dropped += len(images) == 2  # the oldest image
            images.append(image)
        self._signal.offer(camera)

    def _take(self, camera: str) -> None:
        """Process the newest instant of which all cameras with waiting images have one."""
        with self._lock:
            waiting = {name: images for name, images in self._waiting.items() if images}
            newest_ns = min(_image_ns(images[-1]) for images in waiting.values())
            taken = {}
            for name, images in waiting.items():
                taken[name] = min(images, key=lambda image: abs(_image_ns(image) - newest_ns))
                while images.popleft() is not taken[name]:
                    self.dropped += 1
            more = any(waiting.values())
        for name, image in taken.items():
            self._work(name, image)
        if more:
            self._signal.offer(camera)


def _image_ns(image: TimedImage) -> int:
    return stamp_ns(image.msg.header.stamp)


class _Camera:
    """Receives the images of a camera while they are wanted, and publishes its detections."""

    def __init__(self, node: ManagedNode[DetectorParameters], name: str, newest: NewestInstant,
                 on_match: Callable[[], None]) -> None:
        self._node, self._name, self._newest = node, name, newest
        is_raw = node.settings.values.image_transport == 'raw'
        self._type = Image if is_raw else CompressedImage
        self._topic = of_camera(name, 'image' if is_raw else 'image/compressed')
        #: None while the images are not wanted
        self.subscription: qos.AdaptiveSubscription | None = None
        self._heard_at = 0.0
        self._counts, self._rates = {'image': 0, 'detections': 0}, Rates()
        self._publisher = node.create_publisher(
            Detection2DArray, of_camera(name, 'detections'), qos.DETECTIONS_OUT,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: on_match()),
            qos_overriding_options=qos.overridable())

    @property
    def is_wanted(self) -> bool:
        """Return whether the detections have a subscriber."""
        return bool(self._publisher.get_subscription_count() > 0)

    def open(self) -> None:
        """Subscribe to the images, unless already subscribed."""
        if self.subscription is None:
            self._heard_at = time.monotonic()  # the time of silence starts here
            self.subscription = qos.AdaptiveSubscription(self._node, self._type, self._topic,
                                                     self._take, qos.IMAGE)

    def close(self) -> None:
        """Unsubscribe."""
        if self.subscription is not None:
            self.subscription.destroy()
            self.subscription = None

    def publish(self, detections: Detection2DArray) -> None:
        """Publish the detections of an image."""
        self._counts['detections'] += 1
        self._publisher.publish(detections)

    def examine(self, health: Health, stale_after_s: float) -> None:
        """Report a missing publisher, missing images, and rates."""
        own, topic = Health(), qos.resolved(self._node, self._topic)
        silent_s = time.monotonic() - self._heard_at
        is_silent = self.subscription is not None and silent_s > stale_after_s
        if is_silent or self._node.count_publishers(topic) == 0:
            own.warn(qos.why_silent(self._node, 'image', topic, self._type))
        if is_silent:
            self._node.get_logger().warning(own.message, once=True)
        own.values |= {f'{name} rate [Hz]': f'{rate:.1f}'
                       for name, rate in self._rates.update(self._counts).items()}
        own.values['listened to'] = self.subscription is not None
        health.add(own, self._name)

    def _take(self, msg: Image | CompressedImage) -> None:
        self._counts['image'] += 1
        self._heard_at = time.monotonic()
        self._newest.offer(self._name, TimedImage(msg, self._heard_at))


class DetectorNode(ManagedNode[DetectorParameters]):
    """Publishes the detections of a YOLO network in the newest image of each camera."""

    def __init__(self) -> None:
        super().__init__('detector', DetectorParameters, RelocalizerParameters)
        #: The network, None unless it is loaded
        self.detector: protocols.ObjectDetector | None = None
        # The node is opened in one thread, subscribers are matched in another.
        self._lock = threading.Lock()
        self._open = False
        self._newest = NewestInstant(self.worker, self._detect)
        self._cameras = {name: _Camera(self, name, self._newest, self._update)
                         for name in self.settings.values.camera_names or ('',)}
        self._last_error, self._is_grey = '', False

    def load(self) -> str:
        """Load the network."""
        parameters = self.settings.snapshot()
        prompts: protocols.Prompts = ()
        if parameters.vocabulary == 'map':
            file = path_of(parameters.map_file)
            prompts = protocols.prompts_of_map(LandmarkMap.from_file(file), file)
        elif parameters.vocabulary:
            prompts = protocols.prompts_of_names(parameters.vocabulary)
        options = replace(
            protocols.with_detector(detector_options(parameters), parameters.profile),
            prompts=prompts, text_model=parameters.text_model)
        self.detector = load_detector(options)
        of_texts = f', {len(options.prompts)} texts' if options.prompts else ''
        return f'detector {options.model}{of_texts}'

    def unload(self) -> None:
        """Drop the network."""
        self.detector = None

    def open(self) -> None:
        """Subscribe to images while something subscribes to detections."""
        self._open = True
        self._update()

    def close(self) -> None:
        """Unsubscribe."""
        self._open = False
        self._update()

    def examine(self, health: Health) -> None:
        """Report the input, rates and dropped messages."""
        for camera in self._cameras.values():
            camera.examine(health, self.settings.values.stale_after_s)
        if self._last_error:
            health.warn(self._last_error)
        if self._is_grey:
            health.warn(GREY)
        since = self._newest.waiting_since
        health.values |= {'images dropped': self._newest.dropped, 'queue age [s]':
                          f'{0.0 if since is None else time.monotonic() - since:.2f}'}

    def _update(self) -> None:
        """Subscribe to the images of each camera whose detections have a subscriber."""
        with self._lock:
            for camera in self._cameras.values():
                if self._open and camera.is_wanted:
                    camera.open()
                else:
                    camera.close()

    def _detect(self, name: str, image: TimedImage) -> None:
        """Publish the detections in an image; runs in the worker's thread."""
        camera = self._cameras[name]
        if not self.active or self.detector is None or not camera.subscription:
            return  # while the image waited, the node was deactivated or lost its subscribers
        times = StageTimes('waiting', image.received_at)
        times.begin('decoding')
        try:
            self.detector.configure(detector_options(self.settings.snapshot()))
            pixels = image_from_msg(image.msg)
            self._is_grey = is_grey(pixels)
            times.begin('detection')
            detections = self.detector.detect(pixels)
        except CliplocError as error:
            self._last_error = str(error)
            self.get_logger().error(self._last_error, throttle_duration_sec=LOG_PERIOD_S)
            return
        self._last_error = ''
        self.stages.add(times.ms)
        if self.active:
            camera.publish(detections_to_msg(detections, image.msg.header))


def detector_options(parameters: DetectorParameters) -> protocols.DetectorOptions:
    """Return the network's options."""
    return protocols.DetectorOptions(
        model=parameters.model, conf=parameters.conf, iou=parameters.iou, imgsz=parameters.imgsz,
        max_det=parameters.max_det, cache_dir=parameters.cache_dir)


def main() -> NoReturn:
    """Run the node until SIGINT or SIGTERM."""
    run_node('detector', DetectorNode, __doc__)


if __name__ == '__main__':
    main()

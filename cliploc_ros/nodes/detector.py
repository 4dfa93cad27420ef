# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The detector node: images in, detections out, and only while something subscribes to them."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, NoReturn

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image
from vision_msgs.msg import Detection2DArray

from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.errors import CliplocError
from cliploc_ros.messages import image_from_msg
from cliploc_ros.models.open_vocabulary import prompts_of_map, prompts_of_names
from cliploc_ros.models.profiles import load_detector, with_detector
from cliploc_ros.models.protocols import DetectorOptions, ObjectDetector, Prompts
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import detections_to_msg, of_camera, stamp_ns
from cliploc_ros.ros.inputs.subscription import AdaptiveSubscription
from cliploc_ros.ros.map_parameters import path_of
from cliploc_ros.ros.node.diagnostics import Health, Rates, StageTimes
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.node.process import run_node
from cliploc_ros.ros.node.threads import LatestOnly, Worker
from cliploc_ros.ros.parameters import DetectorParameters, RelocalizerParameters

_LOG_PERIOD_S = 5.0
ABOUT = """\
Publishes what a network detects in the newest image, while something subscribes to it.

  in    image, image/compressed
  out   detections, /diagnostics
"""


class TimedImage(NamedTuple):
    """An image, and when it arrived (monotonic clock) [s]."""

    msg: Image | CompressedImage
    received_at: float


class ImageSource:
    """Subscribes to images, 'raw' or 'compressed', while it is open.

    `on_image` takes each TimedImage, in the executor's thread. `camera` is the namespace of the
    topic.
    """

    def __init__(self, node: Node, transport: str, on_image: Callable[[TimedImage], None],
                 camera: str = '') -> None:
        self._node = node
        self._type = Image if transport == 'raw' else CompressedImage
        self._name = of_camera(camera, 'image' if transport == 'raw' else 'image/compressed')
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


class NewestInstant:
    """Passes images of several cameras to a worker: one of each, as near in time as they come.

    While the worker is busy, the two newest images of each camera wait: the newest may be of an
    instant that other cameras have not delivered yet.

    Parameters
    ----------
    work : callable
        Takes the name of a camera and an image, in the worker's thread.
    """

    def __init__(self, worker: Worker, work: Callable[[str, TimedImage], None]) -> None:
        self._work = work
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[TimedImage]] = {}
        self._signal = LatestOnly(worker, self._take)
        self.dropped = 0

    @property
    def waiting_since(self) -> float | None:
        """Return when the oldest image that waits arrived (monotonic clock) [s]."""
        with self._lock:
            return min((one.received_at for images in self._waiting.values() for one in images),
                       default=None)

    def offer(self, camera: str, image: TimedImage) -> None:
        """Queue an image of a camera."""
        with self._lock:
            images = self._waiting.setdefault(camera, deque())
            images.append(image)
            if len(images) > 2:
                images.popleft()
                self.dropped += 1
        self._signal.offer(camera)

    def _take(self, camera: str) -> None:
        """Work on the newest instant that all cameras with an image have."""
        with self._lock:
            waiting = {name: images for name, images in self._waiting.items() if images}
            newest_ns = min(_image_ns(images[-1]) for images in waiting.values())
            taken = {}
            for name, images in waiting.items():
                taken[name] = min(images, key=lambda one: abs(_image_ns(one) - newest_ns))
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
    """The images of a camera, and what is published of them."""

    def __init__(self, node: ManagedNode[DetectorParameters], name: str, newest: NewestInstant,
                 on_match: Callable[[], None]) -> None:
        self.images = ImageSource(node, node.settings.values.image_transport,
                                  partial(newest.offer, name), name)
        self.publisher = node.create_publisher(
            Detection2DArray, of_camera(name, 'detections'), qos.DETECTIONS_OUT,
            event_callbacks=PublisherEventCallbacks(matched=lambda _: on_match()),
            qos_overriding_options=qos.overridable())
        self.published = 0
        self.rates = Rates()


class DetectorNode(ManagedNode[DetectorParameters]):
    """Publishes what a YOLO network detects in the newest image of each camera."""

    def __init__(self) -> None:
        super().__init__('detector', DetectorParameters, RelocalizerParameters)
        self._detector: ObjectDetector | None = None
        # The node opens in one thread; subscribers match in another.
        self._lock = threading.Lock()
        self._open = False
        self._newest = NewestInstant(self.worker, self._detect)
        self._cameras = {name: _Camera(self, name, self._newest, self._update)
                         for name in self.settings.values.camera_names or ('',)}
        self._last_error = ''
        # Since when boxes are awaited (monotonic clock) [s], and how long the first ones took.
        self._awaited_since = math.inf
        self._first_boxes_s: float | None = None

    def load(self) -> str:
        """Load the network."""
        parameters = self.settings.snapshot()
        options = replace(with_detector(detector_options(parameters), parameters.profile),
                          prompts=_prompts(parameters), text_model=parameters.text_model)
        self._detector = load_detector(options)
        of_texts = f', {len(options.prompts)} texts' if options.prompts else ''
        return f'detector {options.model} ({self._detector.inference}{of_texts})'

    @property
    def detector(self) -> ObjectDetector | None:
        """Return the network, None unless it is loaded."""
        return self._detector

    def unload(self) -> None:
        """Drop the network."""
        self._detector = None

    def open(self) -> None:
        """Subscribe to images while something subscribes to detections."""
        self._open = True
        self._update()

    def close(self) -> None:
        """Unsubscribe."""
        self._open = False
        self._update()

    def examine(self, health: Health) -> None:
        """Report the input, rates, what was dropped, and the device."""
        for name, camera in self._cameras.items():
            own = Health()
            camera.images.examine(own, self.settings.values.stale_after_s)
            rates = camera.rates.update({'image': camera.images.received,
                                         'detections': camera.published})
            own.values |= {f'{topic} rate [Hz]': f'{rate:.1f}' for topic, rate in rates.items()}
            own.values['listened to'] = camera.images.is_open
            health.add(own, name)
        if self._last_error:
            health.warn(self._last_error)
        since = self._newest.waiting_since
        health.values |= {'images dropped': self._newest.dropped, 'queue age [s]':
                          f'{0.0 if since is None else time.monotonic() - since:.2f}'}
        if self._first_boxes_s is not None:
            health.values['first boxes after [s]'] = f'{self._first_boxes_s:.2f}'
        if self._detector is not None:
            health.values['device'] = self._detector.device

    def _update(self) -> None:
        """Subscribe to the images of each camera whose detections have a subscriber."""
        with self._lock:
            for camera in self._cameras.values():
                if self._open and camera.publisher.get_subscription_count() > 0:
                    if not any(one.images.is_open for one in self._cameras.values()):
                        self._awaited_since = time.monotonic()
                    camera.images.open()
                else:
                    camera.images.close()

    def _detect(self, name: str, image: TimedImage) -> None:
        """Detect objects in one image and publish them; in the worker's thread."""
        camera = self._cameras[name]
        if not self.active or self._detector is None or not camera.images.is_open:
            return  # deactivated, or the last subscriber left, while the image waited
        times = StageTimes('waiting', image.received_at)
        times.begin('decoding')
        try:
            self._detector.configure(detector_options(self.settings.snapshot()))
            pixels = image_from_msg(image.msg)
            times.begin('detection')
            detections = self._detector.detect(pixels)
        except CliplocError as error:
            self._last_error = str(error)
            self.get_logger().error(self._last_error, throttle_duration_sec=_LOG_PERIOD_S)
            return
        self._last_error = ''
        self.stages.add(times.ms)
        if self.active:
            camera.published += 1
            camera.publisher.publish(detections_to_msg(detections, image.msg.header))
            if self._awaited_since < math.inf:
                self._first_boxes_s = time.monotonic() - self._awaited_since
                self._awaited_since = math.inf


def _prompts(parameters: DetectorParameters) -> Prompts:
    """Return what the detector looks for; MapError: the map cannot be read."""
    if parameters.vocabulary != 'map':
        return prompts_of_names(parameters.vocabulary) if parameters.vocabulary else ()
    file = path_of(parameters.map_file)
    return prompts_of_map(LandmarkMap.from_file(file), file)


def detector_options(parameters: DetectorParameters) -> DetectorOptions:
    """Return the network's options."""
    return DetectorOptions(
        model=parameters.model, conf=parameters.conf, iou=parameters.iou, imgsz=parameters.imgsz,
        max_det=parameters.max_det, device=parameters.device, cache_dir=parameters.cache_dir,
        inference=parameters.inference)


def main() -> NoReturn:
    """Run the node until it is told to stop."""
    run_node('detector', DetectorNode, ABOUT)


if __name__ == '__main__':
    main()

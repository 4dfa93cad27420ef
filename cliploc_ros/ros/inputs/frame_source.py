# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames of one camera: image, camera_info and detections with the same stamp."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from vision_msgs.msg import Detection2DArray

from cliploc_ros.errors import CliplocError, StoppedError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import detection_type, of_camera, stamp_ns, tags_type
from cliploc_ros.ros.inputs.stamps import ExactPairing, MessageStamps, stamp_problem
from cliploc_ros.ros.node.diagnostics import Health, Rates
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S

# Messages that may wait for their counterparts: ten seconds of 30 Hz VGA images for a slow
# detector.
_MAX_WAITING = 2000
_MAX_IMAGE_BYTES = 256 * 2**20
_MAX_DETECTIONS_BYTES = 16 * 2**20
# Four seconds of 30 Hz VGA depth.
_MAX_DEPTH_BYTES = 72 * 2**20
# Optional topics of a frame.
_OF_DEPTH = ('depth', 'depth_camera_info')
# Memory of one detection in Python, estimated.
_DETECTION_BYTES = 2000
# Remedies for invalid stamps.
_STAMPING = {'image': 'the driver of the camera must stamp each image when it is taken',
             'detections': "the detector must copy the image's header"}
# Number of bytes of an image that identify it.
_SAMPLE = 4096


class NoFrameError(CliplocError):
    """No complete frame arrived in time; the message says what was missing."""


@dataclass(frozen=True)
class Frame:
    """The messages of one stamp."""

    image: Image | CompressedImage
    camera_info: CameraInfo
    detections: Detection2DArray
    #: When the image arrived, and when its detections arrived (monotonic clock) [s].
    received_at: float
    detected_at: float
    #: Depth within depth_tolerance_s of the image; None without depth
    depth: Image | CompressedImage | None = None
    depth_camera_info: CameraInfo | None = None  #: For unregistered depth
    camera: str = ''  #: Name of the camera; empty for a single camera
    beside: tuple['Frame', ...] = ()  #: Frames of other cameras at this instant
    left_out: tuple[str, ...] = ()  #: Names of the cameras without a frame at this instant
    image_topic: str = ''  #: Resolved name of the image topic
    tags: Any = None  #: AprilTagDetectionArray with `tags_type: apriltag_msgs`; else None

    @property
    def stamp_ns(self) -> int:
        """Return the stamp of the image [ns]."""
        return stamp_ns(self.image.header.stamp)

    @property
    def depth_frame(self) -> str:
        """Return the coordinate frame of the depth image; empty without depth."""
        return '' if self.depth is None else str(self.depth.header.frame_id)


class FrameSource:
    """Subscribes to the topics of a camera only while a frame is wanted.

    Images are expensive, and the detector is idle while nobody subscribes to its detections.

    Parameters
    ----------
    linger_s : float
        How long to stay subscribed after the last request for a frame [s]; inf: as long as the
        source is open.
    on_frame : callable
        Called with each complete frame in the executor's thread.
    camera : str
        Name of the camera, which is the namespace of its topics.
    changed : Condition, optional
        Notified when the source is closed. Several sources may share it.
    """

    def __init__(self, node: Node, parameters: RelocalizerParameters, linger_s: float,
                 on_frame: Callable[[Frame], None], camera: str = '',
                 changed: threading.Condition | None = None) -> None:
        self._node, self._camera = node, camera
        self._linger_s, self._on_frame = linger_s, on_frame
        self._package = parameters.detections_type
        self._detections_type, self._converted = detection_type('vision_msgs')
        is_raw, depth = parameters.image_transport == 'raw', parameters.depth_transport
        self._image_type = Image if is_raw else CompressedImage
        self._depth_type = Image if depth == 'raw' else CompressedImage
        topics = {'image': 'image' if is_raw else 'image/compressed',
                  'camera_info': 'camera_info'}
        if self._package != 'none':
            topics['detections'] = 'detections'
        if parameters.tags_type == 'apriltag_msgs':
            topics['tags'] = 'tags'
        if depth != 'none':
            topics |= {'depth': 'depth' if depth == 'raw' else 'depth/compressedDepth',
                       'depth_camera_info': 'depth_camera_info'}
        #: The relative names of the topics
        self.topics = {name: of_camera(camera, topic) for name, topic in topics.items()}
        # Arrival of the newest message of each topic (monotonic clock) [s].
        self._heard_at: dict[str, float] = {}
        self._depth_camera: CameraInfo | None = None
        #: Delay of the newest image after its stamp, and the delay closest to 0 of all images [s]
        self.lag_s, self.nearest_lag_s = math.nan, math.inf
        self._depth_tolerance_ns = round(parameters.depth_tolerance_s * NS_PER_S)
        self._depths: deque[Image | CompressedImage] = deque()
        self._pairing = ExactPairing({
            'image': _MAX_IMAGE_BYTES, 'camera_info': 2**20, 'detections': _MAX_DETECTIONS_BYTES,
            **({'tags': _MAX_DETECTIONS_BYTES} if 'tags' in topics else {})}, _MAX_WAITING,
            'image', 'detections')
        self._stamps = {'image': MessageStamps(), 'detections': MessageStamps()}
        self._static_info: CameraInfo | None = None
        self._unsure: Frame | None = None
        # When image and detections of the newest frame arrived (monotonic clock) [s].
        self._arrived_at = (-math.inf, -math.inf)
        self._changed = changed or threading.Condition()
        self._subscriptions: list[qos.AdaptiveSubscription] = []
        self._subscribed_at = 0.0
        # How long to stay subscribed (monotonic clock) [s]: deadlines of waiting callers, and the
        # end of the time after the last caller.
        self._deadlines: list[float] = []
        self._wanted_until = 0.0
        self._rates = Rates()
        #: Why the source is closed; empty while it is open
        self.closed = 'the node is not active'

    def open(self) -> None:
        """Allow calls of `want`.

        OptionsError: the message type of the detections is not installed.
        """
        with self._changed:
            self._detections_type, self._converted = detection_type(self._package)
            if 'tags' in self.topics:
                tags_type()
            self.closed = ''
            if self._linger_s == math.inf:
                self._wanted_until = math.inf
                self._subscribe()

    def close(self, reason: str) -> None:
        """Unsubscribe. From now on `want` raises StoppedError with this reason."""
        with self._changed:
            self.closed = reason
            self._deadlines.clear()
            self._unsubscribe()
            self._changed.notify_all()

    def forget(self) -> None:
        """Drop all received messages."""
        with self._changed:
            self._drop()
            for stamps in self._stamps.values():
                stamps.clear()

    def want(self, deadline: float) -> None:
        """Subscribe until a deadline (monotonic clock) [s], or until want_no_more.

        The caller holds the condition. StoppedError: the source was closed.
        """
        if self.closed:
            raise StoppedError(self.closed)
        self._deadlines.append(deadline)
        self._subscribe()

    def want_no_more(self, deadline: float, linger_s: float | None = None) -> None:
        """Unsubscribe after `linger_s`, by default that of the source, unless others wait.

        StoppedError: the source was closed.
        """
        if self.closed:
            raise StoppedError(self.closed)
        if deadline in self._deadlines:  # it is missing if the source was reopened meanwhile
            self._deadlines.remove(deadline)
        linger_s = self._linger_s if linger_s is None else linger_s
        self._wanted_until = max(self._wanted_until, time.monotonic() + linger_s)
        if not linger_s:
            self.rest()

    def rest(self) -> bool:
        """Unsubscribe if no frame is wanted any more; return whether the source is subscribed.

        The caller holds the condition.
        """
        if self._subscriptions and time.monotonic() >= max([self._wanted_until, *self._deadlines]):
            self._unsubscribe()
        return bool(self._subscriptions)

    def missing(self) -> list[str]:
        """Return a message with the remedy for each input without a publisher."""
        return [self._silence(name) for name in self.topics if name not in _OF_DEPTH
                and not self._node.count_publishers(self._resolved(name))]

    def examine(self, health: Health, stale_after_s: float) -> None:
        """Report missing inputs, rates, and numbers of waiting and dropped messages."""
        now = time.monotonic()
        with self._changed:
            for name in self.topics.keys() - {'depth_camera_info'}:
                silent_s = now - max(self._heard_at.get(name, 0.0), self._subscribed_at)
                nobody = not self._node.count_publishers(self._resolved(name))
                if nobody or (self._subscriptions and silent_s > stale_after_s):
                    # Without camera_info no pose is possible; images and detections may pause.
                    report = health.fail if name == 'camera_info' else health.warn
                    report(self._silence(name) if nobody else
                           f'no {name} on {self._resolved(name)} for {silent_s:.1f} s')
            for problem in self._stamp_problems():
                health.fail(problem)
            rates = self._rates.update(self._pairing.received)
            oldest = self._pairing.oldest('image')
            health.values |= {f'{name} rate [Hz]': f'{rate:.1f}' for name, rate in rates.items()}
            health.values |= {
                'images dropped unpaired': self._pairing.dropped['image'],
                'image after its stamp [s]': f'{self.lag_s:.3f}',
                'queue age [s]': f'{now - oldest[1] if oldest else 0.0:.2f}'}

    def awaits_detections(self, stamp_ns: int, tolerance_s: float) -> bool:
        """Return whether an image near a stamp waits for its detections.

        The caller holds the condition.
        """
        return any(abs(waiting_ns - stamp_ns) <= tolerance_s * NS_PER_S
                   for waiting_ns in self._pairing.waiting('image'))

    def _subscribe(self) -> None:
        if len(self._subscriptions) == len(self.topics):
            return
        self._unsubscribe()  # remove subscriptions of a failed attempt
        self._subscribed_at = time.monotonic()
        for name, topic in self.topics.items():
            message_type, profile = self._kinds[name]
            self._subscriptions.append(qos.AdaptiveSubscription(
                self._node, message_type, topic, partial(self._receive, name), profile))

    @property
    def _kinds(self) -> dict[str, tuple[type, qos.QoSProfile]]:
        """Return the message type and the quality of service of each topic."""
        return {'image': (self._image_type, qos.IMAGE),
                'camera_info': (CameraInfo, qos.CAMERA_INFO),
                'detections': (self._detections_type, qos.DETECTIONS_IN),
                'tags': (tags_type() if 'tags' in self.topics else type, qos.DETECTIONS_IN),
                'depth': (self._depth_type, qos.IMAGE),
                'depth_camera_info': (CameraInfo, qos.CAMERA_INFO)}

    def _unsubscribe(self) -> None:
        for subscription in self._subscriptions:
            subscription.destroy()
        self._subscriptions.clear()
        self._drop()

    def _drop(self) -> None:
        """Drop all received messages."""
        self._pairing.clear()
        self._depths.clear()
        self._unsure = self._static_info = None
        self._arrived_at = (-math.inf, -math.inf)

    def _receive(self, name: str, msg: Any) -> None:
        """Store a message, and call on_frame with the frame that it completes."""
        with self._changed:
            if not self._subscriptions:
                return
            if name == 'detections':
                msg = self._converted(msg)
            self._heard_at[name], frame = time.monotonic(), None
            if name == 'depth':  # kept as long as images wait; if memory is short, every n-th
                self._depths.append(msg)
                oldest = self._pairing.oldest('image')
                # if no image waits, the next image will have about the stamp of this depth image
                useful_ns = stamp_ns((msg if oldest is None else oldest[0]).header.stamp) \
                    - self._depth_tolerance_ns
                while len(self._depths) > 1 and sum(
                        len(depth.data) for depth in self._depths) > _MAX_DEPTH_BYTES:
                    stamps = [stamp_ns(depth.header.stamp) for depth in self._depths]
                    del self._depths[0 if stamps[0] < useful_ns or len(stamps) < 3 else 1 + min(
                        range(len(stamps) - 2), key=lambda row: stamps[row + 2] - stamps[row])]
            elif name == 'depth_camera_info':
                self._depth_camera = msg
            else:
                frame = self._completed(name, msg, self._heard_at[name])
        if frame is not None:
            self._on_frame(frame)

    def _completed(self, name: str, msg: Any, received_at: float) -> Frame | None:
        """Return the frame that a message completes, once its stamps are reliable; else None."""
        at_ns = stamp_ns(msg.header.stamp)
        size = len(msg.data) if name == 'image' else 1000 if name == 'camera_info' else (
            _DETECTION_BYTES * (1 + len(msg.detections)))
        if name == 'camera_info':
            # camera_info without a stamp is valid for all images
            self._static_info = msg if stamp_problem(msg.header.stamp) else None
            if self._static_info is not None:
                return None
        elif name != 'tags' and not self._is_named(name, msg, received_at):
            self._unsure = None
            return None
        if name == 'image' and self._static_info is not None:
            self._pairing.add('camera_info', at_ns, (self._static_info, received_at), 0)
        if name == 'image' and self._package == 'none':
            self._pairing.add('detections', at_ns, (
                Detection2DArray(header=msg.header), received_at), 0)
        complete = self._pairing.add(name, at_ns, (msg, received_at), size)
        if complete is not None:
            (image, image_at), (detections, detected_at) = (
                complete['image'], complete['detections'])
            self._unsure = Frame(
                image, complete['camera_info'][0], detections, image_at,
                max(image_at, detected_at), min(
                    (depth for depth in self._depths
                     if abs(stamp_ns(depth.header.stamp) - at_ns) <= self._depth_tolerance_ns),
                    key=lambda depth: abs(stamp_ns(depth.header.stamp) - at_ns), default=None),
                self._depth_camera, self._camera, image_topic=self._resolved('image'),
                tags=complete.get('tags', (None,))[0])
        frame = self._unsure
        # the next images may have the same stamp; wait until stamps are known to differ
        if frame is None or not (self._stamps['image'].are_own or all(
                stamp.is_repeated(frame.stamp_ns) for name, stamp in self._stamps.items()
                if name in self.topics)):
            return None
        self._unsure, self._arrived_at = None, (frame.received_at, frame.detected_at)
        return frame

    def _is_named(self, name: str, msg: Any, received_at: float) -> bool:
        """Return whether the stamp of an image, or of detections, is unique."""
        if name == 'image':
            self.lag_s = (self._node.get_clock().now().nanoseconds
                          - stamp_ns(msg.header.stamp)) / NS_PER_S
            self.nearest_lag_s = min(self.lag_s, self.nearest_lag_s, key=abs)
            return self._stamps[name].add(msg.header.stamp, (
                msg.header.frame_id, len(msg.data), bytes(
                    memoryview(msg.data)[::1 + len(msg.data) // _SAMPLE])), received_at)
        boxes = [detection.bbox for detection in msg.detections]
        return self._stamps[name].add(msg.header.stamp, np.array(
            [(box.center.position.x, box.center.position.y, box.size_x, box.size_y)
             for box in boxes]).tobytes(), received_at)

    def _stamp_problems(self) -> list[str]:
        """Return the faults of the stamps of images and detections, with remedies."""
        return [f'the stamp of the {"images" if name == "image" else name} on '
                f'{self._resolved(name)} {stamps.problem}: {_STAMPING[name]}'
                for name, stamps in self._stamps.items() if stamps.problem]

    def why_none(self, since: float) -> str:
        """Return why no frame was completed since a time (monotonic clock)."""
        if problems := [self._silence(name) for name in self.topics if name not in _OF_DEPTH
                        and self._heard_at.get(name, -math.inf) < since] or self._stamp_problems():
            return '; '.join(problems)
        if self._unsure is not None:
            return (f'too few images on {self._resolved("image")} to check that their stamps '
                    'differ: raise its rate, or timeout_s')
        if self._pairing.is_outrun:
            return (f'detections arrive later than {_MAX_IMAGE_BYTES // 2**20} MiB of images: use '
                    'smaller images, image_transport compressed, or a faster detector')
        received_at, detected_at = self._arrived_at
        if detected_at >= since:
            return (f'detections arrive {detected_at - received_at:.1f} s after their image: '
                    'choose a faster profile or a smaller detector, or raise timeout_s')
        stamps = ', '.join(f'{self._resolved(name)} {stamp / NS_PER_S:.6f}'
                           for name, stamp in self._pairing.last_stamp_ns.items())
        return (f'stamps never match (last: {stamps}): camera_info and detections must have '
                "their image's header, and arrive within timeout_s; or a replay is slow")

    def _silence(self, name: str) -> str:
        topic = self._resolved(name)
        publishers = self._node.count_publishers(topic)
        if publishers and name == 'detections':
            return (f'no detections on {topic} from its {publishers} publisher(s): give '
                    f'the detector the same image topic, {self._resolved("image")}; see its log, '
                    'choose a faster profile or a smaller detector, or raise timeout_s')
        return qos.why_silent(self._node, name, topic, self._kinds[name][0])

    def _resolved(self, name: str) -> str:
        return qos.resolved(self._node, self.topics[name])

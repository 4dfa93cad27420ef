# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demo's robot: play a recording, and request the pose at each wake-up."""

import heapq
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import PoseArray
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from vision_msgs.msg import Detection2DArray

from cliploc_ros.core.observation import Detections
from cliploc_ros.messages import detections_from_msg
from cliploc_ros.offline.datasets.bags import BagMessage, BagReader
from cliploc_ros.offline.replay import create_publisher
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import of_camera, pose_from_msg, stamp_ns
from cliploc_ros.units import NS_PER_S
from demo.processes import DemoError

_PATIENCE_S = 60.0
# Period at which the standing robot publishes the same frame again.
_FRAME_PERIOD_S = 0.2
# From the request to the first image.
_HEAD_START_S = 0.03
_SPIN_S = 0.02


@dataclass(frozen=True)
class WakeUp:
    """A request and its answer, as received over ROS."""

    stamp_ns: int  #: Stamp of the answer's image [ns]
    accepted: bool  #: Whether the relocalizer published a pose
    message: str  #: The answer in one line
    fields: Mapping[str, str]  #: Its figures, see doc/interface.md
    #: tuple of (4, 4): ``map_from_camera`` of the best distinct hypotheses, best first; an
    #: accepted pose is the first
    hypotheses: tuple[NDArray[np.float64], ...]
    detections: Mapping[str, Detections]  #: Output of the detector, by the name of the camera
    answer_s: float  #: Time from the request to the answer, including detection [s]

    @property
    def score(self) -> float:
        """Return the score of the pose."""
        return float(self.fields['score'])

    @property
    def landmarks(self) -> int:
        """Return the number of matched landmarks."""
        return int(self.fields['landmarks'])

    @property
    def stage_ms(self) -> dict[str, int]:
        """Return the time of each stage [ms]."""
        return {key.removesuffix(' [ms]'): round(float(value))
                for key, value in self.fields.items() if key.endswith(' [ms]')}

    @property
    def reason(self) -> str:
        """Return the reason of a refusal without its figures; empty if accepted."""
        return '' if self.accepted else self.message.removeprefix('refused: ').split('; kind ')[0]


class Robot(Node):
    """Publishes the recording of each camera and stops for each wake-up.

    ``check`` is called while waiting; it raises an error if a node has ended.
    """

    def __init__(self, readers: Mapping[str, BagReader], check: Callable[[], None]) -> None:
        super().__init__('robot')
        self._readers, self._check = readers, check
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)
        self._topics = {topic.name: create_publisher(self, topic, topic.name)
                        for reader in readers.values() for topic in reader.topics.values()}
        self._client = self.create_client(SelfTest, 'relocalizer/relocalize_fields')
        self._detections: dict[str, dict[int, Detections]] = {}
        self._hypotheses: dict[int, tuple[NDArray[np.float64], ...]] = {}
        for camera in readers:
            self._detections[camera] = {}
            self.create_subscription(Detection2DArray, of_camera(camera, 'detections'), partial(
                self._on_detections, camera), qos.DETECTIONS_OUT)
        self.create_subscription(PoseArray, 'relocalizer/hypotheses', self._on_hypotheses,
                                 qos.POSE)

    def connect(self) -> None:
        """Wait until detector and relocalizer are discovered."""
        self._wait(lambda: self._client.service_is_ready()
                   and all(self.count_publishers(of_camera(camera, 'detections'))
                           for camera in self._readers)
                   and self.count_publishers('relocalizer/hypotheses') > 0)

    def walk(self, wake_up_at: Collection[int], rate: float) -> Iterator[WakeUp]:
        """Play the recording; wake up at the images with the given stamps [ns].

        ``rate`` is the speed between wake-ups; 1 is as recorded.
        """
        last_ns = min(reader.start_ns for reader in self._readers.values())
        messages = heapq.merge(*(reader.messages() for reader in self._readers.values()),
                               key=lambda message: message.stamp_ns)
        for stamp, group in groupby(messages, key=lambda message: message.stamp_ns):
            seconds = (stamp - last_ns) / NS_PER_S / rate
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                self._check()
                self._executor.spin_once(timeout_sec=_SPIN_S)
            last_ns, frame = stamp, list(group)
            if stamp in wake_up_at:
                yield self._wake_up(stamp, frame)
            else:
                self._publish(frame)

    def _wake_up(self, stamp: int, frame: list[BagMessage]) -> WakeUp:
        """Request the pose of this frame, and publish it until the answer arrives."""
        start = time.monotonic()
        future = self._client.call_async(SelfTest.Request())
        # One in nine images was lost and resent after up to 3 s if it was published right after
        # the request and larger than Fast DDS's shared memory.
        shown_at = start + _HEAD_START_S - _FRAME_PERIOD_S

        def show(is_wanted: bool) -> None:
            nonlocal shown_at
            if is_wanted and time.monotonic() - shown_at >= _FRAME_PERIOD_S:
                self._publish(frame)
                shown_at = time.monotonic()

        def answered() -> bool:
            # Only the relocalizer subscribes to camera_info, and only until it has its frame.
            show(all(publisher.get_subscription_count() > 0 for name, publisher
                     in self._topics.items() if name.endswith('/camera_info')))
            return bool(future.done())

        def is_complete() -> bool:
            # A request may do without a camera whose image was lost; its detections are drawn.
            show(any(stamp not in heard for heard in self._detections.values()))
            return stamp in self._hypotheses and all(
                stamp in heard for heard in self._detections.values())

        self._wait(answered)
        answer_s, (answer,) = time.monotonic() - start, future.result().status
        fields = {field.key: field.value for field in answer.values}
        if fields['verdict'] not in ('accepted', 'refused'):
            raise DemoError(f'the relocalizer neither accepted nor refused: {answer.message}')
        self._wait(is_complete)
        return WakeUp(stamp, fields['verdict'] == 'accepted', answer.message, fields,
                      self._hypotheses[stamp],
                      {camera: heard[stamp] for camera, heard in self._detections.items()},
                      answer_s)

    def _publish(self, frame: list[BagMessage]) -> None:
        for message in frame:
            self._topics[message.topic].publish(message.data)

    def _wait(self, condition: Callable[[], bool]) -> None:
        """Process callbacks until a condition holds."""
        deadline = time.monotonic() + _PATIENCE_S
        while not condition():
            self._check()
            if time.monotonic() > deadline:
                raise DemoError(f'no ROS message arrived for {_PATIENCE_S:g} s: check whether a '
                                'firewall blocks UDP on this machine')
            self._executor.spin_once(timeout_sec=_SPIN_S)

    def _on_detections(self, camera: str, msg: Detection2DArray) -> None:
        self._detections[camera][stamp_ns(msg.header.stamp)] = detections_from_msg(msg)

    def _on_hypotheses(self, msg: PoseArray) -> None:
        poses = map(pose_from_msg, msg.poses)
        self._hypotheses[stamp_ns(msg.header.stamp)] = tuple(
            pose for pose in poses if pose is not None)

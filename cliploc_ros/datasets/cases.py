# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A request as a recording: what the relocalizer saw, what it knew, and what it answered."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.datasets.bag_messages import (
    CAMERA_INFO,
    DETECTIONS,
    IMAGE,
    POSE,
    deserialize,
    map_from_camera_of,
    pose_message,
    typestore,
)
from cliploc_ros.datasets.bag_reader import BagReader
from cliploc_ros.datasets.bag_writer import BagWriter
from cliploc_ros.errors import DatasetError

VERDICT = '/verdict'
_TEXT = 'std_msgs/msg/String'
_VECTOR = 'geometry_msgs/msg/Vector3Stamped'
_CAMERA_INFO, _DETECTIONS = '/camera_info', '/detections'
# What was known besides the messages, at the stamp of each image.
_CAMERA, _UP = '/camera_in_odom', '/up_in_camera'


@dataclass(frozen=True)
class CaseFrame:
    """One frame of a request, its messages as bytes."""

    stamp_ns: int  #: Of all three messages [ns]
    image_type: str  #: sensor_msgs/msg/Image or CompressedImage
    image: bytes
    camera_info: bytes
    detections: bytes
    up_in_camera: NDArray[np.float64] | None = None  #: (3,): the vertical, where it was known
    odom_from_camera: NDArray[np.float64] | None = None  #: (4, 4): where odometry placed the frame

    def message(self, name: str) -> Any:
        """Return one of the three messages.

        Raises
        ------
        DatasetError
            Its bytes are no such message.
        """
        msgtype = {'image': self.image_type, 'camera_info': CAMERA_INFO,
                   'detections': DETECTIONS}[name]
        return deserialize(getattr(self, name), msgtype, name)


@dataclass(frozen=True)
class Case:
    """A request: its frames, the oldest first, and the answer with the parameters behind it."""

    frames: tuple[CaseFrame, ...]
    report: Mapping[str, Any]


def write_case(path: Path, case: Case, storage: str = 'mcap') -> None:
    """Write a case as a rosbag2 folder, which must not exist.

    Raises
    ------
    DatasetError
        It cannot be written; nothing remains of it.
    """
    image_type = case.frames[-1].image_type
    image = '/image' if image_type == IMAGE else '/image/compressed'
    with BagWriter(path, storage) as writer:
        for topic, msgtype in ((image, image_type), (_CAMERA_INFO, CAMERA_INFO),
                               (_DETECTIONS, DETECTIONS), (_CAMERA, POSE), (_UP, _VECTOR),
                               (VERDICT, _TEXT)):
            writer.add_topic(topic, msgtype)
        for frame in case.frames:
            # the image last: it completes a frame for who replays the recording
            for topic, data in ((_CAMERA_INFO, frame.camera_info),
                                (_DETECTIONS, frame.detections), (image, frame.image),
                                *_state_messages(frame)):
                writer.write(topic, frame.stamp_ns, data)
        text = typestore().types[_TEXT](data=json.dumps(dict(case.report)))
        writer.write(VERDICT, case.frames[-1].stamp_ns, text)


def is_case(path: Path) -> bool:
    """Return whether a recording is of one request."""
    with BagReader(path) as reader:
        topic = reader.topics.get(VERDICT)
        return topic is not None and topic.msgtype == _TEXT


def read_case(path: Path) -> Case:
    """Read a case.

    Raises
    ------
    DatasetError
        Names what is missing or broken.
    """
    with BagReader(path) as reader:
        topics = [name for name in ('/image', '/image/compressed') if name in reader.topics]
        if not topics:
            raise DatasetError(f'{path}: has neither /image nor /image/compressed')
        image_type = reader.topic(topics[0]).msgtype
        images = _by_stamp(reader, topics[0])
        others = {name: _by_stamp(reader, name)
                  for name in (_CAMERA_INFO, _DETECTIONS, _CAMERA, _UP)}
        text = next(reader.messages([VERDICT]))
        report = _parsed(reader.deserialize(text).data, path)
    frames = []
    for stamp, image in sorted(images.items()):
        if not (stamp in others[_CAMERA_INFO] and stamp in others[_DETECTIONS]):
            raise DatasetError(f'{path}: the image of {stamp} ns has no camera_info or detections')
        data = others[_CAMERA].get(stamp)
        pose_of = None if data is None else map_from_camera_of(deserialize(data, POSE, _CAMERA))
        frames.append(CaseFrame(
            stamp, image_type, image, others[_CAMERA_INFO][stamp], others[_DETECTIONS][stamp],
            _up_of(others[_UP].get(stamp)), pose_of))
    if not frames:
        raise DatasetError(f'{path}: {topics[0]} has no messages')
    return Case(tuple(frames), report)


def _state_messages(frame: CaseFrame) -> Sequence[tuple[str, Any]]:
    messages: list[tuple[str, Any]] = []
    if frame.odom_from_camera is not None:
        messages.append((_CAMERA, pose_message(frame.stamp_ns, 'odom', frame.odom_from_camera)))
    if frame.up_in_camera is not None:
        info = frame.message('camera_info')
        x, y, z = map(float, frame.up_in_camera)
        vector = typestore().types['geometry_msgs/msg/Vector3'](x=x, y=y, z=z)
        messages.append((_UP, typestore().types[_VECTOR](header=info.header, vector=vector)))
    return messages


def _by_stamp(reader: BagReader, name: str) -> dict[int, bytes]:
    """Return the messages of a topic by the time of their image, which is their own [ns]."""
    if name not in reader.topics:
        return {}
    return {one.stamp_ns: one.data for one in reader.messages([name])}


def _parsed(text: str, path: Path) -> Mapping[str, Any]:
    try:
        report = json.loads(text)
    except ValueError as error:
        raise DatasetError(f'{path}: {VERDICT} is no JSON: {error}') from error
    if not isinstance(report, dict):
        raise DatasetError(f'{path}: {VERDICT} must be a mapping')
    return report


def _up_of(data: bytes | None) -> NDArray[np.float64] | None:
    if data is None:
        return None
    vector = deserialize(data, _VECTOR, _UP).vector
    return np.array([vector.x, vector.y, vector.z])

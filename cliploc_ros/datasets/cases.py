# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A request as a recording: what the relocalizer saw, what it knew, and what it answered."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.datasets.bag_messages import (
    CAMERA_INFO,
    DETECTIONS,
    IMAGE,
    POSE,
    map_from_camera_of,
    pose_message,
)
from cliploc_ros.datasets.bags import BagReader, BagWriter, deserialize, typestore
from cliploc_ros.errors import DatasetError

VERDICT = '/verdict'
_TEXT = 'std_msgs/msg/String'
_VECTOR = 'geometry_msgs/msg/Vector3Stamped'
_CAMERA_INFO, _DETECTIONS = '/camera_info', '/detections'
# What was known besides the messages, at the stamp of each image.
_CAMERA, _UP, _DEPTH = '/camera_in_odom', '/up_in_camera', '/depth'


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
    depth_type: str = ''  #: sensor_msgs/msg/Image or CompressedImage; empty without depth
    depth: bytes = b''

    def message(self, name: str) -> Any:
        """Return one of the messages; DatasetError: its bytes are no such message."""
        msgtype = {'image': self.image_type, 'camera_info': CAMERA_INFO,
                   'detections': DETECTIONS, 'depth': self.depth_type}[name]
        return deserialize(getattr(self, name), msgtype, name)


@dataclass(frozen=True)
class Case:
    """A request: its frames, the oldest first, and the answer with the parameters behind it."""

    frames: tuple[CaseFrame, ...]
    report: Mapping[str, Any]


def write_case(path: Path, case: Case, storage: str = 'mcap') -> None:
    """Write a case as a rosbag2 folder, which must not exist.

    DatasetError: it cannot be written; nothing remains of it.
    """
    image_type = case.frames[-1].image_type
    image = '/image' if image_type == IMAGE else '/image/compressed'
    types = typestore().types
    with BagWriter(path, storage) as writer:
        for topic, msgtype in ((image, image_type), (_CAMERA_INFO, CAMERA_INFO),
                               (_DETECTIONS, DETECTIONS), (_CAMERA, POSE), (_UP, _VECTOR),
                               (VERDICT, _TEXT)):
            writer.add_topic(topic, msgtype)
        if depth_type := next((one.depth_type for one in case.frames if one.depth), ''):
            writer.add_topic(_DEPTH, depth_type)
        for frame in case.frames:
            stamp = frame.stamp_ns
            # the image last: it completes a frame for a node that replays the recording
            writer.write(_CAMERA_INFO, stamp, frame.camera_info)
            writer.write(_DETECTIONS, stamp, frame.detections)
            writer.write(image, stamp, frame.image)
            if frame.odom_from_camera is not None:
                writer.write(_CAMERA, stamp, pose_message(stamp, 'odom', frame.odom_from_camera))
            if frame.up_in_camera is not None:
                x, y, z = map(float, frame.up_in_camera)
                writer.write(_UP, stamp, types[_VECTOR](
                    header=frame.message('camera_info').header,
                    vector=types['geometry_msgs/msg/Vector3'](x=x, y=y, z=z)))
            if frame.depth:
                writer.write(_DEPTH, stamp, frame.depth)
        writer.write(VERDICT, case.frames[-1].stamp_ns,
                     types[_TEXT](data=json.dumps(dict(case.report))))


def is_case(path: Path) -> bool:
    """Return whether a recording is of one request."""
    with BagReader(path) as reader:
        topic = reader.topics.get(VERDICT)
        return topic is not None and topic.msgtype == _TEXT


def read_case(path: Path) -> Case:
    """Read a case; DatasetError: the message names what is missing or broken."""
    with BagReader(path) as reader:
        topics = [name for name in ('/image', '/image/compressed') if name in reader.topics]
        if not topics:
            raise DatasetError(f'{path}: has neither /image nor /image/compressed')
        image_type = reader.topic(topics[0]).msgtype
        images = _by_stamp(reader, topics[0])
        others = {name: _by_stamp(reader, name)
                  for name in (_CAMERA_INFO, _DETECTIONS, _CAMERA, _UP, _DEPTH)}
        depth_type = reader.topics[_DEPTH].msgtype if _DEPTH in reader.topics else ''
        text = reader.deserialize(next(reader.messages([VERDICT]))).data
    try:
        report = json.loads(text)
    except ValueError as error:
        raise DatasetError(f'{path}: {VERDICT} is no JSON: {error}') from error
    if not isinstance(report, dict):
        raise DatasetError(f'{path}: {VERDICT} must be a mapping')
    frames = []
    for stamp, image in sorted(images.items()):
        if not (stamp in others[_CAMERA_INFO] and stamp in others[_DETECTIONS]):
            raise DatasetError(f'{path}: the image of {stamp} ns has no camera_info or detections')
        frame = CaseFrame(
            stamp, image_type, image, others[_CAMERA_INFO][stamp], others[_DETECTIONS][stamp])
        if (data := others[_UP].get(stamp)) is not None:
            vector = deserialize(data, _VECTOR, _UP).vector
            frame = replace(frame, up_in_camera=np.array([vector.x, vector.y, vector.z]))
        if (data := others[_DEPTH].get(stamp)) is not None:
            frame = replace(frame, depth_type=depth_type, depth=data)
        if (data := others[_CAMERA].get(stamp)) is not None:
            frame = replace(frame, odom_from_camera=map_from_camera_of(
                deserialize(data, POSE, _CAMERA)))
        frames.append(frame)
    if not frames:
        raise DatasetError(f'{path}: {topics[0]} has no messages')
    return Case(tuple(frames), report)


def _by_stamp(reader: BagReader, name: str) -> dict[int, bytes]:
    """Return the messages of a topic by the time of their image, which is their own [ns]."""
    if name not in reader.topics:
        return {}
    return {one.stamp_ns: one.data for one in reader.messages([name])}

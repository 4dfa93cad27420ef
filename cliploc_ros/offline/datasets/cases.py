# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A request as a recording: what the relocalizer saw, what it knew, and what it answered."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.bag_messages import (
    CAMERA_INFO,
    DETECTIONS,
    IMAGE,
    POSE,
    map_from_camera_of,
    pose_message,
)
from cliploc_ros.offline.datasets.bags import BagReader, BagWriter, deserialize, typestore

VERDICT = '/verdict'
_TEXT = 'std_msgs/msg/String'
_VECTOR = 'geometry_msgs/msg/Vector3Stamped'
_CAMERA_INFO, _DETECTIONS = '/camera_info', '/detections'
# What was known besides the messages, at the stamp of each image.
_CAMERA, _UP, _DEPTH = '/camera_in_odom', '/up_in_camera', '/depth'
_DEPTH_CAMERA_INFO, _DEPTH_CAMERA = '/depth_camera_info', '/depth_in_camera'


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
    depth_camera_info: bytes = b''  #: Where depth is not registered
    camera_from_depth: NDArray[np.float64] | None = None  #: (4, 4), where depth is not registered
    camera: str = ''  #: Name of one of several cameras
    is_beside: bool = False  #: Whether the pose is that of another camera of its instant

    def message(self, name: str) -> Any:
        """Return one of the messages; DatasetError: its bytes are no such message."""
        msgtype = {'image': self.image_type, 'camera_info': CAMERA_INFO,
                   'detections': DETECTIONS, 'depth': self.depth_type,
                   'depth_camera_info': CAMERA_INFO}[name]
        return deserialize(getattr(self, name), msgtype, name)


@dataclass(frozen=True)
class Case:
    """A request: its frames, the oldest first, and the answer with the parameters behind it.

    Of several cameras, the frames of an instant follow each other, that of the pose last.
    """

    frames: tuple[CaseFrame, ...]
    report: Mapping[str, Any]

    def instants(self) -> list[tuple[CaseFrame, ...]]:
        """Return the frames of each instant."""
        ends = [row for row, frame in enumerate(self.frames, start=1) if not frame.is_beside]
        return [self.frames[first:end] for first, end in pairwise([0, *ends])]


def write_case(path: Path, case: Case, storage: str = 'mcap') -> None:
    """Write a case as a rosbag2 folder, which must not exist.

    DatasetError: it cannot be written; nothing remains of it.
    """
    types = typestore().types
    with BagWriter(path, storage) as writer:
        for frame in {one.camera: one for one in case.frames}.values():
            prefix = _prefix(frame.camera)
            for topic, msgtype in ((_image_topic(frame.image_type), frame.image_type),
                                   (_CAMERA_INFO, CAMERA_INFO), (_DETECTIONS, DETECTIONS),
                                   (_CAMERA, POSE), (_UP, _VECTOR)):
                writer.add_topic(prefix + topic, msgtype)
            if depth_type := next((one.depth_type for one in case.frames
                                   if one.depth and one.camera == frame.camera), ''):
                writer.add_topic(prefix + _DEPTH, depth_type)
                writer.add_topic(prefix + _DEPTH_CAMERA_INFO, CAMERA_INFO)
                writer.add_topic(prefix + _DEPTH_CAMERA, POSE)
        writer.add_topic(VERDICT, _TEXT)
        for frame in case.frames:
            stamp, prefix = frame.stamp_ns, _prefix(frame.camera)
            # the image last: it completes a frame for a node that replays the recording
            writer.write(prefix + _CAMERA_INFO, stamp, frame.camera_info)
            writer.write(prefix + _DETECTIONS, stamp, frame.detections)
            writer.write(prefix + _image_topic(frame.image_type), stamp, frame.image)
            if frame.odom_from_camera is not None:
                writer.write(prefix + _CAMERA, stamp,
                             pose_message(stamp, 'odom', frame.odom_from_camera))
            if frame.up_in_camera is not None:
                x, y, z = map(float, frame.up_in_camera)
                writer.write(prefix + _UP, stamp, types[_VECTOR](
                    header=frame.message('camera_info').header,
                    vector=types['geometry_msgs/msg/Vector3'](x=x, y=y, z=z)))
            if frame.depth:
                writer.write(prefix + _DEPTH, stamp, frame.depth)
            if frame.camera_from_depth is not None:
                writer.write(prefix + _DEPTH_CAMERA_INFO, stamp, frame.depth_camera_info)
                writer.write(prefix + _DEPTH_CAMERA, stamp,
                             pose_message(stamp, 'camera', frame.camera_from_depth))
        order = [[one.camera, one.stamp_ns, one.is_beside] for one in case.frames]
        writer.write(VERDICT, case.frames[-1].stamp_ns,
                     types[_TEXT](data=json.dumps({'frames': order, **case.report})))


def _prefix(camera: str) -> str:
    return f'/{camera}' if camera else ''


def _image_topic(image_type: str) -> str:
    return '/image' if image_type == IMAGE else '/image/compressed'


def is_case(path: Path) -> bool:
    """Return whether a recording is of one request."""
    with BagReader(path) as reader:
        topic = reader.topics.get(VERDICT)
        return topic is not None and topic.msgtype == _TEXT


def read_case(path: Path) -> Case:
    """Read a case; DatasetError: the message names what is missing or broken."""
    with BagReader(path) as reader:
        try:
            verdict = next(reader.messages([VERDICT]), None)
            report = {} if verdict is None else json.loads(reader.deserialize(verdict).data)
        except ValueError as error:
            raise DatasetError(f'{path}: {VERDICT} is no JSON: {error}') from error
        if not isinstance(report, dict):
            raise DatasetError(f'{path}: {VERDICT} must be a mapping')
        order = report.get('frames')
        cameras = [''] if order is None else list(dict.fromkeys(name for name, _, _ in order))
        found = {(name, frame.stamp_ns): frame for name in cameras
                 for frame in _frames_of(reader, path, name)}
    if order is None:  # recorded by a release without several cameras
        return Case(tuple(found[key] for key in sorted(found)), report)
    return Case(tuple(replace(found[name, stamp], is_beside=is_beside)
                      for name, stamp, is_beside in order), report)


def _frames_of(reader: BagReader, path: Path, camera: str) -> Iterator[CaseFrame]:
    """Yield the frames of a camera."""
    prefix = _prefix(camera)
    topics = [topic for name in ('/image', '/image/compressed')
              if (topic := prefix + name) in reader.topics]
    if not topics:
        raise DatasetError(f'{path}: has neither {prefix}/image nor {prefix}/image/compressed')
    image_type = reader.topic(topics[0]).msgtype
    depth_type = reader.topics[prefix + _DEPTH].msgtype if prefix + _DEPTH in reader.topics else ''
    images = _by_stamp(reader, topics[0])
    if not images:
        raise DatasetError(f'{path}: {topics[0]} has no messages')
    infos, detections, poses, verticals, depths, depth_infos, depth_poses = (
        _by_stamp(reader, prefix + name) for name in (
            _CAMERA_INFO, _DETECTIONS, _CAMERA, _UP, _DEPTH, _DEPTH_CAMERA_INFO, _DEPTH_CAMERA))
    for stamp, image in images.items():
        if not (stamp in infos and stamp in detections):
            raise DatasetError(f'{path}: the image of {stamp} ns has no camera_info or detections')
        frame = CaseFrame(stamp, image_type, image, infos[stamp], detections[stamp],
                          depth_type=depth_type, depth=depths.get(stamp, b''), camera=camera)
        if (data := verticals.get(stamp)) is not None:
            vector = deserialize(data, _VECTOR, _UP).vector
            frame = replace(frame, up_in_camera=np.array([vector.x, vector.y, vector.z]))
        if (data := poses.get(stamp)) is not None:
            frame = replace(frame, odom_from_camera=map_from_camera_of(
                deserialize(data, POSE, _CAMERA)))
        if (data := depth_poses.get(stamp)) is not None:
            frame = replace(frame, depth_camera_info=depth_infos.get(stamp, b''),
                            camera_from_depth=map_from_camera_of(
                                deserialize(data, POSE, _DEPTH_CAMERA)))
        yield frame


def _by_stamp(reader: BagReader, name: str) -> dict[int, bytes]:
    """Return the messages of a topic by the time of their image, which is their own [ns]."""
    if name not in reader.topics:
        return {}
    return {one.stamp_ns: one.data for one in reader.messages([name])}

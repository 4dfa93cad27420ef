# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of a rosbag2 recording: image, camera_info, pose, and registered depth."""

import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.depth_image import DepthImage, depth_from_counts
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import check_faults
from cliploc_ros.errors import CliplocError, DatasetError
from cliploc_ros.messages import (
    camera_from_msg,
    depth_counts_from_msg,
    faults_of_camera_info,
    faults_of_headers,
    faults_of_rectified,
    image_from_msg,
)
from cliploc_ros.offline.datasets.bag_messages import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    stamp_ns,
)
from cliploc_ros.offline.datasets.bag_poses import ReadPoses
from cliploc_ros.offline.datasets.bags import BagMessage, BagReader, deserialize
from cliploc_ros.offline.datasets.frames import DepthFormat, Frames, RawFrame, Wanted
from cliploc_ros.offline.datasets.poses import Poses, check_clock
from cliploc_ros.units import NS_PER_S

_IMAGES = (IMAGE, COMPRESSED_IMAGE)
_COMPRESSED = '/compressed'
# A depth image belongs to a colour image at most this far away in time.
_MAX_DEPTH_DELAY_NS = 20_000_000
# Images that wait for their depth. A depth image is recorded at most this many images later.
_MAX_WAITING = 15
_Selected = tuple[int, int, 'NDArray[np.float64] | None', bytes, 'bytes | None']


@dataclass(frozen=True)
class BagTopics:
    """Which topics of a recording hold what."""

    #: sensor_msgs/Image or CompressedImage, and CameraInfo
    image: str = '/image'
    camera_info: str = '/camera_info'
    rectified: bool = False  #: Whether images are rectified, so that P holds, without distortion
    #: sensor_msgs/Image of depth, 16UC1 or 32FC1, or CompressedImage of compressedDepth; '' for
    #: none
    depth: str = ''

    def of_camera(self, name: str) -> 'BagTopics':
        """Return the topics of one of several cameras; '' changes nothing."""
        return replace(self, image=topic_of(name, self.image),
                       camera_info=topic_of(name, self.camera_info),
                       depth=topic_of(name, self.depth))


def topic_of(camera: str, topic: str) -> str:
    """Return the topic of one of several cameras: NAME/topic; '' changes nothing."""
    return f'/{camera.strip("/")}/{topic.lstrip("/")}' if camera and topic else topic


def find_topics(bag: Path, image: str | None, camera_info: str | None) -> tuple[str, str]:
    """Return the topics of image and camera_info; None is found where there is one candidate.

    Depth and debug images are no candidates; raw images go before compressed ones of the same
    camera. DatasetError: there is none, or there are several; names them and the parameter.
    """
    with BagReader(bag) as reader:
        def named(types: Sequence[str]) -> list[str]:
            return [one.name for one in reader.topics.values()
                    if one.msgtype in types and one.message_count]

        def only(candidates: Sequence[str], what: str, parameter: str) -> str:
            if len(candidates) == 1:
                return candidates[0]
            raise DatasetError(f'{bag}: {len(candidates)} topics of {what}'
                               f'{": " if candidates else ""}{", ".join(candidates)}; '
                               f'{f"give `{parameter}`" if candidates else "record one"}')
        images = [name for name in named(_IMAGES) if 'depth' not in name.lower()
                  and 'debug_image' not in name]
        raw = [name for name in images if name.removesuffix(_COMPRESSED) == name
               or name.removesuffix(_COMPRESSED) not in images]
        image = image or only(raw, 'colour images', 'image')
        beside = image.removesuffix(_COMPRESSED).rpartition('/')[0] + '/camera_info'
        infos = named((CAMERA_INFO,))
        return image, camera_info or (
            beside if beside in infos else only(infos, 'camera_info', 'camera_info'))


def bag_frames(bag: Path, topics: BagTopics, read_poses: ReadPoses,
               depth: DepthFormat | None = None) -> Frames:
    """Return the frames of a recording, a rosbag2 folder or file.

    DatasetError: a topic is missing, of another type, or empty, or the poses are of another time.
    """
    if topics.depth == topics.image:
        raise DatasetError(f'{bag}: {topics.image} cannot be both the image and its depth')
    with BagReader(bag) as reader:
        _check_topics(reader, topics)
        depth_type = reader.topic(topics.depth).msgtype if topics.depth else ''
        poses = _poses_of_images(reader, topics.image, read_poses, str(bag))
        info = next(reader.messages([topics.camera_info])).data
        count = reader.topic(topics.image).message_count
        notes = _notes(reader, topics)
    decode = partial(_decode_color, f'{bag}: {topics.image}', info, topics.rectified)
    decode_depth = partial(_decode_depth, f'{bag}: {topics.depth}', depth_type,
                           depth or DepthFormat())

    def read_raw(is_wanted: Wanted) -> Iterator[RawFrame]:
        with BagReader(bag) as reader:
            msgtype = reader.topic(topics.image).msgtype
            for place, stamp_ns, pose, data, depth_data in _paired(reader, topics, poses,
                                                                   is_wanted):
                yield RawFrame(place, stamp_ns, pose, partial(decode, msgtype, data),
                               None if depth_data is None else partial(decode_depth, depth_data))
    return Frames(bag, count, read_raw, notes=notes)


def _notes(reader: BagReader, topics: BagTopics) -> tuple[str, ...]:
    """Return what is unusual about the camera of a recording, by its first messages.

    DatasetError: its images are certainly rectified, and read as raw.
    """
    image, info = (reader.deserialize(next(reader.messages([topic])))
                   for topic in (topics.image, topics.camera_info))
    faults = [*faults_of_headers(image.header.frame_id, info.header.frame_id),
              *faults_of_rectified(topics.image, topics.rectified, info)]
    try:
        check_faults(faults)
    except CliplocError as error:
        raise DatasetError(f'{reader.path}: {error}') from error
    with suppress(CliplocError):  # who decodes the image says so
        size = image_from_msg(image).shape[1::-1]
        faults += faults_of_camera_info(info, camera_from_msg(info, size, topics.rectified),
                                        topics.rectified)
    return tuple(f'note: {fault.text}' for fault in faults)


def bag_odometry(bag: Path, image_topic: str, read_odometry: ReadPoses) -> Poses:
    """Return the poses of a recording's camera by odometry.

    DatasetError: the topic or tf is missing or broken, or of another time than the images.
    """
    with BagReader(bag) as reader:
        return _poses_of_images(reader, image_topic, read_odometry, f'{bag}: odometry')


def _poses_of_images(reader: BagReader, image_topic: str, read_poses: ReadPoses, where: str
                     ) -> Poses:
    image = reader.deserialize(next(reader.messages([image_topic])))
    poses = read_poses(reader, str(image.header.frame_id))
    first_ns = stamp_ns(image)
    check_clock(poses, first_ns, first_ns + reader.end_ns - reader.start_ns, where)
    return poses


def bag_images(bag: Path, topics: BagTopics) -> 'BagImages':
    """Return the images of a recording, to be read in any order.

    The recording is read once, for the stamps. DatasetError: a topic is missing, of another type,
    or empty.
    """
    with BagReader(bag) as reader:
        _check_topics(reader, topics)
        info = next(reader.messages([topics.camera_info])).data
        times_ns = [(_peek_stamp_ns(one), one.stamp_ns) for one in reader.messages([topics.image])]
        msgtype = reader.topic(topics.image).msgtype
    return BagImages(bag, topics.image, np.array(times_ns, dtype=np.int64).reshape(-1, 2),
                     partial(_decode_color, f'{bag}: {topics.image}', info, topics.rectified,
                             msgtype))


@dataclass(frozen=True)
class BagImages:
    """The images of a recording, read one at a time through its index of time."""

    bag: Path
    topic: str
    #: (F, 2): when each image was taken, and when it was recorded [ns]
    times_ns: NDArray[np.int64]
    #: Makes an image and its camera of a message
    decode: Callable[[bytes], tuple[NDArray[np.uint8], Camera]]

    def read(self, place: int) -> tuple[NDArray[np.uint8], Camera]:
        """Return an image (h, w, 3), red first, and its camera.

        DatasetError: it cannot be decoded, or the recording changed.
        """
        taken_ns, recorded_ns = self.times_ns[place].tolist()
        with BagReader(self.bag) as reader:
            for one in reader.messages([self.topic], recorded_ns, recorded_ns + 1):
                if _peek_stamp_ns(one) == taken_ns:
                    return self.decode(one.data)
        raise DatasetError(f'{self.bag}: image {place} of {self.topic} is gone; start again')


def _check_topics(reader: BagReader, topics: BagTopics) -> None:
    for name, types in ((topics.image, _IMAGES), (topics.camera_info, (CAMERA_INFO,)),
                        *([(topics.depth, _IMAGES)] if topics.depth else [])):
        topic = reader.topic(name)
        if topic.msgtype not in types:
            raise DatasetError(f'{reader.path}: {name} is of type {topic.msgtype}, not '
                               f'{" or ".join(types)}')
        if topic.message_count == 0:
            raise DatasetError(f'{reader.path}: {name} has no messages')


def _paired(reader: BagReader, topics: BagTopics, poses: Poses, is_wanted: Wanted
            ) -> Iterator[_Selected]:
    """Yield the wanted images, each with the depth image nearest in time, or None."""
    waiting: deque[_Selected] = deque()
    depths: deque[tuple[int, bytes]] = deque(maxlen=2 * _MAX_WAITING)

    def with_depth(selected: _Selected) -> _Selected:
        at_ns = selected[1]
        nearest = min(depths, key=lambda depth: abs(depth[0] - at_ns), default=None)
        if nearest is None or abs(nearest[0] - at_ns) > _MAX_DEPTH_DELAY_NS:
            return selected
        return (*selected[:4], nearest[1])
    place = 0
    for recorded in reader.messages([topics.image, *([topics.depth] if topics.depth else [])]):
        stamp_ns = _peek_stamp_ns(recorded)
        if topics.depth and recorded.topic == topics.depth:
            depths.append((stamp_ns, recorded.data))
        else:
            pose = poses.pose_at(stamp_ns)
            if is_wanted(place, stamp_ns, pose):
                waiting.append((place, stamp_ns, pose, recorded.data, None))
            place += 1
        while waiting and (not topics.depth or len(waiting) > _MAX_WAITING
                           or (depths and depths[-1][0] >= waiting[0][1] + _MAX_DEPTH_DELAY_NS)):
            yield with_depth(waiting.popleft())
    yield from map(with_depth, waiting)


def _peek_stamp_ns(recorded: BagMessage) -> int:
    """Return the header stamp of a serialized message [ns], without reading the rest of it."""
    order = '<' if recorded.data[1] & 1 else '>'
    try:
        seconds, nanoseconds = struct.unpack_from(f'{order}iI', recorded.data, 4)
    except struct.error as error:
        raise DatasetError(f'{recorded.topic}: a message of {len(recorded.data)} bytes has no '
                           'header') from error
    return int(seconds) * NS_PER_S + int(nanoseconds)


def _decode_color(where: str, info: bytes, rectified: bool, msgtype: str, data: bytes
                  ) -> tuple[NDArray[np.uint8], Camera]:
    message = deserialize(data, msgtype, where)
    try:
        image = image_from_msg(message)
        size = (image.shape[1], image.shape[0])
        calibration = deserialize(info, CAMERA_INFO, where)
        camera = camera_from_msg(calibration, size, rectified)
        check_faults(faults_of_camera_info(calibration, camera, rectified))
        return image, camera
    except CliplocError as error:
        raise DatasetError(f'{where} at {stamp_ns(message) / NS_PER_S:.6f}: {error}') from error


def _decode_depth(where: str, msgtype: str, form: DepthFormat, data: bytes) -> DepthImage:
    message = deserialize(data, msgtype, where)
    where = f'{where} at {stamp_ns(message) / NS_PER_S:.6f}'
    try:
        counts = depth_counts_from_msg(message)
    except CliplocError as error:
        raise DatasetError(f'{where}: {error}') from error
    return DepthImage(depth_from_counts(counts, form.unit_m, where), form.camera)

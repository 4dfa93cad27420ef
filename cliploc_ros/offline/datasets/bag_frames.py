# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of a rosbag2 recording: image, camera_info and depth, with poses (see bag_poses)."""

import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros import messages
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import check_faults
from cliploc_ros.core.geometry.depth import DepthCamera, DepthImage, depth_from_counts
from cliploc_ros.errors import CameraError, CliplocError, DatasetError
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.agreement import AXES, Reading, View, check_agreement
from cliploc_ros.offline.datasets.bag_poses import PoseSource, plain_name, poses_of_images
from cliploc_ros.offline.datasets.bags import BagMessage, BagReader, deserialize
from cliploc_ros.offline.datasets.frames import DepthFormat, Frames, RawFrame, Wanted
from cliploc_ros.offline.datasets.parsing import find_camera
from cliploc_ros.offline.datasets.poses import STAMP_TOLERANCE_NS, Poses, TimedPoses, check_forward
from cliploc_ros.units import NS_PER_S

_IMAGES = (bag_messages.IMAGE, bag_messages.COMPRESSED_IMAGE)
_COMPRESSED = '/compressed'
# Images that wait for their depth image, which is recorded at most this many images later.
_MAX_WAITING = 15
# Offsets of the stamps that are tried when images and poses are compared [s].
_SHIFTS_S = (-0.5, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.5)
# Reading.least_px and Reading.better where rectified images are read as raw, or the reverse.
_RECTIFIED_PX, _RECTIFIED_BETTER = 0.6, 0.6
# The sample of images compared with poses: parts of a recording, images of a part, its length [s].
_COMPARED_PARTS, _COMPARED_OF_PART, _PART_S = 12, 8, 4.0


@dataclass(frozen=True)
class BagTopics:
    """The topics of a recording, and how to read them."""

    #: sensor_msgs/Image or CompressedImage, and CameraInfo
    image: str = '/image'
    camera_info: str = '/camera_info'
    rectified: bool = False  #: Whether images are rectified; then P is used, without distortion
    #: sensor_msgs/Image of depth, 16UC1 or 32FC1, or CompressedImage of compressedDepth; '' for
    #: none
    depth: str = ''
    intrinsics: str | None = None  #: The camera to use instead of camera_info, see find_camera
    #: Greatest difference between the stamps of a colour image and its depth image [ns]
    tolerance_ns: int = STAMP_TOLERANCE_NS
    tf: str | None = None  #: Topic of the tf from depth to image, see PoseSource

    def of_camera(self, name: str) -> 'BagTopics':
        """Return the topics of a camera of a rig; an empty name changes nothing."""
        return replace(self, image=topic_of(name, self.image),
                       camera_info=topic_of(name, self.camera_info),
                       depth=topic_of(name, self.depth))


def topic_of(camera: str, topic: str) -> str:
    """Return the topic /NAME/topic of a camera of a rig; an empty name changes nothing."""
    return f'/{camera.strip("/")}/{topic.lstrip("/")}' if camera and topic else topic


def find_topics(bag: Path, image: str | None, camera_info: str | None) -> tuple[str, str]:
    """Return the topics of image and camera_info; where one is None, find the only candidate.

    Depth and debug images are not candidates. Raw images are preferred to compressed images of the
    same camera. DatasetError: there are no candidates, or several; the message lists them and
    names the parameter.
    """
    with BagReader(bag) as reader:
        def named(types: Sequence[str]) -> list[str]:
            return [topic.name for topic in reader.topics.values()
                    if topic.msgtype in types and topic.message_count]

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
        infos = named((bag_messages.CAMERA_INFO,))
        return image, camera_info or (
            beside if beside in infos else only(infos, 'camera_info', 'camera_info'))


def bag_frames(bag: Path, topics: BagTopics, source: PoseSource,
               depth: DepthFormat | None = None) -> Frames:
    """Return the frames of a recording, a rosbag2 folder or file.

    DatasetError: a topic is missing, empty or of another type, or no pose is near the images.
    """
    if topics.depth == topics.image:
        raise DatasetError(f'{bag}: {topics.image} cannot be both the image and its depth')
    form = depth or DepthFormat()
    with BagReader(bag) as reader:
        _check_topics(reader, topics)
        poses = poses_of_images(reader, topics.image, source, str(bag),
                                topics.camera_info if topics.intrinsics is None else '')
        cameras = _Cameras.read(reader, topics)
        count, notes = reader.topic(topics.image).message_count, _notes(reader, topics)
        if topics.depth:
            form = _depth_of_its_camera(reader, topics, form)
        notes.append(check_agreement(_sampled(reader, topics, poses, cameras),
                                     _readings(cameras, topics.rectified), bag))
        notes += [*reader.notes, *reader.left_out_notes()]
    depth_type = reader.topic(topics.depth).msgtype if topics.depth else ''
    decode_depth = partial(_decode_depth, f'{bag}: {topics.depth}', depth_type, form)

    def read_raw(is_wanted: Wanted) -> Iterator[RawFrame]:
        with BagReader(bag) as reader:
            yield from _paired(reader, topics, poses, cameras, decode_depth, is_wanted)
    return Frames(bag, count, read_raw, of_tf=not isinstance(poses, TimedPoses),
                  varies=len(cameras.infos) > 1, notes=tuple(
                      f'note: {note}' for note in notes if note))


class _Cameras(NamedTuple):
    """The messages of camera_info in a recording, with their stamps."""

    where: str
    msgtype: str  #: Message type of the images
    rectified: bool
    infos: tuple[bytes, ...]  #: The distinct messages; empty if a file gives the camera
    #: (c,): time of each message [ns]: its stamp or, without stamps, its time of recording
    times_ns: NDArray[np.int64]
    rows: NDArray[np.int64]  #: (c,): index of each message's content in infos
    by_stamp: bool  #: Whether times_ns are stamps
    given: Camera | None = None  #: The camera from a file

    @classmethod
    def read(cls, reader: BagReader, topics: BagTopics) -> '_Cameras':
        """Read the cameras of a recording; messages without a calibration are left out."""
        where, msgtype = f'{reader.path}: {topics.image}', reader.topic(topics.image).msgtype
        none = np.empty(0, dtype=np.int64)
        if topics.intrinsics is not None:
            return cls(where, msgtype, topics.rectified, (), none, none, True,
                       find_camera(topics.intrinsics, reader.path)[0])
        infos: dict[bytes, bytes] = {}
        found = []
        for message in reader.messages([topics.camera_info]):
            stamp_ns = _peek_stamp_ns(message)
            content = message.data[:4] + message.data[12:]  # all but the stamp
            infos.setdefault(content, message.data)
            found.append((stamp_ns, message.stamp_ns, content))
        sound = {}
        for content, data in infos.items():
            with suppress(DatasetError):
                if _is_calibrated(deserialize(data, bag_messages.CAMERA_INFO, where),
                                  topics.rectified):
                    sound[content] = data
        sound = sound or dict([*infos.items()][:1])
        _check_one_camera(map(_frame_of, sound.values()), f'{reader.path}: {topics.camera_info}')
        for stamp_ns, _, content in found:
            if content not in sound and len(sound) < len(infos):
                reader.leave_out(topics.camera_info, f'the message at {stamp_ns / NS_PER_S:.6f} s '
                                 'has no calibration')
        kept = [times for times in found if times[2] in sound]
        rows = {content: row for row, content in enumerate(sound)}
        stamps_ns = [stamp_ns for stamp_ns, _, _ in kept]
        by_stamp = all(stamps_ns)
        if by_stamp:
            check_forward(stamps_ns, f'{reader.path}: {topics.camera_info}')
        times_ns = stamps_ns if by_stamp else [recorded_ns for _, recorded_ns, _ in kept]
        return cls(where, msgtype, topics.rectified, tuple(sound.values()),
                   np.array(times_ns, dtype=np.int64),
                   np.array([rows[content] for _, _, content in kept], dtype=np.int64), by_stamp)

    def decoder(self, stamp_ns: int, recorded_ns: int, data: bytes
                ) -> Callable[[], tuple[NDArray[np.uint8], Camera]]:
        """Return a function that decodes an image, and its camera_info nearest in time."""
        info: bytes | Camera
        if self.given is not None:
            info = self.given
        else:
            offsets = np.abs(self.times_ns - (stamp_ns if self.by_stamp else recorded_ns))
            info = self.infos[self.rows[int(np.argmin(offsets))] if len(self.infos) > 1 else 0]
        return partial(_decode_color, self.where, info, self.rectified, self.msgtype, data)


def _is_calibrated(info: Any, rectified: bool) -> bool:
    focal_px = np.diag(np.reshape(info.p, (3, 4)) if rectified else np.reshape(info.k, (3, 3)))[:2]
    return bool(np.isfinite(focal_px).all() and (focal_px > 0.0).all())


def _check_one_camera(frame_ids: Iterable[str], where: str) -> None:
    """Refuse a topic with messages of several cameras; DatasetError: names their frames."""
    names = sorted({*frame_ids} - {''})
    if len(names) > 1:
        raise DatasetError(f'{where} has messages of several coordinate frames, '
                           f'{", ".join(names)}: record each camera on its own topics')


def _depth_of_its_camera(reader: BagReader, topics: BagTopics, form: DepthFormat) -> DepthFormat:
    """Return the format of depth, with its camera if it is not in the image's coordinate frame.

    DatasetError: the camera_info of depth, or the tf between the two frames, is missing.
    """
    image, depth = (plain_name(str(reader.first(topic).header.frame_id))
                    for topic in (topics.image, topics.depth))
    if form.camera is not None or not image or not depth or image == depth:
        return form
    beside = topics.depth.removesuffix('/compressedDepth').rpartition('/')[0] + '/camera_info'
    problem = f'{beside} is missing'
    if beside in reader.topics and beside != topics.camera_info:
        info = reader.first(beside)
        (fx, _, cx), (_, fy, cy), _ = np.reshape(info.k, (3, 3)).tolist()
        try:
            if not _is_calibrated(info, rectified=False):
                raise DatasetError(f'{beside} has no calibration')
            poses = PoseSource(map_frame=image, tf=topics.tf, max_gap_ns=10 * NS_PER_S).read(
                reader, depth)
            pose = poses.pose_at(bag_messages.stamp_ns(reader.first(topics.depth)))
            if pose is not None:
                if topics.intrinsics is None:
                    pose = messages.camera_from_frame(reader.first(topics.camera_info)) @ pose
                return replace(form, camera=DepthCamera(fx, fy, cx, cy, pose))
            problem = 'tf between them does not cover the first depth image'
        except DatasetError as error:
            problem = str(error).removeprefix(f'{reader.path}: ')
    raise DatasetError(f"{reader.path}: depth is in frame '{depth}', the image in '{image}', and "
                       f'{problem}: register depth, or give `depth_intrinsics` and '
                       '`depth_baseline`')


def _sampled(reader: BagReader, topics: BagTopics, poses: Poses, cameras: _Cameras) -> list[View]:
    """Return a sample of the images of a recording; each image is read on demand."""
    views, last = [], np.iinfo(np.int64).min
    for begin in np.linspace(reader.start_ns, reader.end_ns, _COMPARED_PARTS, endpoint=False):
        begin_ns = max(int(begin), last)
        found = [(_peek_stamp_ns(message), message.stamp_ns) for message in reader.messages(
            [topics.image], begin_ns, int(begin) + round(_PART_S * NS_PER_S))]
        last = max([last, *(recorded_ns + 1 for _, recorded_ns in found)])
        views += [View(poses.pose_at(stamp_ns), partial(
            _read_image, reader.path, topics.image, cameras, stamp_ns, recorded_ns), None,
            poses.pose_at, stamp_ns)
            for stamp_ns, recorded_ns in found[::max(1, len(found) // _COMPARED_OF_PART)]]
    return views


def _readings(cameras: _Cameras, rectified: bool) -> dict[str, Reading]:
    """Return the possible readings of a recording's images and poses, the given one first."""
    given = 'rectified' if rectified else 'given'
    mount = 'give the `mount` {} of the camera on the body of the poses, or the `camera_frame`'
    readings = {given: Reading('')}
    infos = [deserialize(data, bag_messages.CAMERA_INFO, cameras.where) for data in cameras.infos]
    if len(infos) == 1:
        with suppress(CliplocError, ValueError):
            info = infos[0]
            size = (int(info.width), int(info.height))
            other = messages.camera_from_msg(info, size, not rectified)
            readings['raw' if rectified else 'rectified'] = Reading(
                'the images are not rectified: leave `rectified` out' if rectified else
                'the images are rectified: give `rectified`',
                camera=lambda camera: other, least_px=_RECTIFIED_PX,
                better=_RECTIFIED_BETTER)
    numbers = {'opengl': '0 0 0 1 0 0 0', 'ros': '0 0 0 -0.5 0.5 -0.5 0.5'}
    return readings | {name: Reading(mount.format(numbers.get(name, '')) if name in numbers else
                                     'the poses are inverse: record the camera in the map',
                                     AXES[name]) for name in AXES if name != 'opencv'} | {
        f'poses {shift:+.1f} s': Reading(
            'check the clocks of images and poses, and the delay of the images',
            shift_ns=round(shift * NS_PER_S)) for shift in _SHIFTS_S}


def _notes(reader: BagReader, topics: BagTopics) -> list[str]:
    """Return notes on unusual properties of a recording's camera, from its first messages.

    DatasetError: the images are certainly rectified, but are read as raw.
    """
    if topics.intrinsics is not None:
        return []
    image, info = (reader.first(topic) for topic in (topics.image, topics.camera_info))
    faults = [*messages.faults_of_headers(image.header.frame_id, info.header.frame_id),
              *messages.faults_of_rectified(topics.image, topics.rectified, info)]
    try:
        check_faults(faults)
    except CliplocError as error:
        raise DatasetError(f'{reader.path}: {error}') from error
    with suppress(CliplocError):  # the error is reported when the image is decoded
        size = messages.image_from_msg(image).shape[1::-1]
        camera = messages.camera_from_msg(info, size, topics.rectified)
        faults += messages.faults_of_camera_info(info, camera, topics.rectified)
    return [fault.text for fault in faults]


def bag_images(bag: Path, topics: BagTopics, camera: str = '') -> list[RawFrame]:
    """Return the images of a recording without poses, each read on demand; camera is their name.

    The recording is read once, for the stamps. DatasetError: a topic is missing, of another type,
    or empty.
    """
    with BagReader(bag) as reader:
        _check_topics(reader, topics)
        cameras = _Cameras.read(reader, topics)
        times_ns = [(_peek_stamp_ns(message), message.stamp_ns)
                    for message in reader.messages([topics.image])]
    return [RawFrame(place, stamp_ns, None, partial(
        _read_image, bag, topics.image, cameras, stamp_ns, recorded_ns), camera=camera)
        for place, (stamp_ns, recorded_ns) in enumerate(times_ns)]


def _read_image(bag: Path, topic: str, cameras: _Cameras, stamp_ns: int, recorded_ns: int
                ) -> tuple[NDArray[np.uint8], Camera]:
    """Read an image (h, w, 3), RGB, and its camera, by its stamp and time of recording.

    DatasetError: the image cannot be decoded, or the recording has changed.
    """
    with BagReader(bag) as reader:
        for message in reader.messages([topic], recorded_ns, recorded_ns + 1):
            if _peek_stamp_ns(message) == stamp_ns:
                return cameras.decoder(stamp_ns, recorded_ns, message.data)()
    raise DatasetError(f'{bag}: the image of {topic} at {stamp_ns / NS_PER_S:.6f} s is missing: '
                       'the recording has changed; start again')


def _check_topics(reader: BagReader, topics: BagTopics) -> None:
    for name, types in ((topics.image, _IMAGES), *(
            [(topics.camera_info, (bag_messages.CAMERA_INFO,))] if topics.intrinsics is None
            else []), *([(topics.depth, _IMAGES)] if topics.depth else [])):
        topic = reader.topic(name)
        if topic.msgtype not in types:
            raise DatasetError(f'{reader.path}: {name} is of type {topic.msgtype}, not '
                               f'{" or ".join(types)}')
        if topic.message_count == 0:
            raise DatasetError(f'{reader.path}: {name} has no messages')


def _paired(reader: BagReader, topics: BagTopics, poses: Poses, cameras: _Cameras,
            decode_depth: Callable[[bytes], DepthImage], is_wanted: Wanted) -> Iterator[RawFrame]:
    """Yield the wanted images, each with the depth image nearest in time, or None."""
    waiting: deque[RawFrame] = deque()
    depths: deque[tuple[int, bytes]] = deque(maxlen=2 * _MAX_WAITING)

    def with_depth(raw: RawFrame) -> RawFrame:
        nearest = min(depths, key=lambda depth: abs(depth[0] - raw.stamp_ns), default=None)
        if nearest is None or abs(nearest[0] - raw.stamp_ns) > topics.tolerance_ns:
            return raw
        return replace(raw, depth=partial(decode_depth, nearest[1]))
    place, before, frame = 0, 0, ''
    for recorded in reader.messages([topics.image, *([topics.depth] if topics.depth else [])]):
        stamp_ns = _peek_stamp_ns(recorded)
        if topics.depth and recorded.topic == topics.depth:
            depths.append((stamp_ns, recorded.data))
        else:
            check_forward([before, stamp_ns], f'{reader.path}: {topics.image}')
            frame, earlier = _frame_of(recorded.data), frame
            _check_one_camera([earlier, frame], f'{reader.path}: {topics.image}')
            pose, before = poses.pose_at(stamp_ns), stamp_ns
            if is_wanted(place, stamp_ns, pose):
                waiting.append(RawFrame(place, stamp_ns, pose, cameras.decoder(
                    stamp_ns, recorded.stamp_ns, recorded.data)))
            place += 1
        while waiting and (not topics.depth or len(waiting) > _MAX_WAITING or (
                depths and depths[-1][0] >= waiting[0].stamp_ns + topics.tolerance_ns)):
            yield with_depth(waiting.popleft())
    yield from map(with_depth, waiting)


def _peek_stamp_ns(recorded: BagMessage) -> int:
    """Return the header stamp of a serialized message [ns], without deserializing it."""
    try:
        seconds, nanoseconds = struct.unpack_from(f'{_order(recorded.data)}iI', recorded.data, 4)
    except (struct.error, IndexError) as error:
        raise DatasetError(f'{recorded.topic}: a message of {len(recorded.data)} bytes has no '
                           'header') from error
    return int(seconds) * NS_PER_S + int(nanoseconds)


def _frame_of(data: bytes) -> str:
    """Return the coordinate frame of a serialized message; '' if it has no header."""
    try:
        length, = struct.unpack_from(f'{_order(data)}I', data, 12)
    except (struct.error, IndexError):
        return ''
    return plain_name(data[16:16 + length].rstrip(b'\0').decode(errors='replace'))


def _order(data: bytes) -> str:
    """Return the byte order of a serialized message, as a format character of struct."""
    return '<' if data[1] & 1 else '>'


def _decode_color(where: str, info: bytes | Camera, rectified: bool, msgtype: str, data: bytes
                  ) -> tuple[NDArray[np.uint8], Camera]:
    message = deserialize(data, msgtype, where)
    try:
        image = messages.image_from_msg(message)
        size = (image.shape[1], image.shape[0])
        if isinstance(info, Camera):
            if size != (info.width, info.height):
                raise CameraError(f'the image has {size[0]}x{size[1]} px, but the camera has '
                                  f'{info.width}x{info.height} px')
            return image, info
        calibration = deserialize(info, bag_messages.CAMERA_INFO, where)
        camera = messages.camera_from_msg(calibration, size, rectified)
        check_faults(messages.faults_of_camera_info(calibration, camera, rectified))
        return image, camera
    except CliplocError as error:
        seconds = bag_messages.stamp_ns(message) / NS_PER_S
        raise DatasetError(f'{where} at {seconds:.6f}: {error}') from error


def _decode_depth(where: str, msgtype: str, form: DepthFormat, data: bytes) -> DepthImage:
    message = deserialize(data, msgtype, where)
    where = f'{where} at {bag_messages.stamp_ns(message) / NS_PER_S:.6f}'
    try:
        counts = messages.depth_counts_from_msg(message)
    except CliplocError as error:
        raise DatasetError(f'{where}: {error}') from error
    return DepthImage(depth_from_counts(counts, form.unit_m, where), form.camera)

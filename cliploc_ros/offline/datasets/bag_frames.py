# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of a rosbag2 recording: image, camera_info, depth, and poses of a topic or of its tf.

Each transform of the tf's chain is interpolated at the stamp on its own, as tf2 does. Beyond tf2,
a gap between two samples has a limit.
"""

import struct
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros import messages
from cliploc_ros.core.depth_image import DepthImage, depth_from_counts
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import check_faults
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.errors import CliplocError, DatasetError
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bags import BagMessage, BagReader, deserialize
from cliploc_ros.offline.datasets.frames import DepthFormat, Frames, RawFrame, Wanted
from cliploc_ros.offline.datasets.poses import Poses, TimedPoses, check_clock
from cliploc_ros.units import NS_PER_S

# Where each type of message has its pose.
_POSE_TYPES: dict[str, Callable[[Any], Any]] = {
    'geometry_msgs/msg/PoseStamped': lambda message: message.pose,
    'geometry_msgs/msg/PoseWithCovarianceStamped': lambda message: message.pose.pose,
    'nav_msgs/msg/Odometry': lambda message: message.pose.pose,
}
#: Makes the poses of an open recording; given the coordinate frame of its images.
ReadPoses = Callable[[BagReader, str], Poses]
#: Where poses are looked for: the topic that tum_to_bag writes, and the map's frame in tf.
GROUND_TRUTH, MAP_FRAME = '/ground_truth', 'map'
_TF, _TF_STATIC = '/tf', '/tf_static'
_TF_TYPE = 'tf2_msgs/msg/TFMessage'


def poses_of_topic(name: str, max_gap_ns: int = 0,
                   body_from_camera: NDArray[np.float64] | None = None) -> ReadPoses:
    """Return what reads a topic of PoseStamped, PoseWithCovarianceStamped or Odometry.

    Its parameters are those of TimedPoses. DatasetError, when it reads: the topic is missing, of
    another type, or a pose is invalid.
    """
    def read(reader: BagReader, camera_frame: str) -> TimedPoses:
        pose_of = _POSE_TYPES.get(reader.topic(name).msgtype)
        if pose_of is None:
            raise DatasetError(f'{reader.path}: {name} is of type {reader.topic(name).msgtype}, '
                               f'not {" or ".join(_POSE_TYPES)}')
        stamps, rows = [], []
        for recorded in reader.messages([name]):
            message = reader.deserialize(recorded)
            pose = pose_of(message)
            stamps.append(bag_messages.stamp_ns(message))
            rows.append(_numbers(pose.position, pose.orientation))
        poses = TimedPoses.from_samples(stamps, rows, f'{reader.path}: {name}')
        return replace(poses, max_gap_ns=max_gap_ns, body_from_camera=body_from_camera)
    return read


def find_poses(max_gap_ns: int, ground_truth: str = GROUND_TRUTH,
               camera_frame: str | None = None, topic_gap_ns: int | None = None) -> ReadPoses:
    """Return what reads the camera's poses where nobody says where they are.

    They are those of the topic of ground truth, else of tf in the coordinate frame `map`. Other
    topics are not taken: nothing says what their poses are of. The greatest gap of a topic may
    differ from that of tf. DatasetError, when it reads: there are none.
    """
    def read(reader: BagReader, image_frame: str) -> Poses:
        if ground_truth in reader.topics:
            return poses_of_topic(ground_truth, max_gap_ns if topic_gap_ns is None
                                  else topic_gap_ns)(reader, image_frame)
        problem = 'no tf'
        if _TF in reader.topics:
            try:
                return poses_of_tf(MAP_FRAME, camera_frame, max_gap_ns)(reader, image_frame)
            except DatasetError as error:
                problem = str(error).removeprefix(f'{reader.path}: ')
        there = ', '.join(name for name, topic in reader.topics.items()
                          if topic.msgtype in _POSE_TYPES and topic.message_count) or 'none'
        raise DatasetError(f'{reader.path}: say where the poses are: `pose_topic`, `map_frame` '
                           f'(tf) or `trajectory`; topics with poses here: {there}; {problem}')
    return read


@dataclass(frozen=True)
class FixedPose:
    """A pose that holds at any time."""

    pose: NDArray[np.float64]  #: (4, 4)
    span_ns = (-2**63, 2**63 - 1)

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return the pose (4, 4)."""
        return self.pose


@dataclass(frozen=True)
class TransformChain:
    """The way between two coordinate frames through their common ancestor.

    Each link is the pose of a coordinate frame in its parent.
    """

    up: tuple[Poses, ...]  #: From the map up to the common ancestor
    down: tuple[Poses, ...]  #: From the camera up to the common ancestor

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last stamp at which all of the chain is known [ns]."""
        spans = [FixedPose.span_ns, *(one.span_ns for one in (*self.up, *self.down))]
        if None in spans:
            return None
        return max(span[0] for span in spans if span), min(span[1] for span in spans if span)

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp [ns]; None where it is not known."""
        ancestor_from = [np.eye(4), np.eye(4)]
        for end, links in enumerate((self.up, self.down)):
            for link in links:
                parent_from_child = link.pose_at(stamp_ns)
                if parent_from_child is None:
                    return None
                ancestor_from[end] = parent_from_child @ ancestor_from[end]
        return np.asarray(invert_transform(ancestor_from[0]) @ ancestor_from[1])


def poses_of_tf(map_frame: str, camera_frame: str | None, max_gap_ns: int) -> ReadPoses:
    """Return what reads how a camera moved in a map, from /tf and /tf_static.

    DatasetError, when it reads: the recording has no tf, or nothing connects the two frames.

    Parameters
    ----------
    map_frame, camera_frame : str
        Coordinate frames; the camera's is the optical one (z forward), by default the images'.
    max_gap_ns : int
        Greatest gap between two samples to interpolate over [ns].
    """
    def read(reader: BagReader, image_frame: str) -> TransformChain:
        topics = [name for name in (_TF, _TF_STATIC) if name in reader.topics]
        for name in topics:
            if reader.topic(name).msgtype != _TF_TYPE:
                raise DatasetError(f'{reader.path}: {name} is of type '
                                   f'{reader.topic(name).msgtype}, not {_TF_TYPE}')
        if not topics:
            raise DatasetError(f'{reader.path}: has neither {_TF} nor {_TF_STATIC}; record them, '
                               'or name a topic or file of poses')
        parents, up, down = _find_way(reader, topics, map_frame,
                                      camera_frame or _name(image_frame))
        links = _read_links(reader, topics, {*up, *down}, parents, max_gap_ns)
        return TransformChain(tuple(links[child] for child in up),
                              tuple(links[child] for child in down))
    return read


def _find_way(reader: BagReader, topics: Collection[str], map_frame: str, camera_frame: str
              ) -> tuple[dict[str, str], list[str], list[str]]:
    """Return the parents, and the frames below the common ancestor from the map and the camera.

    It reads until the two are connected.
    """
    parents: dict[str, str] = {}
    up, down = [map_frame], [camera_frame]
    for recorded in reader.messages(topics):
        count = len(parents)
        for transform in reader.deserialize(recorded).transforms:
            parents.setdefault(_name(transform.child_frame_id), _name(transform.header.frame_id))
        if len(parents) > count:
            up, down = _ancestors(parents, map_frame), _ancestors(parents, camera_frame)
            if up[-1] == down[-1]:
                break
    common = next((frame for frame in down if frame in up), None)
    if common is not None:
        return parents, up[:up.index(common)], down[:down.index(common)]
    known = {*parents, *parents.values()}
    for frame in (map_frame, camera_frame):
        if frame not in known:
            raise DatasetError(f"{reader.path}: tf has no coordinate frame '{frame}'; it has "
                               f'{", ".join(sorted(known)) or "none"}')
    raise DatasetError(
        f"{reader.path}: tf does not connect '{map_frame}' and '{camera_frame}': their roots are "
        f"'{up[-1]}' and '{down[-1]}'; did the localizer run during the recording?")


def _ancestors(parents: Mapping[str, str], frame: str) -> list[str]:
    """Return a frame and its ancestors, up to the root; a loop is cut."""
    way = [frame]
    while way[-1] in parents and parents[way[-1]] not in way:
        way.append(parents[way[-1]])
    return way


def _read_links(reader: BagReader, topics: Collection[str], children: Collection[str],
                parents: Mapping[str, str], max_gap_ns: int) -> dict[str, Poses]:
    """Return the poses of some children in their parents; of a static one, the last."""
    samples: dict[str, dict[str, tuple[list[int], list[tuple[float, ...]]]]] = {
        topic: {child: ([], []) for child in children} for topic in topics}
    for recorded in reader.messages(topics):
        for message in reader.deserialize(recorded).transforms:
            child, transform = _name(message.child_frame_id), message.transform
            if child not in children:
                continue
            if _name(message.header.frame_id) != parents[child]:
                raise DatasetError(
                    f"{reader.path}: tf: '{child}' has two parents, '{parents[child]}' and "
                    f"'{_name(message.header.frame_id)}'; record one tree of one robot")
            stamps, rows = samples[recorded.topic][child]
            stamps.append(bag_messages.stamp_ns(message))
            rows.append(_numbers(transform.translation, transform.rotation))
    links: dict[str, Poses] = {}
    for child in children:
        where = f"{reader.path}: tf of '{child}'"
        stamps, rows = samples.get(_TF_STATIC, {}).get(child, ([], []))
        if stamps:
            fixed = TimedPoses.from_samples(stamps[-1:], rows[-1:], where).pose_at(stamps[-1])
            assert fixed is not None
            links[child] = FixedPose(fixed)
        else:
            links[child] = replace(TimedPoses.from_samples(*samples[_TF][child], where),
                                   max_gap_ns=max_gap_ns)
    return links


def _numbers(offset: Any, turn: Any) -> tuple[float, ...]:
    return offset.x, offset.y, offset.z, turn.x, turn.y, turn.z, turn.w


def _name(frame_id: str) -> str:
    return frame_id.removeprefix('/')


_IMAGES = (bag_messages.IMAGE, bag_messages.COMPRESSED_IMAGE)
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
        infos = named((bag_messages.CAMERA_INFO,))
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
    faults = [*messages.faults_of_headers(image.header.frame_id, info.header.frame_id),
              *messages.faults_of_rectified(topics.image, topics.rectified, info)]
    try:
        check_faults(faults)
    except CliplocError as error:
        raise DatasetError(f'{reader.path}: {error}') from error
    with suppress(CliplocError):  # who decodes the image says so
        size = messages.image_from_msg(image).shape[1::-1]
        camera = messages.camera_from_msg(info, size, topics.rectified)
        faults += messages.faults_of_camera_info(info, camera, topics.rectified)
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
    first_ns = bag_messages.stamp_ns(image)
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
    for name, types in ((topics.image, _IMAGES), (topics.camera_info, (bag_messages.CAMERA_INFO,)),
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
        image = messages.image_from_msg(message)
        size = (image.shape[1], image.shape[0])
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

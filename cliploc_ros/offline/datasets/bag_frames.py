# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The frames of a rosbag2 recording: image, camera_info, depth, and poses of a topic or of its tf.

Each transform of the tf's chain is interpolated at the stamp on its own, as tf2 does. Beyond tf2,
a gap between two samples has a limit.
"""

import math
import struct
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros import messages
from cliploc_ros.core.depth_image import DepthCamera, DepthImage, depth_from_counts
from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.camera_faults import check_faults
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.errors import CameraError, CliplocError, DatasetError
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.agreement import AXES, Reading, View, check_agreement
from cliploc_ros.offline.datasets.bags import BagMessage, BagReader, deserialize
from cliploc_ros.offline.datasets.frames import DepthFormat, Frames, RawFrame, Wanted
from cliploc_ros.offline.datasets.intrinsics import find_camera
from cliploc_ros.offline.datasets.poses import (
    MAX_NORM_ERROR,
    STAMP_TOLERANCE_NS,
    Poses,
    TimedPoses,
    check_clock,
    check_forward,
)
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
# Poses of two sources are compared at so many stamps, and are the same within this [m] [deg].
_COMPARED, _SAME_M, _SAME_DEG = 50, 0.05, 2.0


def poses_of_topic(name: str, max_gap_ns: int = 0,
                   body_from_camera: NDArray[np.float64] | None = None,
                   tolerance_ns: int = STAMP_TOLERANCE_NS, tf: str | None = None) -> ReadPoses:
    """Return what reads a topic of PoseStamped, PoseWithCovarianceStamped or Odometry.

    Its parameters are those of TimedPoses. Without a mount, poses of a child_frame_id other than
    the images' are led on to the camera by tf. DatasetError, when it reads: the topic is missing,
    of another type, many poses are invalid, or nothing leads to the camera.
    """
    def read(reader: BagReader, camera_frame: str) -> Poses:
        pose_of = _POSE_TYPES.get(reader.topic(name).msgtype)
        if pose_of is None:
            raise DatasetError(f'{reader.path}: {name} is of type {reader.topic(name).msgtype}, '
                               f'not {" or ".join(_POSE_TYPES)}')
        stamps, rows, child = [], [], ''
        for _, message in _readable(reader, [name]):
            pose = pose_of(message)
            numbers = _sound(reader, name, message, pose.position, pose.orientation)
            if numbers is not None:
                stamps.append(bag_messages.stamp_ns(message))
                rows.append(numbers)
                child = _name(getattr(message, 'child_frame_id', ''))
        check_forward(stamps, f'{reader.path}: {name}')
        poses = replace(TimedPoses.from_samples(stamps, rows, f'{reader.path}: {name}'),
                        max_gap_ns=max_gap_ns, body_from_camera=body_from_camera,
                        tolerance_ns=tolerance_ns)
        if body_from_camera is not None or child in ('', _name(camera_frame)):
            return poses
        try:
            chain = poses_of_tf(child, camera_frame, max_gap_ns, tf)(reader, camera_frame)
            return ChainedPoses(poses, chain)
        except DatasetError as error:
            raise DatasetError(
                f"{reader.path}: the poses of {name} are of '{child}' (child_frame_id), the "
                f"images of '{camera_frame}': give the `mount` of the camera on it, or record tf "
                f'between them ({str(error).removeprefix(f"{reader.path}: ")})') from error
    return read


def _readable(reader: BagReader, topics: Collection[str]) -> Iterator[tuple[str, Any]]:
    """Yield topic and message of topics; those that cannot be read are left out."""
    for recorded in reader.messages(topics):
        try:
            message = reader.deserialize(recorded)
        except DatasetError as error:
            reader.leave_out(recorded.topic, str(error).removeprefix(f'{reader.path}: '))
        else:
            yield recorded.topic, message


def find_poses(max_gap_ns: int, ground_truth: str = GROUND_TRUTH,
               camera_frame: str | None = None, topic_gap_ns: int | None = None,
               tolerance_ns: int = STAMP_TOLERANCE_NS, tf: str | None = None) -> ReadPoses:
    """Return what reads the camera's poses where nobody says where they are.

    They are those of the topic of ground truth, else of tf in the coordinate frame `map`. Other
    topics are not taken: nothing says what their poses are of. The greatest gap of a topic may
    differ from that of tf. DatasetError, when it reads: there are none.
    """
    def read(reader: BagReader, image_frame: str) -> Poses:
        problem, of_tf = 'no tf', None
        try:
            if _tf_topics(reader, tf):
                of_tf = poses_of_tf(MAP_FRAME, camera_frame, max_gap_ns, tf)(reader, image_frame)
        except DatasetError as error:
            problem = str(error).removeprefix(f'{reader.path}: ')
        if ground_truth in reader.topics:
            of_topic = poses_of_topic(
                ground_truth, max_gap_ns if topic_gap_ns is None else topic_gap_ns, None,
                tolerance_ns, tf)(reader, camera_frame or image_frame)
            if of_tf is not None and (far := _difference(of_topic, of_tf)):
                reader.notes.append(f'{ground_truth} and tf say different poses of the camera: '
                                    f'{far}; {ground_truth} is used; give `map_frame` for tf')
            return of_topic
        if of_tf is not None:
            return of_tf
        there = ', '.join(name for name, topic in reader.topics.items()
                          if topic.msgtype in _POSE_TYPES and topic.message_count) or 'none'
        raise DatasetError(f'{reader.path}: say where the poses are: `pose_topic`, `map_frame` '
                           f'(tf) or `trajectory`; topics with poses here: {there}; {problem}')
    return read


def _difference(one: Poses, other: Poses) -> str:
    """Return how far poses of two sources differ, in words; '' where they do not."""
    (first, last), errors = one.span_ns or (0, 0), []
    for stamp in np.linspace(first, last, _COMPARED).astype(np.int64).tolist():
        pair = one.pose_at(stamp), other.pose_at(stamp)
        if pair[0] is not None and pair[1] is not None:
            errors.append(pose_error(pair[0], pair[1]))
    far_m, far_deg = np.median(errors, axis=0) if errors else (0.0, 0.0)
    return '' if far_m < _SAME_M and far_deg < _SAME_DEG else (
        f'{100.0 * far_m:.0f} cm and {far_deg:.1f} degrees (median)')


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


@dataclass(frozen=True)
class ChainedPoses:
    """The poses of a body, and the way from it to the camera."""

    body: Poses
    chain: Poses

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last stamp at which the body's pose is known [ns]."""
        return self.body.span_ns

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp [ns]; None where it is not known."""
        first, second = self.body.pose_at(stamp_ns), self.chain.pose_at(stamp_ns)
        return None if first is None or second is None else np.asarray(first @ second)


def poses_of_tf(map_frame: str, camera_frame: str | None, max_gap_ns: int,
                tf: str | None = None) -> ReadPoses:
    """Return what reads how a camera moved in a map, from /tf and /tf_static.

    DatasetError, when it reads: the recording has no tf, or nothing connects the two frames.

    Parameters
    ----------
    map_frame, camera_frame : str
        Coordinate frames; the camera's is the optical one (z forward), by default the images'.
    max_gap_ns : int
        Greatest gap between two samples to interpolate over [ns].
    tf : str, optional
        The topic instead of /tf; the static one is its name with _static.
    """
    def read(reader: BagReader, image_frame: str) -> TransformChain:
        topics = _tf_topics(reader, tf)
        if not topics:
            raise DatasetError(f'{reader.path}: has neither {_TF} nor {_TF_STATIC}; record them, '
                               'or name a topic or file of poses')
        parents, up, down = _find_way(reader, topics, map_frame,
                                      camera_frame or _name(image_frame))
        links = _read_links(reader, topics, {*up, *down}, parents, max_gap_ns)
        return TransformChain(tuple(links[child] for child in up),
                              tuple(links[child] for child in down))
    return read


def _tf_topics(reader: BagReader, tf: str | None) -> list[str]:
    """Return the topics of tf: the named one, /tf, or the only one under a robot's name.

    DatasetError: there are those of several robots, or one is of another type.
    """
    there = [name for name, topic in reader.topics.items()
             if topic.msgtype == _TF_TYPE and name.endswith((_TF, _TF_STATIC))]
    names = sorted({name.removesuffix('_static') for name in there})
    if tf is None and _TF not in names and len(names) > 1:
        raise DatasetError(f'{reader.path}: tf of several robots: {", ".join(names)}; give `tf`')
    if tf is None:
        tf = _TF if _TF in reader.topics or not names else names[0]
    elif tf not in reader.topics:
        reader.topic(tf)  # says which there are
    topics = [name for name in dict.fromkeys((tf, f'{tf}_static', _TF_STATIC))
              if name in reader.topics]
    for name in topics:
        if reader.topic(name).msgtype != _TF_TYPE:
            raise DatasetError(f'{reader.path}: {name} is of type '
                               f'{reader.topic(name).msgtype}, not {_TF_TYPE}')
    return topics


def _sound(reader: BagReader, topic: str, message: Any, offset: Any, turn: Any
           ) -> tuple[float, ...] | None:
    """Return the numbers of a pose or transform; None, and left out, where it can be none."""
    numbers = (offset.x, offset.y, offset.z, turn.x, turn.y, turn.z, turn.w)
    if np.isfinite(numbers).all() and abs(math.hypot(*numbers[3:]) - 1.0) <= MAX_NORM_ERROR:
        return numbers
    reader.leave_out(topic, f'the pose at {bag_messages.stamp_ns(message) / NS_PER_S:.6f} s is '
                     'not finite or has no unit quaternion')
    return None


def _find_way(reader: BagReader, topics: Collection[str], map_frame: str, camera_frame: str
              ) -> tuple[dict[str, str], list[str], list[str]]:
    """Return the parents, and the frames below the common ancestor from the map and the camera.

    It reads until the two are connected.
    """
    parents: dict[str, str] = {}
    up, down = [map_frame], [camera_frame]
    for _, message in _readable(reader, topics):
        count = len(parents)
        for transform in message.transforms:
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
    for topic, recorded in _readable(reader, topics):
        for message in recorded.transforms:
            child = _name(message.child_frame_id)
            if child not in children:
                continue
            if _name(message.header.frame_id) != parents[child]:
                raise DatasetError(
                    f"{reader.path}: tf: '{child}' has two parents, '{parents[child]}' and "
                    f"'{_name(message.header.frame_id)}'; record one tree of one robot")
            field = message.transform
            numbers = _sound(reader, topic, message, field.translation, field.rotation)
            if numbers is not None:
                stamps, rows = samples[topic][child]
                stamps.append(bag_messages.stamp_ns(message))
                rows.append(numbers)
    links: dict[str, Poses] = {}
    for child in children:
        where = f"{reader.path}: tf of '{child}'"
        fixed = [samples[name][child] for name in topics if name.endswith('_static')]
        moving = [samples[name][child] for name in topics if not name.endswith('_static')]
        stamps, rows = next((one for one in fixed if one[0]), ([], []))
        if stamps:
            pose = TimedPoses.from_samples(stamps[-1:], rows[-1:], where).pose_at(stamps[-1])
            assert pose is not None
            links[child] = FixedPose(pose)
        else:
            stamps, rows = moving[0] if moving else ([], [])
            check_forward(stamps, where)
            links[child] = replace(TimedPoses.from_samples(stamps, rows, where),
                                   max_gap_ns=max_gap_ns)
    return links


def _name(frame_id: str) -> str:
    return frame_id.removeprefix('/')


_IMAGES = (bag_messages.IMAGE, bag_messages.COMPRESSED_IMAGE)
_COMPRESSED = '/compressed'
# Images that wait for their depth. A depth image is recorded at most this many images later.
_MAX_WAITING = 15
# Images that are compared with poses: parts of a recording, images of a part, its length [s].
# Then by how much stamps may be off [s], and the error that rectified images have, taken for raw,
# or the reverse [px], with the share of it that is left without this fault.
_SHIFTS_S = (-0.5, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.5)
_RECTIFIED_PX, _RECTIFIED_BETTER = 0.6, 0.6
_COMPARED_PARTS, _COMPARED_OF_PART, _PART_S = 12, 8, 4.0


class _Selected(NamedTuple):
    """An image of a recording, and the depth image that belongs to it."""

    place: int
    stamp_ns: int
    recorded_ns: int
    pose: NDArray[np.float64] | None
    data: bytes
    depth: bytes | None = None


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
    intrinsics: str | None = None  #: What is used instead of camera_info, see find_camera
    #: A depth image belongs to a colour image at most this far away in time [ns]
    tolerance_ns: int = STAMP_TOLERANCE_NS

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
    form = depth or DepthFormat()
    with BagReader(bag) as reader:
        _check_topics(reader, topics)
        poses = _poses_of_images(reader, topics.image, read_poses, str(bag))
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
            for one in _paired(reader, topics, poses, is_wanted):
                yield RawFrame(
                    one.place, one.stamp_ns, one.pose,
                    cameras.decoder(one.stamp_ns, one.recorded_ns, one.data),
                    None if one.depth is None else partial(decode_depth, one.depth))
    return Frames(bag, count, read_raw, varies=len(cameras.infos) > 1, notes=tuple(
        f'note: {note}' for note in notes if note))


class _Cameras(NamedTuple):
    """The camera_info of a recording: what it says, and when."""

    where: str
    msgtype: str  #: Of the images
    rectified: bool
    infos: tuple[bytes, ...]  #: Those that differ; empty where a file says the camera
    #: (c,): when each message holds [ns], by its stamp or, without stamps, by its recording
    times_ns: NDArray[np.int64]
    rows: NDArray[np.int64]  #: (c,): which of the infos it is
    by_stamp: bool
    given: Camera | None = None

    @classmethod
    def read(cls, reader: BagReader, topics: BagTopics) -> '_Cameras':
        """Return those of a recording; messages without a calibration are left out."""
        where, msgtype = f'{reader.path}: {topics.image}', reader.topic(topics.image).msgtype
        none = np.empty(0, dtype=np.int64)
        if topics.intrinsics is not None:
            return cls(where, msgtype, topics.rectified, (), none, none, True,
                       find_camera(topics.intrinsics, reader.path)[0])
        infos: dict[bytes, bytes] = {}
        found = []
        for one in reader.messages([topics.camera_info]):
            stamp_ns = _peek_stamp_ns(one)
            content = one.data[:4] + one.data[12:]  # all but the stamp
            infos.setdefault(content, one.data)
            found.append((stamp_ns, one.stamp_ns, content))
        sound = {content: data for content, data in infos.items()
                 if _is_calibrated(data, topics.rectified)} or dict([*infos.items()][:1])
        for stamp_ns, _, content in found:
            if content not in sound and len(sound) < len(infos):
                reader.leave_out(topics.camera_info, f'that at {stamp_ns / NS_PER_S:.6f} s has no '
                                 'calibration')
        kept, numbers = [one for one in found if one[2] in sound], [*sound]
        by_stamp = all(one[0] for one in kept)
        if by_stamp:
            check_forward([one[0] for one in kept], f'{reader.path}: {topics.camera_info}')
        return cls(where, msgtype, topics.rectified, tuple(sound.values()),
                   np.array([one[not by_stamp] for one in kept], dtype=np.int64),
                   np.array([numbers.index(one[2]) for one in kept], dtype=np.int64), by_stamp)

    def decoder(self, stamp_ns: int, recorded_ns: int, data: bytes
                ) -> Callable[[], tuple[NDArray[np.uint8], Camera]]:
        """Return what decodes an image, with the camera_info nearest in time."""
        info: bytes | Camera
        if self.given is not None:
            info = self.given
        else:
            offsets = np.abs(self.times_ns - (stamp_ns if self.by_stamp else recorded_ns))
            info = self.infos[self.rows[int(np.argmin(offsets))] if len(self.infos) > 1 else 0]
        return partial(_decode_color, self.where, info, self.rectified, self.msgtype, data)


def _is_calibrated(data: bytes, rectified: bool) -> bool:
    info = deserialize(data, bag_messages.CAMERA_INFO, 'camera_info')
    focal_px = np.diag(np.reshape(info.p, (3, 4)) if rectified else np.reshape(info.k, (3, 3)))[:2]
    return bool(np.isfinite(focal_px).all() and (focal_px > 0.0).all())


def _first(reader: BagReader, topic: str) -> Any:
    """Return the first message of a topic that can be read."""
    found = next(_readable(reader, [topic]), None)
    if found is None:
        raise DatasetError(f'{reader.path}: {topic} has no message that can be read')
    return found[1]


def _depth_of_its_camera(reader: BagReader, topics: BagTopics, form: DepthFormat) -> DepthFormat:
    """Return how to read depth that is in the coordinate frame of another camera.

    DatasetError: camera_info of depth, or tf between the two, is missing.
    """
    image, depth = (_name(str(_first(reader, topic).header.frame_id))
                    for topic in (topics.image, topics.depth))
    if form.camera is not None or not image or not depth or image == depth:
        return form
    beside = topics.depth.removesuffix('/compressedDepth').rpartition('/')[0] + '/camera_info'
    problem = f'{beside} is missing'
    if beside in reader.topics and beside != topics.camera_info:
        info = _first(reader, beside)
        (fx, _, cx), (_, fy, cy), _ = np.reshape(info.k, (3, 3)).tolist()
        try:
            way = poses_of_tf(image, depth, 10 * NS_PER_S)(reader, depth)
            pose = way.pose_at(bag_messages.stamp_ns(_first(reader, topics.depth)))
            if pose is not None:
                return replace(form, camera=DepthCamera(fx, fy, cx, cy, pose))
            problem = 'tf between them is of another time'
        except DatasetError as error:
            problem = str(error).removeprefix(f'{reader.path}: ')
    raise DatasetError(f"{reader.path}: depth is in the coordinate frame '{depth}', the image in "
                       f"'{image}', and {problem}: record depth registered to the image, or give "
                       'its `depth_intrinsics` and `depth_baseline`')


def _sampled(reader: BagReader, topics: BagTopics, poses: Poses, cameras: _Cameras
             ) -> list[View]:
    """Return some images of parts of a recording; they are read when they are looked at."""
    views, last = [], np.iinfo(np.int64).min
    for begin in np.linspace(reader.start_ns, reader.end_ns, _COMPARED_PARTS, endpoint=False):
        begin_ns = max(int(begin), last)
        found = [(_peek_stamp_ns(one), one.stamp_ns) for one in reader.messages(
            [topics.image], begin_ns, int(begin) + round(_PART_S * NS_PER_S))]
        last = max([last, *(recorded_ns + 1 for _, recorded_ns in found)])
        step = max(1, len(found) // _COMPARED_OF_PART)
        images = BagImages(reader.path, topics.image, np.array(found[::step], dtype=np.int64
                                                               ).reshape(-1, 2), cameras)
        views += [View(poses.pose_at(stamp_ns), partial(images.look, place),
                       partial(_pose_after, poses, stamp_ns))
                  for place, (stamp_ns, _) in enumerate(found[::step])]
    return views


def _pose_after(poses: Poses, stamp_ns: int, later_ns: int) -> NDArray[np.float64] | None:
    return poses.pose_at(stamp_ns + later_ns)


def _readings(cameras: _Cameras, rectified: bool) -> dict[str, Reading]:
    """Return how the images and poses of a recording may be meant, the given way first."""
    given = 'rectified' if rectified else 'given'
    mount = 'give the `mount` {} of the camera on what the poses are of, or the `camera_frame`'
    readings = {given: Reading('')}
    infos = [deserialize(one, bag_messages.CAMERA_INFO, cameras.where) for one in cameras.infos]
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
    """Return what is unusual about the camera of a recording, by its first messages.

    DatasetError: its images are certainly rectified, and read as raw.
    """
    if topics.intrinsics is not None:
        return []
    image, info = (_first(reader, topic) for topic in (topics.image, topics.camera_info))
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
    return [fault.text for fault in faults]


def bag_odometry(bag: Path, image_topic: str, read_odometry: ReadPoses) -> Poses:
    """Return the poses of a recording's camera by odometry.

    DatasetError: the topic or tf is missing or broken, or of another time than the images.
    """
    with BagReader(bag) as reader:
        return _poses_of_images(reader, image_topic, read_odometry, f'{bag}: odometry')


def _poses_of_images(reader: BagReader, image_topic: str, read_poses: ReadPoses, where: str
                     ) -> Poses:
    image = _first(reader, image_topic)
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
        times_ns = [(_peek_stamp_ns(one), one.stamp_ns) for one in reader.messages([topics.image])]
        return BagImages(bag, topics.image, np.array(times_ns, dtype=np.int64).reshape(-1, 2),
                         _Cameras.read(reader, topics))


@dataclass(frozen=True)
class BagImages:
    """The images of a recording, read one at a time through its index of time."""

    bag: Path
    topic: str
    #: (F, 2): when each image was taken, and when it was recorded [ns]
    times_ns: NDArray[np.int64]
    cameras: _Cameras

    def look(self, place: int, upright: bool) -> tuple[NDArray[np.uint8], Camera]:
        """Return an image and its camera; no message says that it is to be turned."""
        return self.read(place)

    def read(self, place: int) -> tuple[NDArray[np.uint8], Camera]:
        """Return an image (h, w, 3), red first, and its camera.

        DatasetError: it cannot be decoded, or the recording changed.
        """
        taken_ns, recorded_ns = self.times_ns[place].tolist()
        with BagReader(self.bag) as reader:
            for one in reader.messages([self.topic], recorded_ns, recorded_ns + 1):
                if _peek_stamp_ns(one) == taken_ns:
                    return self.cameras.decoder(taken_ns, recorded_ns, one.data)()
        raise DatasetError(f'{self.bag}: image {place} of {self.topic} is gone; start again')


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


def _paired(reader: BagReader, topics: BagTopics, poses: Poses, is_wanted: Wanted
            ) -> Iterator[_Selected]:
    """Yield the wanted images, each with the depth image nearest in time, or None."""
    waiting: deque[_Selected] = deque()
    depths: deque[tuple[int, bytes]] = deque(maxlen=2 * _MAX_WAITING)

    def with_depth(selected: _Selected) -> _Selected:
        nearest = min(depths, key=lambda depth: abs(depth[0] - selected.stamp_ns), default=None)
        if nearest is None or abs(nearest[0] - selected.stamp_ns) > topics.tolerance_ns:
            return selected
        return selected._replace(depth=nearest[1])
    place, before = 0, 0
    for recorded in reader.messages([topics.image, *([topics.depth] if topics.depth else [])]):
        stamp_ns = _peek_stamp_ns(recorded)
        if topics.depth and recorded.topic == topics.depth:
            depths.append((stamp_ns, recorded.data))
        else:
            check_forward([before, stamp_ns], f'{reader.path}: {topics.image}')
            pose, before = poses.pose_at(stamp_ns), stamp_ns
            if is_wanted(place, stamp_ns, pose):
                waiting.append(_Selected(place, stamp_ns, recorded.stamp_ns, pose, recorded.data))
            place += 1
        while waiting and (not topics.depth or len(waiting) > _MAX_WAITING or (
                depths and depths[-1][0] >= waiting[0].stamp_ns + topics.tolerance_ns)):
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

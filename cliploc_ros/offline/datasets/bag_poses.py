# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Poses of the camera of a rosbag2 recording, from a topic of poses or from tf.

As in tf2, each transform of a chain is interpolated separately at the stamp. Unlike in tf2, the
gap between two samples is limited.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros import messages
from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bags import BagReader
from cliploc_ros.offline.datasets.poses import (
    MAX_NORM_ERROR,
    STAMP_TOLERANCE_NS,
    Poses,
    TimedPoses,
    check_clock,
    check_forward,
)
from cliploc_ros.units import NS_PER_S

# Reads the pose from each type of message.
_POSE_TYPES: dict[str, Callable[[Any], Any]] = {
    'geometry_msgs/msg/PoseStamped': lambda message: message.pose,
    'geometry_msgs/msg/PoseWithCovarianceStamped': lambda message: message.pose.pose,
    bag_messages.ODOMETRY: lambda message: message.pose.pose,
}
#: Default sources of poses: the topic that tum_to_bag writes, and the map's frame in tf.
GROUND_TRUTH, MAP_FRAME = '/ground_truth', 'map'
_TF, _TF_STATIC = '/tf', '/tf_static'
_TF_TYPE = 'tf2_msgs/msg/TFMessage'
# Tolerance of a static transform, whose pose is constant in time.
_ALWAYS_NS = 2**63
# A correction jumps if it moves the camera by more than this [m] [deg], and this many times as far
# as its median. Chosen.
_JUMP, _UNUSUAL = (0.2, 8.0), 3.0
# Two sources of poses are compared at this many stamps, and agree within this [m] [deg].
_COMPARED, _SAME_M, _SAME_DEG = 50, 0.05, 2.0


@dataclass(frozen=True)
class PoseSource:
    """The source of a camera's poses in a recording: a topic, tf, or a trajectory.

    If none of the three is given, the poses are those of the topic of ground truth if there is
    one, otherwise of tf in the coordinate frame `map`. Other topics are not used: it is unknown
    which body their poses describe.
    """

    topic: str | None = None  #: PoseStamped, PoseWithCovarianceStamped or Odometry
    map_frame: str | None = None  #: Coordinate frame of the map in tf
    trajectory: TimedPoses | None = None
    #: The camera's optical coordinate frame (z forward); None: that of the images
    camera_frame: str | None = None
    #: Topic to use instead of /tf. The static topic has its name with the suffix _static.
    tf: str | None = None
    #: Greatest gap between two samples of tf, and of a topic, to interpolate over [ns]
    max_gap_ns: int = 0
    topic_gap_ns: int = 0
    #: (4, 4): mount of the camera on the body that a topic describes. None: the poses are those of
    #: child_frame_id, and tf has the transform to the camera; without this id, of the camera
    body_from_camera: NDArray[np.float64] | None = None
    tolerance_ns: int = STAMP_TOLERANCE_NS
    ground_truth: str = GROUND_TRUTH  #: Topic

    def read(self, reader: BagReader, image_frame: str) -> Poses:
        """Read the poses of an open recording, given the coordinate frame of its images.

        DatasetError: the source is missing or of another type, many poses are invalid, or tf does
        not connect the two coordinate frames.
        """
        camera_frame = plain_name(self.camera_frame or image_frame)
        if self.trajectory is not None:
            return self.trajectory
        if self.topic is not None:
            return self._of_topic(reader, self.topic, camera_frame)
        if self.map_frame is not None:
            reader.notes += _drift_notes(self.map_frame)
            return self._of_tf(reader, self.map_frame, camera_frame, self.max_gap_ns)
        problem, of_tf = 'no tf', None
        try:
            if _tf_topics(reader, self.tf):
                of_tf = self._of_tf(reader, MAP_FRAME, camera_frame, self.max_gap_ns)
        except DatasetError as error:
            problem = str(error).removeprefix(f'{reader.path}: ')
        if self.ground_truth in reader.topics:
            of_topic = self._of_topic(reader, self.ground_truth, camera_frame)
            if of_tf is not None and (far := _difference(of_topic, of_tf)):
                reader.notes.append(f'{self.ground_truth} and tf give different poses of the '
                                    f'camera: {far} apart; {self.ground_truth} is used; give '
                                    '`map_frame` for tf')
            return of_topic
        if of_tf is not None:
            return of_tf
        there = ', '.join(name for name, topic in reader.topics.items()
                          if topic.msgtype in _POSE_TYPES and topic.message_count) or 'none'
        raise DatasetError(f'{reader.path}: say where the poses are: `pose_topic`, `map_frame` '
                           f'(tf) or `trajectory`; topics with poses: {there}; {problem}')

    def _of_topic(self, reader: BagReader, name: str, camera_frame: str) -> Poses:
        where, kind = f'{reader.path}: {name}', reader.topic(name).msgtype
        pose_of = _POSE_TYPES.get(kind)
        if pose_of is None:
            raise DatasetError(f'{where} is of type {kind}, not {" or ".join(_POSE_TYPES)}')
        stamps, rows, children, frame_id = [], [], set[str](), ''
        for _, message in reader.readable([name]):
            pose = pose_of(message)
            numbers = _sound(reader, name, message, pose.position, pose.orientation)
            if numbers is not None:
                stamps.append(bag_messages.stamp_ns(message))
                rows.append(numbers)
                frame_id = plain_name(message.header.frame_id) or name
                children.add(plain_name(getattr(message, 'child_frame_id', '')))
        check_forward(stamps, where)
        reader.notes += _drift_notes(frame_id)
        poses = replace(TimedPoses.from_samples(stamps, rows, where),
                        max_gap_ns=self.topic_gap_ns, body_from_camera=self.body_from_camera,
                        tolerance_ns=self.tolerance_ns)
        if len(children) > 1:
            raise DatasetError(f'{where} has poses of several coordinate frames, '
                               f'{", ".join(sorted(children))} (child_frame_id): record the '
                               'poses of one frame')
        child = ''.join(children)
        if self.body_from_camera is not None or child in ('', camera_frame):
            return poses
        try:
            return replace(self._of_tf(reader, child, camera_frame, self.topic_gap_ns), body=poses)
        except DatasetError as error:
            raise DatasetError(
                f"{reader.path}: the poses of {name} are of '{child}' (child_frame_id), the "
                f"images of '{camera_frame}': give the `mount` of the camera on it, or record tf "
                f'between them ({str(error).removeprefix(f"{reader.path}: ")})') from error

    def _of_tf(self, reader: BagReader, map_frame: str, camera_frame: str, max_gap_ns: int
               ) -> 'TransformChain':
        topics = _tf_topics(reader, self.tf)
        if not topics:
            raise DatasetError(f'{reader.path}: has neither {_TF} nor {_TF_STATIC}; record them, '
                               'or give a topic or file of poses')
        parents, up, down = _find_way(reader, topics, plain_name(map_frame), camera_frame)
        links = _read_links(reader, topics, {*up, *down}, parents, max_gap_ns)
        return _after_jumps(reader, links, up, down)


def _difference(poses: Poses, others: Poses) -> str:
    """Describe the median difference of two sources of poses; '' if they agree."""
    (first, last), errors = poses.span_ns or (0, 0), []
    for stamp in np.linspace(first, last, _COMPARED).astype(np.int64).tolist():
        pair = poses.pose_at(stamp), others.pose_at(stamp)
        if pair[0] is not None and pair[1] is not None:
            errors.append(pose_error(pair[0], pair[1]))
    far_m, far_deg = np.median(errors, axis=0) if errors else (0.0, 0.0)
    return '' if far_m < _SAME_M and far_deg < _SAME_DEG else (
        f'{100.0 * far_m:.0f} cm and {far_deg:.1f} degrees (median)')


@dataclass(frozen=True)
class TransformChain:
    """The transforms from two coordinate frames up to their common ancestor.

    Each link is the pose of a coordinate frame in its parent. If there is a body, the first frame
    is that of the body, whose poses are in a map.
    """

    up: tuple[TimedPoses, ...]  #: Links from the map, or the body, to the common ancestor
    down: tuple[TimedPoses, ...]  #: Links from the camera to the common ancestor
    body: Poses | None = None

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last stamp at which all links, or the body, are known [ns]."""
        if self.body is not None:
            return self.body.span_ns
        spans = [(-_ALWAYS_NS, _ALWAYS_NS - 1), *(
            link.span_ns for link in (*self.up, *self.down) if link.tolerance_ns < _ALWAYS_NS)]
        if None in spans:
            return None
        return max(span[0] for span in spans if span), min(span[1] for span in spans if span)

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp [ns]; None if it is not known."""
        ancestor_from = [np.eye(4), np.eye(4)]
        for end, links in enumerate((self.up, self.down)):
            for link in links:
                parent_from_child = link.pose_at(stamp_ns)
                if parent_from_child is None:
                    return None
                ancestor_from[end] = parent_from_child @ ancestor_from[end]
        pose = np.asarray(invert_transform(ancestor_from[0]) @ ancestor_from[1])
        if self.body is None:
            return pose
        body = self.body.pose_at(stamp_ns)
        return None if body is None else np.asarray(body @ pose)


def _tf_topics(reader: BagReader, tf: str | None) -> list[str]:
    """Return the topics of tf: the given topic, /tf, or the only one in a robot's namespace.

    DatasetError: several robots have tf topics, or a topic is of another type.
    """
    there = [name for name, topic in reader.topics.items()
             if topic.msgtype == _TF_TYPE and name.endswith((_TF, _TF_STATIC))]
    names = sorted({name.removesuffix('_static') for name in there})
    if tf is None and _TF not in names and len(names) > 1:
        raise DatasetError(f'{reader.path}: tf of several robots: {", ".join(names)}; give `tf`')
    if tf is None:
        tf = _TF if _TF in reader.topics or not names else names[0]
    elif tf not in reader.topics:
        reader.topic(tf)  # raises an error that lists the topics
    topics = [name for name in dict.fromkeys((tf, f'{tf}_static', _TF_STATIC))
              if name in reader.topics]
    for name in topics:
        if reader.topic(name).msgtype != _TF_TYPE:
            raise DatasetError(f'{reader.path}: {name} is of type '
                               f'{reader.topic(name).msgtype}, not {_TF_TYPE}')
    return topics


def _sound(reader: BagReader, topic: str, message: Any, offset: Any, turn: Any
           ) -> tuple[float, ...] | None:
    """Return x, y, z, qx, qy, qz, qw of a pose; leave it out and return None if it is invalid."""
    numbers = (offset.x, offset.y, offset.z, turn.x, turn.y, turn.z, turn.w)
    if np.isfinite(numbers).all() and abs(math.hypot(*numbers[3:]) - 1.0) <= MAX_NORM_ERROR:
        return numbers
    reader.leave_out(topic, f'the pose at {bag_messages.stamp_ns(message) / NS_PER_S:.6f} s is '
                     'not finite or has no unit quaternion')
    return None


def _find_way(reader: BagReader, topics: Collection[str], map_frame: str, camera_frame: str
              ) -> tuple[dict[str, str], list[str], list[str]]:
    """Find the chain of tf frames between the map and the camera.

    Return the parent of each known frame, and the frames below the common ancestor, from the map
    and from the camera. Reading stops as soon as the two are connected.
    """
    parents: dict[str, str] = {}
    up, down = [map_frame], [camera_frame]
    for _, message in reader.readable(topics):
        count = len(parents)
        for transform in message.transforms:
            parents.setdefault(plain_name(transform.child_frame_id),
                               plain_name(transform.header.frame_id))
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
    """Return a frame and its ancestors up to the root; a loop ends the list."""
    way = [frame]
    while way[-1] in parents and parents[way[-1]] not in way:
        way.append(parents[way[-1]])
    return way


def _read_links(reader: BagReader, topics: Collection[str], children: Collection[str],
                parents: Mapping[str, str], max_gap_ns: int) -> dict[str, TimedPoses]:
    """Read the poses of frames in their parents, by frame; a static frame has its last pose."""
    # stamps and poses, by frame and by whether the topic is static
    samples: dict[tuple[str, bool], tuple[list[int], list[tuple[float, ...]]]] = {
        (child, is_static): ([], []) for child in children for is_static in (False, True)}
    for topic, recorded in reader.readable(topics):
        for message in recorded.transforms:
            child = plain_name(message.child_frame_id)
            if child not in children:
                continue
            if plain_name(message.header.frame_id) != parents[child]:
                raise DatasetError(
                    f"{reader.path}: tf: '{child}' has two parents, '{parents[child]}' and "
                    f"'{plain_name(message.header.frame_id)}'; record one tree of one robot")
            field = message.transform
            numbers = _sound(reader, topic, message, field.translation, field.rotation)
            if numbers is not None:
                stamps, rows = samples[child, topic.endswith('_static')]
                stamps.append(bag_messages.stamp_ns(message))
                rows.append(numbers)
    links: dict[str, TimedPoses] = {}
    for child in children:
        where = f"{reader.path}: tf of '{child}'"
        stamps, rows = samples[child, True]
        if stamps:
            links[child] = replace(TimedPoses.from_samples(stamps[-1:], rows[-1:], where),
                                   tolerance_ns=_ALWAYS_NS)
        else:
            stamps, rows = samples[child, False]
            check_forward(stamps, where)
            links[child] = replace(TimedPoses.from_samples(stamps, rows, where),
                                   max_gap_ns=max_gap_ns)
    return links


def _drift_notes(frame_id: str) -> list[str]:
    """Return a note if poses are in the coordinate frame of odometry."""
    return [f"the poses are in '{frame_id}': odometry drifts, and so does the map; run a "
            f'localizer or SLAM, and give its `map_frame`, or give `frame_id` {frame_id}'
            ] * ('odom' in frame_id.lower())


def _after_jumps(reader: BagReader, links: dict[str, TimedPoses], up: Sequence[str],
                 down: Sequence[str]) -> TransformChain:
    """Return the chain of links, without the poses before the last jump of a correction.

    If several links move, the first one from the map is a correction, such as map -> odom.
    """
    def chain(**changed: TimedPoses) -> TransformChain:
        found = {**links, **changed}
        return TransformChain(tuple(map(found.__getitem__, up)),
                              tuple(map(found.__getitem__, down)))
    child, *others = (*(child for child in (*up, *reversed(down))
                        if links[child].tolerance_ns < _ALWAYS_NS), '')
    if len(others) < 2:
        return chain()
    link, sizes = links[child], np.zeros((len(links[child]), 2))
    samples = np.hstack([link.positions_xyz, link.quats_xyzw])
    for row in (1 + np.nonzero(np.diff(samples, axis=0).any(axis=1))[0]).tolist():
        before, after = (chain(**{child: replace(
            link.part(at, at + 1), tolerance_ns=_ALWAYS_NS)}).pose_at(int(link.stamps_ns[row]))
            for at in (row - 1, row))
        if before is not None and after is not None:
            sizes[row] = pose_error(before, after)
    jumps = np.nonzero((sizes > np.maximum(_JUMP, _UNUSUAL * np.median(sizes, axis=0))
                        ).any(axis=1))[0].tolist()
    for row in jumps[-1:]:
        reader.notes.append(
            f"tf of '{child}' jumps by {sizes[row, 0]:.2f} m and {sizes[row, 1]:.1f} degrees at "
            f'{link.stamps_ns[row] / NS_PER_S:.2f} s: only the poses after it are used; record '
            'again with a localizer that has found its pose')
    return chain(**{child: link.part([0, *jumps][-1], len(link))})


def plain_name(frame_id: str) -> str:
    """Return the name of a coordinate frame as in tf2, without a leading slash."""
    return frame_id.removeprefix('/')


def bag_odometry(bag: Path, image_topic: str, source: PoseSource, camera_info: str = '') -> Poses:
    """Read the poses of a recording's camera in the odometry frame.

    DatasetError: the topic or tf is missing or invalid, or does not overlap the images in time.
    """
    with BagReader(bag) as reader:
        return poses_of_images(reader, image_topic, source, f'{bag}: odometry', camera_info)


def poses_of_images(reader: BagReader, image_topic: str, source: PoseSource, where: str,
                    camera_info: str) -> Poses:
    """Read the poses of the camera of an image topic.

    `camera_info` is the topic of the camera; '' or one that is missing: it is in its frame.

    DatasetError: the poses are missing or invalid, or do not overlap the images in time.
    """
    image = reader.first(image_topic)
    poses = source.read(reader, str(image.header.frame_id))
    first_ns = bag_messages.stamp_ns(image)
    check_clock(poses, first_ns, first_ns + reader.end_ns - reader.start_ns, where)
    beside = messages.camera_from_frame(reader.first(camera_info))[:3, 3] \
        if camera_info in reader.topics else np.zeros(3)
    mount = TimedPoses(np.zeros(1, np.int64), -beside[None], np.array([[0.0, 0.0, 0.0, 1.0]]),
                       tolerance_ns=_ALWAYS_NS)
    return TransformChain((), (mount,), poses) if beside.any() else poses

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera of a recording was: poses of a topic, or of its tf.

Each transform of the tf's chain is interpolated at the stamp on its own, as tf2 does. Beyond tf2,
a gap between two samples has a limit.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.bag_messages import stamp_ns
from cliploc_ros.offline.datasets.bags import BagReader
from cliploc_ros.offline.datasets.poses import Poses, TimedPoses

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
            stamps.append(stamp_ns(message))
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
            stamps.append(stamp_ns(message))
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

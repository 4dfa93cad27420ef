# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The tf of a recording: the pose of a coordinate frame in another one, at any stamp.

Each transform of the chain is interpolated at the stamp on its own, as tf2 does. Beyond tf2, a
gap between two samples has a limit.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.datasets.bag_messages import stamp_ns
from cliploc_ros.datasets.bag_reader import BagReader
from cliploc_ros.datasets.poses import make_trajectory
from cliploc_ros.datasets.trajectory import Trajectory
from cliploc_ros.errors import DatasetError

TF, TF_STATIC = '/tf', '/tf_static'
_TF_TYPE = 'tf2_msgs/msg/TFMessage'


class Edge(NamedTuple):
    """A coordinate frame in its parent over time; of a static transform, one sample."""

    parent_from_child: Trajectory
    is_static: bool


@dataclass(frozen=True)
class TransformChain:
    """The way between two coordinate frames through their common ancestor."""

    #: From the map up to the common ancestor, and from the camera up to it
    up: tuple[Edge, ...]
    down: tuple[Edge, ...]
    max_gap_ns: int  #: Greatest gap between two samples to interpolate over [ns]

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last stamp at which all of the chain is known [ns]."""
        moving = [edge.parent_from_child.stamps_ns for edge in (*self.up, *self.down)
                  if not edge.is_static]
        if not moving:
            return -2**63, 2**63 - 1
        return max(int(stamps[0]) for stamps in moving), min(int(stamps[-1]) for stamps in moving)

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp [ns]; None where it is not known."""
        ancestor_from_map = self._compose(self.up, stamp_ns)
        ancestor_from_camera = self._compose(self.down, stamp_ns)
        if ancestor_from_map is None or ancestor_from_camera is None:
            return None
        return np.asarray(invert_transform(ancestor_from_map) @ ancestor_from_camera)

    def _compose(self, edges: tuple[Edge, ...], stamp_ns: int) -> NDArray[np.float64] | None:
        ancestor_from_end = np.eye(4)
        for poses, is_static in edges:
            stamp = int(poses.stamps_ns[0]) if is_static else stamp_ns
            parent_from_child = poses.pose_at(stamp, self.max_gap_ns)
            if parent_from_child is None:
                return None
            ancestor_from_end = parent_from_child @ ancestor_from_end
        return ancestor_from_end


def read_transforms(reader: BagReader, map_frame: str, camera_frame: str, max_gap_ns: int
                    ) -> TransformChain:
    """Return how a camera moved in a map, from a recording's /tf and /tf_static.

    Parameters
    ----------
    map_frame, camera_frame : str
        Coordinate frames; the camera's is the optical one (z forward).
    max_gap_ns : int
        Greatest gap between two samples to interpolate over [ns].

    Raises
    ------
    DatasetError
        The recording has no tf, or nothing connects the two frames.
    """
    topics = [name for name in (TF, TF_STATIC) if name in reader.topics]
    for name in topics:
        if reader.topic(name).msgtype != _TF_TYPE:
            raise DatasetError(f'{reader.path}: {name} is of type {reader.topic(name).msgtype}, '
                               f'not {_TF_TYPE}')
    if not topics:
        raise DatasetError(f'{reader.path}: has neither {TF} nor {TF_STATIC}; record them, or '
                           'name a topic or file of poses')
    parents = _read_parents(reader, topics, map_frame, camera_frame)
    up, down = _find_way(parents, map_frame, camera_frame, reader)
    edges = _read_edges(reader, topics, {*up, *down}, parents)
    return TransformChain(tuple(edges[child] for child in up),
                          tuple(edges[child] for child in down), max_gap_ns)


def _read_parents(reader: BagReader, topics: Collection[str], map_frame: str, camera_frame: str
                  ) -> dict[str, str]:
    """Return the parent of each frame, read until it connects the two that count."""
    parents: dict[str, str] = {}
    for recorded in reader.messages(topics):
        count = len(parents)
        for transform in reader.deserialize(recorded).transforms:
            parents.setdefault(_name(transform.child_frame_id), _name(transform.header.frame_id))
        if len(parents) > count and (
                _ancestors(parents, map_frame)[-1] == _ancestors(parents, camera_frame)[-1]):
            break
    return parents


def _ancestors(parents: Mapping[str, str], frame: str) -> list[str]:
    """Return a frame and its ancestors, up to the root; a loop is cut."""
    way = [frame]
    while way[-1] in parents and parents[way[-1]] not in way:
        way.append(parents[way[-1]])
    return way


def _find_way(parents: Mapping[str, str], map_frame: str, camera_frame: str, reader: BagReader
              ) -> tuple[list[str], list[str]]:
    """Return the frames below the common ancestor: from the map up, and from the camera up."""
    up, down = _ancestors(parents, map_frame), _ancestors(parents, camera_frame)
    common = next((frame for frame in down if frame in up), None)
    if common is not None:
        return up[:up.index(common)], down[:down.index(common)]
    known = {*parents, *parents.values()}
    for frame in (map_frame, camera_frame):
        if frame not in known:
            raise DatasetError(f"{reader.path}: tf has no coordinate frame '{frame}'; it has "
                               f'{", ".join(sorted(known)) or "none"}')
    raise DatasetError(
        f"{reader.path}: tf does not connect '{map_frame}' and '{camera_frame}': their roots are "
        f"'{up[-1]}' and '{down[-1]}'; did the localizer run during the recording?")


def _read_edges(reader: BagReader, topics: Collection[str], children: Collection[str],
                parents: Mapping[str, str]) -> dict[str, Edge]:
    """Return parent from child over time, for some children; of a static one, the last."""
    samples: dict[str, tuple[list[int], list[tuple[float, ...]]]] = {
        child: ([], []) for child in children}
    static: dict[str, tuple[int, tuple[float, ...]]] = {}
    for recorded in reader.messages(topics):
        for transform in reader.deserialize(recorded).transforms:
            child = _name(transform.child_frame_id)
            if child not in samples:
                continue
            if _name(transform.header.frame_id) != parents[child]:
                raise DatasetError(
                    f"{reader.path}: tf: '{child}' has two parents, '{parents[child]}' and "
                    f"'{_name(transform.header.frame_id)}'; record one tree of one robot")
            stamp, row = stamp_ns(transform), _row(transform.transform)
            if recorded.topic == TF_STATIC:
                static[child] = stamp, row
            else:
                samples[child][0].append(stamp)
                samples[child][1].append(row)
    for child, (stamp, row) in static.items():
        samples[child] = [stamp], [row]
    return {child: Edge(make_trajectory(stamps, rows, f"{reader.path}: tf of '{child}'"),
                        child in static)
            for child, (stamps, rows) in samples.items()}


def _row(transform: Any) -> tuple[float, ...]:
    offset, turn = transform.translation, transform.rotation
    return offset.x, offset.y, offset.z, turn.x, turn.y, turn.z, turn.w


def _name(frame_id: str) -> str:
    return frame_id.removeprefix('/')

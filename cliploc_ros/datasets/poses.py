# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the camera was: poses of a recording's topic, of its tf, or of a trajectory file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.datasets.bag_messages import stamp_ns
from cliploc_ros.datasets.bag_reader import BagReader
from cliploc_ros.datasets.trajectory import Trajectory
from cliploc_ros.errors import DatasetError
from cliploc_ros.units import NS_PER_S

#: Where each type of message has its pose.
POSE_TYPES: dict[str, Callable[[Any], Any]] = {
    'geometry_msgs/msg/PoseStamped': lambda message: message.pose,
    'geometry_msgs/msg/PoseWithCovarianceStamped': lambda message: message.pose.pose,
    'nav_msgs/msg/Odometry': lambda message: message.pose.pose,
}
_MAX_NORM_ERROR = 0.01
# A clock that is off by less than this is a late start of the recording, not another clock.
_OTHER_CLOCK_S = 60.0


class Poses(Protocol):
    """Something that knows the pose of a camera over time."""

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp [ns]; None where it is not known."""

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last stamp with a pose [ns]; None without any."""


@dataclass(frozen=True)
class TrajectoryPoses:
    """Poses of a body on which the camera is mounted."""

    trajectory: Trajectory
    #: Greatest gap between two samples to interpolate over [ns]. One sample within 20 ms is always
    #: enough.
    max_gap_ns: int = 0
    #: (4, 4): the mount of the camera; None: the trajectory is the camera's own
    body_from_camera: NDArray[np.float64] | None = None

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """Return the first and last stamp with a pose [ns]; None without any."""
        stamps = self.trajectory.stamps_ns
        return (int(stamps[0]), int(stamps[-1])) if len(stamps) else None

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return ``map_from_camera`` (4, 4) at a stamp [ns]; None where it is not known."""
        pose = self.trajectory.pose_at(stamp_ns, self.max_gap_ns)
        if pose is None or self.body_from_camera is None:
            return pose
        return np.asarray(pose @ self.body_from_camera)


def read_pose_topic(reader: BagReader, name: str) -> Trajectory:
    """Return the poses of a topic of type PoseStamped, PoseWithCovarianceStamped or Odometry.

    Raises
    ------
    DatasetError
        The topic is missing, of another type, or a pose is invalid.
    """
    pose_of = POSE_TYPES.get(reader.topic(name).msgtype)
    if pose_of is None:
        raise DatasetError(f'{reader.path}: {name} is of type {reader.topic(name).msgtype}, not '
                           f'{" or ".join(POSE_TYPES)}')
    stamps, rows = [], []
    for recorded in reader.messages([name]):
        message = reader.deserialize(recorded)
        pose = pose_of(message)
        stamps.append(stamp_ns(message))
        position = pose.position
        orientation = pose.orientation
        numbers = (position.x, position.y, position.z,
                   orientation.x, orientation.y, orientation.z, orientation.w)
        rows.append(numbers)
    return make_trajectory(stamps, rows, f'{reader.path}: {name}')


def make_trajectory(stamps_ns: Sequence[int], rows: Sequence[Sequence[float]], where: str
                    ) -> Trajectory:
    """Return a trajectory of unsorted samples (x, y, z, qx, qy, qz, qw).

    Raises
    ------
    DatasetError
        A sample is not finite or has no unit quaternion.
    """
    order = np.unique(np.array(stamps_ns, dtype=np.int64), return_index=True)[1]
    samples = np.array(rows, dtype=np.float64).reshape(-1, 7)[order]
    norms = np.linalg.norm(samples[:, 3:], axis=1)
    with np.errstate(invalid='ignore'):
        sound = np.isfinite(samples).all(axis=1) & (np.abs(norms - 1.0) < _MAX_NORM_ERROR)
    if not sound.all():
        raise DatasetError(f'{where}: {int((~sound).sum())} of {len(sound)} poses are not finite '
                           'or have no unit quaternion')
    return Trajectory(np.array(stamps_ns, dtype=np.int64)[order], samples[:, :3],
                      samples[:, 3:] / norms[:, None])


def mount_from_numbers(numbers: Sequence[float]) -> NDArray[np.float64]:
    """Return a mount (4, 4) given as x y z [m] and a quaternion qx qy qz qw.

    Raises
    ------
    DatasetError
        The quaternion is far from unit.
    """
    norm = float(np.linalg.norm(numbers[3:]))
    if not (np.isfinite(numbers).all() and abs(norm - 1.0) < _MAX_NORM_ERROR):
        raise DatasetError(f'mount {list(numbers)}: needs x y z and a unit quaternion '
                           'qx qy qz qw')
    return transform_from_pose(np.array(numbers[:3]), np.array(numbers[3:]) / norm)


def check_clock(poses: Poses, first_ns: int, last_ns: int, where: str) -> None:
    """Refuse poses that do not overlap the time of the images.

    Raises
    ------
    DatasetError
        There are no poses, or they are of another time; says by how much.
    """
    span = poses.span_ns
    if span is None:
        raise DatasetError(f'{where}: there are no poses; name the topic, tf or file that has '
                           'them')
    if span[0] <= last_ns and first_ns <= span[1]:
        return
    gap_s = max(span[0] - last_ns, first_ns - span[1]) / NS_PER_S
    offset_s = (span[0] - first_ns) / NS_PER_S
    remedy = ('one of them uses another clock: record all of them with the same use_sim_time'
              if gap_s > _OTHER_CLOCK_S else 'record images and poses at the same time')
    raise DatasetError(
        f'{where}: images begin at {first_ns / NS_PER_S:.3f} s, poses at '
        f'{span[0] / NS_PER_S:.3f} s, {offset_s:+.3f} s apart, and do not overlap; {remedy}')

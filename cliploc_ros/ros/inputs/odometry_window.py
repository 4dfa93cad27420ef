# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The last seconds of odometry: where the robot was when an image was taken."""

from bisect import bisect_left
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.errors import CliplocError

_NS_PER_S = 1_000_000_000
_UNIT_TOLERANCE = 0.01
# No robot is so far from where it began; beyond, sums lose millimetres.
_FARTHEST_M = 1e7
# Between two messages further apart nobody knows how the robot moved: wheels take 20 ms, visual
# odometry 100.
_MAX_GAP_NS = _NS_PER_S // 2
# A message is not so late: the clock was set back.
_MAX_LATE_NS = _NS_PER_S
# A robot that seems faster did not move: its odometry was reset.
_MAX_SPEED_M_S = 20.0
_SLACK_M = 0.1
_MAX_TURN_RAD_S = 10.0
_SLACK_RAD = 0.1


class NoOdometryError(CliplocError):
    """Odometry says nothing of that time; the message says why."""


class _Pose(NamedTuple):
    stamp_ns: int
    position: NDArray[np.float64]
    quat_xyzw: NDArray[np.float64]


class OdometryWindow:
    """Stamped poses of odometry, in the order of their stamps, no more than some seconds of them.

    Parameters
    ----------
    length_s : float
        Older poses than this before the newest are forgotten [s].
    max_poses : int
        No more than so many are kept, whatever their stamps.
    """

    def __init__(self, length_s: float, max_poses: int = 5000) -> None:
        self._length_ns = round(length_s * _NS_PER_S)
        self._max_poses = max_poses
        self._poses: list[_Pose] = []
        #: Of which run of odometry the poses are: those of two runs have nothing in common.
        self.run = 0

    def __len__(self) -> int:
        """Return how many poses are kept."""
        return len(self._poses)

    def clear(self) -> None:
        """Forget all poses: those that come are of another run."""
        self._poses.clear()
        self.run += 1

    def is_ahead(self, stamp_ns: int) -> bool:
        """Return whether an instant lies so little behind the newest pose that one may follow."""
        return bool(self._poses) and 0 < stamp_ns - self._poses[-1].stamp_ns <= _MAX_GAP_NS

    def spans(self, stamp_ns: int, slack_ns: int) -> bool:
        """Return whether an instant lies among the poses, or so near them."""
        return bool(self._poses) and (self._poses[0].stamp_ns - slack_ns <= stamp_ns
                                      <= self._poses[-1].stamp_ns + slack_ns)

    def add(self, stamp_ns: int, position: NDArray[np.float64], quat_xyzw: NDArray[np.float64]
            ) -> bool:
        """Take a pose in, in its place; return whether it is one.

        All poses before are forgotten where time or place jumps: the clock was set back, or
        odometry was reset.

        Parameters
        ----------
        stamp_ns : int
        position : ndarray (3,)
            Of the robot in the odometry's frame [m].
        quat_xyzw : ndarray (4,)
        """
        values = np.concatenate([position, quat_xyzw])
        length = float(np.linalg.norm(quat_xyzw))
        if not np.isfinite(values).all() or abs(length - 1.0) > _UNIT_TOLERANCE \
                or np.abs(position).max() > _FARTHEST_M:
            return False
        pose = _Pose(stamp_ns, np.asarray(position, dtype=np.float64), quat_xyzw / length)
        poses = self._poses
        if poses and (stamp_ns < poses[-1].stamp_ns - _MAX_LATE_NS or _jumps(poses, pose)):
            self.clear()
        row = bisect_left(poses, stamp_ns, key=lambda one: one.stamp_ns)
        if row < len(poses) and poses[row].stamp_ns == stamp_ns:
            poses[row] = pose
        else:
            poses.insert(row, pose)
        oldest = poses[-1].stamp_ns - self._length_ns
        first = bisect_left(poses, oldest, key=lambda one: one.stamp_ns)
        del poses[:max(first, len(poses) - self._max_poses)]
        return True

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return the robot in the odometry's frame (4, 4) at an instant between two messages.

        Raises
        ------
        NoOdometryError
            The instant lies before or behind all poses, or in a gap between them.
        """
        row = bisect_left(self._poses, stamp_ns, key=lambda one: one.stamp_ns)
        if row < len(self._poses) and self._poses[row].stamp_ns == stamp_ns:
            same = self._poses[row]
            return make_transform(Rotation.from_quat(same.quat_xyzw).as_matrix(), same.position)
        if not self._poses:
            raise NoOdometryError('no odometry yet')
        if row == len(self._poses):
            late_s = (stamp_ns - self._poses[-1].stamp_ns) / _NS_PER_S
            raise NoOdometryError(f'the newest odometry is {late_s:.3f} s older than the image')
        if row == 0:
            early_s = (self._poses[0].stamp_ns - stamp_ns) / _NS_PER_S
            raise NoOdometryError(f'the oldest odometry is {early_s:.3f} s newer than the image')
        before, after = self._poses[row - 1], self._poses[row]
        gap_ns = after.stamp_ns - before.stamp_ns
        if gap_ns > _MAX_GAP_NS:
            raise NoOdometryError(f'odometry paused for {gap_ns / _NS_PER_S:.3f} s about the '
                                  'image')
        share = (stamp_ns - before.stamp_ns) / gap_ns
        turns = Slerp([0.0, 1.0], Rotation.from_quat([before.quat_xyzw, after.quat_xyzw]))
        return make_transform(turns(share).as_matrix(),
                              before.position + share * (after.position - before.position))


def _jumps(poses: list[_Pose], pose: _Pose) -> bool:
    """Tell whether a pose is too far from the one before it to have been reached."""
    newest = poses[-1]
    if pose.stamp_ns <= newest.stamp_ns:
        return False
    seconds = (pose.stamp_ns - newest.stamp_ns) / _NS_PER_S
    distance = float(np.linalg.norm(pose.position - newest.position))
    turned = 2.0 * np.arccos(min(1.0, abs(float(newest.quat_xyzw @ pose.quat_xyzw))))
    return bool(distance > _MAX_SPEED_M_S * seconds + _SLACK_M
                or turned > _MAX_TURN_RAD_S * seconds + _SLACK_RAD)

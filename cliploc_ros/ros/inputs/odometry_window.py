# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The last seconds of odometry: the robot's pose when an image was taken."""

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from cliploc_ros.core.geometry.tolerances import SAME_SPOT
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.errors import CliplocError
from cliploc_ros.units import NS_PER_S

_UNIT_TOLERANCE = 0.01
# No robot drives this far from its start; beyond, sums lose millimetres.
_FARTHEST_M = 1e7
# Poses further apart are not interpolated: wheels send every 20 ms, visual odometry every 100.
_MAX_GAP_NS = NS_PER_S // 2
# A message is never this late: time jumped back.
_MAX_LATE_NS = NS_PER_S
# A robot that seems faster than this did not move: its odometry was reset.
_MAX_SPEED_M_S = 20.0
_SLACK_M = 0.1
_MAX_TURN_RAD_S = 10.0
_SLACK_RAD = 0.1
# Odometry is silent after this many of its usual periods, or of a slow source's where it has just
# begun (guesses).
_MOST_PERIODS, _SLOW_NS = 3.0, NS_PER_S
#: Over a shorter time the noise of the poses would look like a speed.
MOMENT_NS = 300_000_000
#: Over a longer time a speed says little (a guess): slow sources send at 1 Hz.
LONG_NS = 3 * NS_PER_S
# A robot that stands seems to move by less: its way counts in longer steps.
_STEP_M = 0.02


class NoOdometryError(CliplocError):
    """Odometry has no pose at that time; the message says why."""


class _Pose(NamedTuple):
    stamp_ns: int
    position: NDArray[np.float64]
    quat_xyzw: NDArray[np.float64]
    way_m: float


class OdometryWindow:
    """Poses of odometry over some seconds, in the order of their stamps.

    Parameters
    ----------
    length_s : float
        Poses that are older than the newest by more than this are dropped [s].
    max_poses : int
        No more poses are kept, whatever their stamps.
    """

    def __init__(self, length_s: float, max_poses: int = 5000) -> None:
        self._length_ns = round(length_s * NS_PER_S)
        self._max_poses = max_poses
        self._poses: list[_Pose] = []
        # The way until the last step ended, and where.
        self._way_m, self._step_end = 0.0, np.zeros(3)
        #: The number of the present run of odometry: poses of two runs are not related.
        self.run = 0

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self._poses)

    def clear(self) -> None:
        """Forget all poses, and begin another run."""
        self._poses.clear()
        self._way_m = 0.0
        self.run += 1

    def is_ahead(self, stamp_ns: int) -> bool:
        """Return whether an instant is after all poses, but the next may cover it."""
        return bool(self._poses) and 0 < stamp_ns - self._poses[-1].stamp_ns <= _MAX_GAP_NS

    def spans(self, stamp_ns: int, slack_ns: int) -> bool:
        """Return whether an instant is between the first and the last pose, or so near to them."""
        return bool(self._poses) and (self._poses[0].stamp_ns - slack_ns <= stamp_ns
                                      <= self._poses[-1].stamp_ns + slack_ns)

    def since_previous_ns(self, stamp_ns: int) -> int:
        """Return how long before an instant the newest pose before it is; 0 if there is none."""
        row = bisect_left(self._poses, stamp_ns, key=lambda one: one.stamp_ns)
        return stamp_ns - self._poses[row - 1].stamp_ns if row else 0

    def add(self, stamp_ns: int, position: NDArray[np.float64], quat_xyzw: NDArray[np.float64]
            ) -> bool:
        """Take in a pose; return whether it is valid.

        If time or place jumps, all former poses are forgotten: the clock was set back, or
        odometry was reset, which a silence may hide.

        Parameters
        ----------
        position : ndarray (3,)
            Of the robot in odometry's coordinate frame [m].
        quat_xyzw : ndarray (4,)
        """
        values = np.concatenate([position, quat_xyzw])
        length = float(np.linalg.norm(quat_xyzw))
        if not np.isfinite(values).all() or abs(length - 1.0) > _UNIT_TOLERANCE \
                or np.abs(position).max() > _FARTHEST_M:
            return False
        pose = _Pose(stamp_ns, np.asarray(position, dtype=np.float64), quat_xyzw / length, 0.0)
        poses = self._poses
        if poses and (stamp_ns < poses[-1].stamp_ns - _MAX_LATE_NS or _jumps(poses, pose)):
            self.clear()
        row = bisect_left(poses, stamp_ns, key=lambda one: one.stamp_ns)
        pose = pose._replace(way_m=self._way_to(pose.position) if row == len(poses)
                             else poses[max(row - 1, 0)].way_m)
        if row < len(poses) and poses[row].stamp_ns == stamp_ns:
            poses[row] = pose
        else:
            poses.insert(row, pose)
        oldest = poses[-1].stamp_ns - self._length_ns
        first = bisect_left(poses, oldest, key=lambda one: one.stamp_ns)
        del poses[:max(first, len(poses) - self._max_poses)]
        return True

    def moved_since(self, stamp_ns: int) -> tuple[float, float] | None:
        """Return how far the newest pose is from the two about an instant, at most [m], [degrees].

        None where the instant is outside of all poses, or in a gap of more than 3 s.
        """
        if not self.spans(stamp_ns, 0):
            return None
        row = bisect_left(self._poses, stamp_ns, key=lambda one: one.stamp_ns)
        after, newest = self._poses[row], self._poses[-1]
        before = after if after.stamp_ns == stamp_ns else self._poses[row - 1]
        if after.stamp_ns - before.stamp_ns > LONG_NS:
            return None
        return (max(float(np.linalg.norm(newest.position - one.position))
                    for one in (before, after)),
                float(np.degrees(max(_turn_rad(newest, one) for one in (before, after)))))

    def way_at(self, stamp_ns: int) -> float:
        """Return the way driven since this run began until an instant [m], to a few centimetres.

        Its length, however near to its beginning it leads.
        """
        row = bisect_right(self._poses, stamp_ns, key=lambda one: one.stamp_ns)
        return self._poses[row - 1].way_m if row else 0.0

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return odom_from_robot (4, 4) at an instant, between two messages by interpolation.

        Raises
        ------
        NoOdometryError
            The instant is before or after all poses, or in a gap between them.
        """
        row = bisect_left(self._poses, stamp_ns, key=lambda one: one.stamp_ns)
        if row < len(self._poses) and self._poses[row].stamp_ns == stamp_ns:
            same = self._poses[row]
            return make_transform(Rotation.from_quat(same.quat_xyzw).as_matrix(), same.position)
        if not self._poses:
            raise NoOdometryError('no odometry yet')
        if row == len(self._poses):
            late_s = (stamp_ns - self._poses[-1].stamp_ns) / NS_PER_S
            raise NoOdometryError(f'the newest odometry is {late_s:.3f} s older than the image')
        if row == 0:
            early_s = (self._poses[0].stamp_ns - stamp_ns) / NS_PER_S
            raise NoOdometryError(f'the oldest odometry is {early_s:.3f} s newer than the image')
        before, after = self._poses[row - 1], self._poses[row]
        gap_ns = after.stamp_ns - before.stamp_ns
        if gap_ns > _MAX_GAP_NS:
            raise NoOdometryError(f'odometry paused for {gap_ns / NS_PER_S:.3f} s about the image')
        share = (stamp_ns - before.stamp_ns) / gap_ns
        turns = Slerp([0.0, 1.0], Rotation.from_quat([before.quat_xyzw, after.quat_xyzw]))
        return make_transform(turns(share).as_matrix(),
                              before.position + share * (after.position - before.position))

    def _way_to(self, position: NDArray[np.float64]) -> float:
        """Return the way until the newest pose."""
        if not self._poses:
            self._step_end = position
        step_m = float(np.linalg.norm(position - self._step_end))
        if step_m > _STEP_M:
            self._way_m, self._step_end = self._way_m + step_m, position
        return self._way_m


def _jumps(poses: Sequence[_Pose], pose: _Pose) -> bool:
    """Return whether a robot cannot have moved from the newest pose to this one."""
    newest = poses[-1]
    gap_ns = pose.stamp_ns - newest.stamp_ns
    if gap_ns <= 0:
        return False
    if _is_silence(poses, gap_ns):
        return not _goes_on(poses, pose)
    seconds = gap_ns / NS_PER_S
    distance_m = float(np.linalg.norm(pose.position - newest.position))
    return (distance_m > _MAX_SPEED_M_S * seconds + _SLACK_M
            or _turn_rad(newest, pose) > _MAX_TURN_RAD_S * seconds + _SLACK_RAD)


def _is_silence(poses: Sequence[_Pose], gap_ns: int) -> bool:
    """Return whether the next pose comes later than some lost messages explain."""
    if gap_ns <= _MAX_GAP_NS:
        return False
    period_ns = float(np.median(np.diff([one.stamp_ns for one in poses]))) \
        if len(poses) > 1 else _SLOW_NS
    return gap_ns > _MOST_PERIODS * period_ns


def _goes_on(poses: Sequence[_Pose], pose: _Pose) -> bool:
    """Return whether a pose after a silence is where the robot was, or on its way from there.

    Its driver may have begun anew at another origin, which a robot could have reached by driving.
    So it may have gone on as before or stopped, nothing else; after a long silence, it has to
    stand where it was.
    """
    newest = poses[-1]
    row = bisect_right(poses, newest.stamp_ns - MOMENT_NS, key=lambda one: one.stamp_ns)
    before = poses[max(row - 1, 0)]
    gap_ns, moment_ns = pose.stamp_ns - newest.stamp_ns, newest.stamp_ns - before.stamp_ns
    times = gap_ns / moment_ns if moment_ns and gap_ns <= LONG_NS else 0.0
    half_way = times / 2 * (newest.position - before.position)
    off_m = float(np.linalg.norm(pose.position - newest.position - half_way))
    most_rad = times * _turn_rad(before, newest) + np.radians(SAME_SPOT.angle_deg)
    return (off_m <= float(np.linalg.norm(half_way)) + SAME_SPOT.distance_m
            and _turn_rad(newest, pose) <= most_rad)


def _turn_rad(one: _Pose, other: _Pose) -> float:
    return float(2.0 * np.arccos(min(1.0, abs(float(one.quat_xyzw @ other.quat_xyzw)))))

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The topic `odom`: how fast the robot moves, and where its camera took each image."""

import math
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from scipy.spatial.transform import Rotation, Slerp

from cliploc_ros.core.geometry.transforms import SAME_SPOT, make_transform, pose_error
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.subscription import AdaptiveSubscription, Listener
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
# The boxes of a slow detector arrive long after their image was taken.
_LENGTH_S = 30.0
# The message that follows an image arrives within this time: wheels publish faster.
_PATIENCE_S = 0.2
# Odometry that ends or begins this close to an image may cover the next image.
_NEARLY_NS = 2_000_000_000
#: How long odometry that has just begun may take to show a speed [s]: a late answer is better than
#: taking a moving robot on a busy machine for one at rest.
MOMENT_PATIENCE_S = 2.0


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

        NoOdometryError: the instant is before or after all poses, or in a gap between them.
        """
        row = bisect_left(self._poses, stamp_ns, key=lambda one: one.stamp_ns)
        if row < len(self._poses) and self._poses[row].stamp_ns == stamp_ns:
            same = self._poses[row]
            return make_transform(Rotation.from_quat(same.quat_xyzw).as_matrix(), same.position)
        if not self._poses:
            raise NoOdometryError('no odometry yet')
        if row == len(self._poses):
            late_s = (stamp_ns - self._poses[-1].stamp_ns) / NS_PER_S
            raise NoOdometryError(f'the newest odometry is {late_s:.3f} s older than the image: '
                                  'stamp both by one clock')
        if row == 0:
            early_s = (self._poses[0].stamp_ns - stamp_ns) / NS_PER_S
            raise NoOdometryError(f'the oldest odometry is {early_s:.3f} s newer than the image: '
                                  'stamp both by one clock')
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

    Its driver may have restarted at another origin, which a robot could have reached by driving.
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


class BodyPose(NamedTuple):
    """Where odometry had the robot at the stamp of an image."""

    odom_from_body: NDArray[np.float64]
    #: The coordinate frame that odometry tracks (child_frame_id).
    body_frame: str
    #: Poses of one run share their odometry frame; those of different runs do not compare.
    run: int
    #: Driven since the run began.
    way_m: float


class OdometrySource(Listener):
    """Subscribes to odometry while the node is active: it costs little, and links frames."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._heard = threading.Condition()
        self._window = OdometryWindow(_LENGTH_S)
        self._newest: Odometry | None = None
        self._newest_at = 0.0
        self._frames = ('', '')
        self._on_restart: list[Callable[[int], None]] = []

    @property
    def topic(self) -> str:
        """Return the resolved name of the topic."""
        return str(self._node.resolve_topic_name('odom'))

    @property
    def is_published(self) -> bool:
        """Return whether the topic has a publisher."""
        return bool(self._node.count_publishers(self.topic))

    def on_restart(self, callback: Callable[[int], None]) -> None:
        """Have each restart of odometry reported: its poses are not related to those before.

        The callback takes the stamp of the first message after the restart [ns], in the thread
        that takes odometry; it must not block. What this node itself forgets is not reported.
        """
        self._on_restart.append(callback)

    def open(self) -> None:
        """Subscribe."""
        self._subscription = AdaptiveSubscription(self._node, Odometry, 'odom', self.take,
                                                  qos.ODOM)

    def forget(self) -> None:
        """Forget what was heard: poses that follow belong to another run."""
        with self._heard:
            self._newest = None
            self._window.clear()

    def take(self, msg: Odometry) -> None:
        """Take one message."""
        p, q = msg.pose.pose.position, msg.pose.pose.orientation
        at_ns = stamp_ns(msg.header.stamp)
        with self._heard:
            run, had_poses = self._window.run, bool(len(self._window))
            self._newest, self._newest_at = msg, time.monotonic()
            frames = (msg.header.frame_id, msg.child_frame_id)
            if frames != self._frames:
                self._window.clear()
                self._frames = frames
            self._window.add(at_ns, np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
            has_restarted = had_poses and self._window.run != run
            self._heard.notify_all()
        if has_restarted:
            self._node.get_logger().warning(
                f'{self.topic} restarted, for its time, place or frames jumped: all poses from '
                'before are forgotten', throttle_duration_sec=5.0)
            for callback in self._on_restart:
                callback(at_ns)

    def recent(self, max_age_s: float, patience_s: float) -> Odometry | None:
        """Return the newest message, if it is not older than `max_age_s` by its arrival.

        Else the next one if that arrives within `patience_s`, else None; at once where nobody
        publishes odometry.
        """
        def is_recent() -> bool:
            return (self._newest is not None
                    and time.monotonic() - self._newest_at <= max_age_s)
        with self._heard:
            if self.is_published:
                self._heard.wait_for(is_recent, patience_s)
            return self._newest if is_recent() else None

    def speeds_by_poses(self, patience_s: float) -> tuple[float, float] | None:
        """Return speed [m/s] and turn rate [rad/s] over the last 0.3 s of poses.

        Many sources of poses leave the twist empty. Where the last two poses are further apart,
        up to 3 s, it is the mean speed between them. Odometry that has just begun may take
        `patience_s`, at most 2 s, to cover that time; None where it does not, or where the
        stamps stand still.
        """
        with self._heard:
            self._heard.wait_for(lambda: self._last_moment() is not None,
                                 min(patience_s, MOMENT_PATIENCE_S))
            moment = self._last_moment()
        if moment is None:
            return None
        before, now, seconds = moment
        distance_m, angle_deg = pose_error(before, now)
        return distance_m / seconds, math.radians(angle_deg) / seconds

    def _last_moment(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
        """Return the robot's poses a moment ago and now, and the time between them [s].

        None where the poses are not known.
        """
        if self._newest is None:
            return None
        now_ns = stamp_ns(self._newest.header.stamp)
        step_ns = self._window.since_previous_ns(now_ns)
        moment_ns = step_ns if MOMENT_NS < step_ns <= LONG_NS else MOMENT_NS
        try:
            return (self._window.pose_at(now_ns - moment_ns), self._window.pose_at(now_ns),
                    moment_ns / NS_PER_S)
        except NoOdometryError:
            return None

    def moved_since(self, stamp: Time, patience_s: float) -> tuple[float, float] | None:
        """Return how far the robot is from where it was at an image, at most [m], [degrees].

        Waits for the message that follows the image. None where odometry does not cover that
        time, or has a gap of more than 3 s there.
        """
        at_ns = stamp_ns(stamp)
        with self._heard:
            self._heard.wait_for(lambda: self._window.spans(at_ns, 0), patience_s)
            return self._window.moved_since(at_ns)

    def covers_soon(self, stamp: Time, patience_s: float) -> bool:
        """Return whether odometry covers about the time of an image, and so of the next.

        A publisher that has just been discovered may take `patience_s` for its first message.
        """
        at_ns = stamp_ns(stamp)
        with self._heard:
            if self.is_published:
                self._heard.wait_for(lambda: len(self._window), patience_s)
            return self._window.spans(at_ns, _NEARLY_NS)

    def pose_at(self, stamp: Time) -> BodyPose:
        """Return where odometry had the robot at the stamp of an image.

        NoOdometryError: odometry does not cover that time.
        """
        at_ns = stamp_ns(stamp)
        with self._heard:
            if self._window.is_ahead(at_ns):
                self._heard.wait_for(lambda: not self._window.is_ahead(at_ns), _PATIENCE_S)
            odom_from_body = self._window.pose_at(at_ns)
            run, body_frame = self._window.run, self._frames[1]
            way_m = self._window.way_at(at_ns)
        if not body_frame:
            raise NoOdometryError(f'{self.topic} has no child_frame_id')
        return BodyPose(odom_from_body, body_frame, run, way_m)

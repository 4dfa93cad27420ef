# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The topic `odom`: the speed of the robot, and the motion of its camera between images."""

import math
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node

from cliploc_ros.core.geometry import transforms
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.stamps import stamp_problem
from cliploc_ros.units import NS_PER_S

_UNIT_TOLERANCE = 0.01
# Greatest distance from the start [m]; beyond it, sums lose millimetres.
_FARTHEST_M = 1e7
# Poses further apart are not interpolated. Wheel odometry publishes every 20 ms, visual odometry
# every 100 ms.
_MAX_GAP_NS = NS_PER_S // 2
# A message this late, or more late messages in a row than this, means that time was set back.
_MAX_LATE_NS, _MOST_LATE = NS_PER_S, 5
# Tolerance of moves [m] and turns [rad]: slipping wheels, pose noise and stamps cause less.
_SLACK = np.array([transforms.SAME_SPOT.distance_m, np.radians(transforms.SAME_SPOT.angle_deg)])
# Greatest speeds of a robot of unknown speed [m/s], [rad/s]; greatest accelerations [m/s^2],
# [rad/s^2]; longest time of an acceleration [s]. Not measured. With these values no run of a Husky
# is cut at 5 Hz or more, see python -m studies.sensors.
_FASTEST, _CHANGE, _CHANGE_S = np.array([3.0, 3.0]), np.array([3.0, 8.0]), 0.5
# A gap of more than this many usual periods is a silence. The period of odometry that has just
# begun is unknown, and taken to be that of a slow source. Not measured.
_MOST_PERIODS, _SLOW_NS = 3.25, NS_PER_S
#: Least time between the poses of a speed: over less, their noise looks like motion.
MOMENT_NS = 300_000_000
#: Greatest time between the poses of a speed: slow sources publish at 1 Hz. Not measured.
LONG_NS = 3 * NS_PER_S
# Least step of the driven distance, above the apparent motion of a robot at rest.
_STEP_M = 0.02
# Length of the window: boxes of a slow detector arrive long after their image was taken.
_LENGTH_S = 30.0
# Longest wait for the message that follows an image: wheel odometry publishes faster.
_PATIENCE_S = 0.2
# Odometry that ends or begins this close to an image may cover the next image.
_NEARLY_NS = 2_000_000_000
#: Longest wait for odometry that has just begun to show a speed [s]. On a busy machine, a late
#: answer is better than to assume that a moving robot is at rest.
MOMENT_PATIENCE_S = 2.0


class NoOdometryError(CliplocError):
    """Odometry has no pose at the given time; the message says why."""


class _Pose(NamedTuple):
    stamp_ns: int
    odom_from_body: NDArray[np.float64]  #: (4, 4)
    way_m: float = 0.0


class OdometryWindow:
    """Poses of odometry over some seconds, ordered by stamp.

    Parameters
    ----------
    length_s : float
        Poses that are older than the newest by more than this are dropped [s].
    max_poses : int
        Greatest number of poses, regardless of their stamps.
    """

    def __init__(self, length_s: float, max_poses: int = 5000) -> None:
        self._length_ns = round(length_s * NS_PER_S)
        self._max_poses = max_poses
        self._poses: list[_Pose] = []
        # Driven distance [m], and the position where its last step ended.
        self._way_m, self._step_end = 0.0, np.zeros(3)
        # Number of successive messages that are older than the newest.
        self._late = 0
        #: Number of the current run of odometry. Poses of different runs are not related.
        self.run = 0

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self._poses)

    def clear(self) -> None:
        """Forget all poses, and begin a new run."""
        self._poses.clear()
        self._way_m, self._late = 0.0, 0
        self.run += 1

    def is_ahead(self, stamp_ns: int) -> bool:
        """Return whether an instant is after all poses, but the next pose may cover it."""
        return bool(self._poses) and 0 < stamp_ns - self._poses[-1].stamp_ns <= _MAX_GAP_NS

    def spans(self, stamp_ns: int, slack_ns: int) -> bool:
        """Return whether an instant is in the window, extended by `slack_ns` at both ends."""
        return bool(self._poses) and (self._poses[0].stamp_ns - slack_ns <= stamp_ns
                                      <= self._poses[-1].stamp_ns + slack_ns)

    def since_previous_ns(self, stamp_ns: int) -> int:
        """Return the time from the last pose before an instant to it [ns]; 0 without a pose."""
        row = bisect_left(self._poses, stamp_ns, key=_stamp_of)
        return stamp_ns - self._poses[row - 1].stamp_ns if row else 0

    def add(self, stamp_ns: int, position: NDArray[np.float64], quat_xyzw: NDArray[np.float64]
            ) -> bool:
        """Add a pose; return whether it is valid.

        If the stamp or the position jumps, all earlier poses are forgotten: the clock was set
        back, or odometry was reset, possibly during a gap.

        Parameters
        ----------
        position : ndarray (3,)
            Position of the robot in odometry's coordinate frame [m].
        quat_xyzw : ndarray (4,)
            Its orientation, as odom_from_robot.
        """
        values = np.concatenate([position, quat_xyzw])
        length = float(np.linalg.norm(quat_xyzw))
        if not np.isfinite(values).all() or abs(length - 1.0) > _UNIT_TOLERANCE \
                or np.abs(position).max() > _FARTHEST_M:
            return False
        pose = _Pose(stamp_ns, transforms.transform_from_pose(position, quat_xyzw))
        poses = self._poses
        self._late = self._late + 1 if poses and stamp_ns < poses[-1].stamp_ns else 0
        row = bisect_left(poses, stamp_ns, key=_stamp_of)
        if poses and (self._late > _MOST_LATE or stamp_ns < poses[-1].stamp_ns - _MAX_LATE_NS
                      or not self._fits(pose, row)):
            self.clear()
            row = 0
        if row < len(poses) and poses[row].stamp_ns == stamp_ns:
            return True
        if not poses:
            self._step_end = position
        step_m = float(np.linalg.norm(position - self._step_end))
        if row == len(poses) and step_m > _STEP_M:
            self._way_m, self._step_end = self._way_m + step_m, position
        poses.insert(row, pose._replace(way_m=self._way_m if row == len(poses) else
                                        poses[max(row - 1, 0)].way_m))
        oldest = poses[-1].stamp_ns - self._length_ns
        first = bisect_left(poses, oldest, key=_stamp_of)
        del poses[:max(first, len(poses) - self._max_poses)]
        return True

    def moved_since(self, stamp_ns: int) -> tuple[float, float] | None:
        """Return the motion since an instant, as upper bounds [m], [degrees].

        The bounds are the greater distances of the newest pose to the two poses around the
        instant. None if the instant is before or after all poses, or in a gap of more than 3 s.
        """
        if not self.spans(stamp_ns, 0):
            return None
        row = bisect_left(self._poses, stamp_ns, key=_stamp_of)
        after, newest = self._poses[row], self._poses[-1]
        before = after if after.stamp_ns == stamp_ns else self._poses[row - 1]
        if after.stamp_ns - before.stamp_ns > LONG_NS:
            return None
        ways = [_lengths(_step(newest, pose)) for pose in (before, after)]
        return float(max(way[0] for way in ways)), math.degrees(max(way[1] for way in ways))

    def way_at(self, stamp_ns: int) -> float:
        """Return the distance driven from the start of this run to an instant [m].

        It is the length of the path, exact to a few centimetres.
        """
        row = bisect_right(self._poses, stamp_ns, key=_stamp_of)
        return self._poses[row - 1].way_m if row else 0.0

    def pose_at(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return odom_from_robot (4, 4) at an instant, interpolated between messages.

        NoOdometryError: the instant is before or after all poses, or in a gap between them.
        """
        row = bisect_left(self._poses, stamp_ns, key=_stamp_of)
        if row < len(self._poses) and self._poses[row].stamp_ns == stamp_ns:
            return self._poses[row].odom_from_body
        if not self._poses:
            raise NoOdometryError('no odometry yet')
        if row == len(self._poses):
            late_s = (stamp_ns - self._poses[-1].stamp_ns) / NS_PER_S
            raise NoOdometryError(f'the newest odometry is {late_s:.3f} s older than the image: '
                                  'stamp both by the same clock')
        if row == 0:
            early_s = (self._poses[0].stamp_ns - stamp_ns) / NS_PER_S
            raise NoOdometryError(f'the oldest odometry is {early_s:.3f} s newer than the image: '
                                  'stamp both by the same clock')
        before, after = self._poses[row - 1], self._poses[row]
        gap_ns = after.stamp_ns - before.stamp_ns
        if gap_ns > _MAX_GAP_NS:
            raise NoOdometryError(f'odometry has a gap of {gap_ns / NS_PER_S:.3f} s at the image')
        share = (stamp_ns - before.stamp_ns) / gap_ns
        first, last = before.odom_from_body, after.odom_from_body
        turn = share * _step(before, after)[1]
        return transforms.make_transform(
            first[:3, :3] @ cv2.Rodrigues(turn)[0],
            first[:3, 3] + share * (last[:3, 3] - first[:3, 3]))

    def _fits(self, pose: _Pose, row: int) -> bool:
        """Return whether a robot could move through a pose that is inserted at a row."""
        poses = self._poses
        if row < len(poses) and poses[row].stamp_ns == pose.stamp_ns:
            return bool((_lengths(_step(poses[row], pose)) <= _SLACK).all())
        before = poses[:row]
        return (not before or _is_explained(before, pose)) and (
            row == len(poses) or _is_explained([*before, pose], poses[row]))


def _stamp_of(pose: _Pose) -> int:
    return pose.stamp_ns


def _step(before: _Pose, after: _Pose) -> NDArray[np.float64]:
    """Return move and turn (2, 3) between two poses, in the robot's frame at the first pose."""
    first, last = before.odom_from_body, after.odom_from_body
    back = first[:3, :3].T
    return np.array([back @ (last[:3, 3] - first[:3, 3]),
                     cv2.Rodrigues(back @ last[:3, :3])[0].ravel()])


def _lengths(step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths (2,) of a move and a turn (2, 3)."""
    return np.array([math.hypot(*step[0]), math.hypot(*step[1])])


def _is_explained(poses: Sequence[_Pose], pose: _Pose) -> bool:
    """Return whether a robot can have moved from the newest of `poses` to a later pose.

    The robot is expected to continue at the speed of its poses, or to stop. Twists are not used,
    because many drivers leave them empty or fill them with other values. After a silence the
    driver may have restarted at another origin that the robot could also have reached by driving,
    so no acceleration is allowed. After a long silence, the robot must not have moved.
    """
    newest, at_rest = poses[-1], np.zeros((2, 3))
    gap_ns = pose.stamp_ns - newest.stamp_ns
    gap_s = gap_ns / NS_PER_S
    row = bisect_right(poses, newest.stamp_ns - MOMENT_NS, key=_stamp_of)
    before = poses[max(row - 1, 0)]
    moment_s = (newest.stamp_ns - before.stamp_ns) / NS_PER_S
    speed = -_step(newest, before) / moment_s if moment_s else at_rest
    slack = _CHANGE * gap_s * min((moment_s + gap_s) / 2, _CHANGE_S)
    period_ns = float(_SLOW_NS)
    if gap_ns > _MAX_GAP_NS and len(poses) > 1:
        period_ns = float(np.median(np.diff([each.stamp_ns for each in poses])))
    if gap_ns > max(_MAX_GAP_NS, _MOST_PERIODS * period_ns):  # more than a few lost messages
        slack, speed = np.zeros(2), speed if gap_ns <= LONG_NS else at_rest
    elif not row:  # the run has just begun: its poses are too close in time for a speed
        slack, speed = _FASTEST * gap_s, at_rest
    move, turn = gap_s * speed
    # the speed is that of half of both times ago, in the frame of that moment
    heading = cv2.Rodrigues((moment_s + gap_s) / 2 * speed[1])[0]
    ahead = np.array([heading @ move, turn])
    # move and turn lie in balls, with rest and constant speed at the ends of their diameters
    return bool((_lengths(_step(newest, pose) - ahead / 2)
                 <= _lengths(ahead) / 2 + _SLACK + slack).all())


class OdometryPlace(NamedTuple):
    """Pose of the robot, or its camera, by odometry at the stamp of an image."""

    odom_from_frame: NDArray[np.float64]  #: (4, 4)
    #: Number of the run of odometry. Poses of different runs are not comparable.
    run: int
    way_m: float  #: Distance driven since the run began
    frame: str = ''  #: The coordinate frame whose pose this is


class OdometrySource(qos.Listener):
    """Subscribes to odometry while the node is active. Odometry is cheap, and links frames."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._heard = threading.Condition()
        self._window = OdometryWindow(_LENGTH_S)
        self._newest: Odometry | None = None
        self._newest_at = 0.0
        self._frames = ('', '')
        #: Fault of the newest message's stamp, and the remedy; empty if the stamp is valid.
        self.problem = ''
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
        """Register a callback for restarts of odometry, after which poses are not comparable.

        It is called with the stamp of the first message after the restart [ns], in the thread
        that receives odometry. It must not block. It is not called for forget() and close().
        """
        self._on_restart.append(callback)

    def open(self) -> None:
        """Subscribe."""
        self._subscription = qos.AdaptiveSubscription(self._node, Odometry, 'odom', self.take,
                                                  qos.ODOM)

    def forget(self) -> None:
        """Forget all messages; later poses belong to a new run."""
        with self._heard:
            self._newest, self.problem = None, ''
            self._window.clear()

    def take(self, msg: Odometry) -> None:
        """Process a message."""
        p, q = msg.pose.pose.position, msg.pose.pose.orientation
        at_ns = stamp_ns(msg.header.stamp)
        with self._heard:
            run, had_poses = self._window.run, bool(len(self._window))
            self._newest, self._newest_at = msg, time.monotonic()
            frames = (msg.header.frame_id, msg.child_frame_id)
            if frames != self._frames:
                self._window.clear()
                self._frames = frames
            why = stamp_problem(msg.header.stamp)
            self.problem = why and \
                f'the stamp of {self.topic} {why}: its driver must stamp each pose'
            if not why:
                self._window.add(at_ns, np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]))
            has_restarted = had_poses and self._window.run != run
            self._heard.notify_all()
        if has_restarted:
            self._node.get_logger().warning(
                f'{self.topic} restarted: its stamp, position or frames jumped; all earlier poses '
                'are forgotten', throttle_duration_sec=5.0)
            for callback in self._on_restart:
                callback(at_ns)

    def recent(self, max_age_s: float, patience_s: float) -> Odometry | None:
        """Return the newest message if it arrived at most `max_age_s` ago.

        Otherwise wait up to `patience_s` for the next message; None if there is none. Does not
        wait if odometry has no publisher.
        """
        def is_recent() -> bool:
            return (self._newest is not None and time.monotonic() - self._newest_at <= max_age_s)
        with self._heard:
            if self.is_published:
                self._heard.wait_for(is_recent, patience_s)
            return self._newest if is_recent() else None

    def speeds_by_poses(self, patience_s: float) -> tuple[float, float] | None:
        """Return speed [m/s] and turn rate [rad/s] over the last 0.3 s of poses.

        Many sources of poses leave the twist empty. If the last two poses are further apart, up
        to 3 s, the result is the mean speed between them. Waits up to `patience_s`, at most 2 s,
        for odometry that has just begun. None if odometry does not cover the time, or if the
        stamps do not advance.
        """
        with self._heard:
            self._heard.wait_for(lambda: self._last_moment() is not None,
                                 min(patience_s, MOMENT_PATIENCE_S))
            moment = self._last_moment()
        if moment is None:
            return None
        before, now, seconds = moment
        distance_m, angle_deg = transforms.pose_error(before, now)
        return distance_m / seconds, math.radians(angle_deg) / seconds

    def _last_moment(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float] | None:
        """Return the robot's poses a moment ago and now, and the time between them [s].

        None if the poses are unknown.
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
        """Return the motion since the stamp of an image, as upper bounds [m], [degrees].

        Waits for the message that follows the image. None if odometry does not cover that
        time, or has a gap of more than 3 s there.
        """
        at_ns = stamp_ns(stamp)
        with self._heard:
            self._heard.wait_for(lambda: self._window.spans(at_ns, 0), patience_s)
            return self._window.moved_since(at_ns)

    def motion(self, since: Time, until: Time, patience_s: float
               ) -> tuple[NDArray[np.float64], str]:
        """Return the motion between two stamps as since_from_until (4, 4), and the moving frame.

        Waits up to `patience_s` for the message that follows the stamps.

        NoOdometryError: odometry does not cover both stamps.
        """
        first_ns, last_ns = stamp_ns(since), stamp_ns(until)
        with self._heard:
            self._heard.wait_for(lambda: not self._window.is_ahead(max(first_ns, last_ns)),
                                 patience_s)
            first, last = self._window.pose_at(first_ns), self._window.pose_at(last_ns)
            return transforms.invert_transform(first) @ last, self._frames[1]

    def covers_soon(self, stamp: Time, patience_s: float) -> bool:
        """Return whether odometry covers roughly the stamp of an image, and so the next image.

        Waits up to `patience_s` for the first message of a publisher.
        """
        at_ns = stamp_ns(stamp)
        with self._heard:
            if self.is_published:
                self._heard.wait_for(lambda: len(self._window), patience_s)
            return self._window.spans(at_ns, _NEARLY_NS)

    def pose_at(self, stamp: Time) -> OdometryPlace:
        """Return the robot's pose by odometry at the stamp of an image.

        NoOdometryError: odometry does not cover that time.
        """
        at_ns = stamp_ns(stamp)
        with self._heard:
            if self._window.is_ahead(at_ns):
                self._heard.wait_for(lambda: not self._window.is_ahead(at_ns), _PATIENCE_S)
            if self.problem:
                raise NoOdometryError(self.problem)
            place = OdometryPlace(self._window.pose_at(at_ns), self._window.run,
                                  self._window.way_at(at_ns), self._frames[1])
        if not place.frame:
            raise NoOdometryError(f'{self.topic} has no child_frame_id')
        return place

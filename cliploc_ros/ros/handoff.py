# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Hand an accepted pose over to the running localizer, while the robot is at rest."""

import math
import threading
import time
from collections.abc import Mapping
from copy import deepcopy

import numpy as np
from builtin_interfaces.msg import Time as Stamp
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.time import Time
from std_srvs.srv import Empty

from cliploc_ros.core.geometry.transforms import SAME_SPOT, invert_transform
from cliploc_ros.errors import CliplocError, HandOffError, NoLocalizerError
from cliploc_ros.ros.conversions import pose_from_msg, pose_to_msg, stamp_ns
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames
from cliploc_ros.ros.inputs.odometry import MOMENT_PATIENCE_S, OdometrySource
from cliploc_ros.ros.inputs.stamps import TimeJumps
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.ros.receivers import Floors, RunningLocalizer, difference

# Least variances of x, y, z [m^2] and of the rotations [rad^2]: a centimetre and a sixth of a
# degree. AMCL draws its particles from x, y and yaw; with zero variance they would coincide.
_MIN_VARIANCES = (1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5)
# Greatest age of odometry of a robot at rest: slow sources send at 1 Hz. Not measured.
_MAX_ODOM_AGE_S = 2.0
# Longest wait for the first message of odometry that has a publisher, including discovery.
_ODOM_PATIENCE_S = 2.0
# Longest wait for odometry at the pose of the localizer, whose scan may be newer.
_CARRY_S = 0.2
_POLL_S = 0.1
# AMCL publishes a new pose after its next scan. If it has not by then, initialpose was lost.
_REPEAT_S = 1.0
# With less time left, the localizer could not publish the pose even if it took it.
_LEAST_S = 0.5
# AMCL updates with its next scan; two calls before that scan count as one. Laser scanners usually
# publish at 5 Hz or more.
_UPDATE_PERIOD_S = 0.2
_UPDATE_PATIENCE_S = 2.0
# With several floors, the greatest age of an image: a lift takes longer to close its doors, ride,
# and open them. Chosen.
_LIFT_S = 5.0


class HandOff:
    """Publishes `initialpose` for a robot at rest, and lets its localizer converge.

    `odometry` must be open: it detects motion of the robot. `transforms` looks up its frame.
    """

    def __init__(self, node: Node, odometry: OdometrySource, transforms: CoordinateFrames) -> None:
        self._node, self._odometry, self._transforms = node, odometry, transforms
        #: The localizer that takes the poses
        self.localizer = RunningLocalizer(node, transforms)
        self._base_frame = ''
        self._stopped = threading.Event()
        #: The grid of Nav2
        self.floors = Floors(node, self._stopped)
        self._updater = node.create_client(Empty, 'request_nomotion_update',
                                           callback_group=ReentrantCallbackGroup())

    def open(self, parameters: RelocalizerParameters) -> None:
        """Allow hand-overs, and look for the localizer."""
        self._stopped.clear()
        self.localizer.open(parameters)

    def close(self) -> None:
        """Abort the current hand-over, and unsubscribe from the localizer's pose."""
        self.stop()
        self.localizer.close()

    def stop(self) -> None:
        """Abort the current hand-over."""
        self._stopped.set()
        with self.localizer.changed:
            self.localizer.changed.notify_all()

    def hand_over(self, pose: PoseWithCovarianceStamped, parameters: RelocalizerParameters,
                  deadline: float, received_at: float, jumps: TimeJumps,
                  grids: Mapping[str, str]) -> None:
        """Publish a pose on `initialpose` until the localizer takes it, and let it converge.

        The localizer has taken the pose when it publishes a pose that agrees, after odometry has
        carried the given pose to its stamp. `initialpose` is then not repeated. The localizer must
        still run after it has converged: it answers each update or publishes another pose, and its
        topics exist at the end.

        Parameters
        ----------
        pose : PoseWithCovarianceStamped
            Accepted, in the map's coordinate frame, with the image's stamp.
        deadline, received_at : float
            When to return at the latest, and when the image arrived (monotonic clock) [s]. If
            nothing needs to be waited for, the pose is published even after the deadline.
        jumps : TimeJumps
            Time jumps of the node's clock.
        grids : mapping
            File of Nav2's grid of each map, which is loaded first; empty: one floor.

        Raises
        ------
        HandOffError
            The robot moves or may be moving, or it has moved since the image.
        NoLocalizerError
            There is no localizer, it does not take the pose, or it died afterwards; or the grid
            was not loaded. The former grid is requested again.
        TimeJumpError
            Time has jumped back since the image.
        """
        self._base_frame = parameters.base_frame
        if not parameters.base_frame:
            self._node.get_logger().warning(
                "base_frame is empty, so initialpose is the camera's pose; for AMCL set "
                "base_frame to AMCL's base_frame_id", once=True)
        until = deadline - _LEAST_S  # later, a localizer could not use the pose
        # discovery of a localizer that has just started takes up to three seconds
        while parameters.require_localizer and (missing := self.localizer.missing()) \
                and not self._stopped.is_set():
            if not _left_s(until):
                raise NoLocalizerError(missing)
            self._stopped.wait(min(_POLL_S, _left_s(until)))
        must_show = parameters.require_localizer and bool(parameters.localizer_pose)
        given, times, floor, before = pose, 0, pose.header.frame_id, self.floors.loaded
        try:
            while not times or (must_show and not self._is_shown(given, deadline)):
                # first, because with any time left a robot that moves is told to stop
                self.check_rest(parameters.max_speed_m_s, parameters.max_turn_rad_s, deadline)
                if must_show and _left_s(deadline) < _LEAST_S:
                    raise NoLocalizerError(self._not_taken(given, times))
                self._check_place(pose.header.stamp, deadline,
                                  received_at if grids and not times else math.inf)
                jumps.check(pose.header.stamp, received_at)
                if self._stopped.is_set():
                    raise HandOffError('the node was deactivated during the hand-over')
                if grids and floor not in self.floors.loaded.values():
                    self.floors.enter(floor, grids, deadline)
                    continue  # the robot may have moved meanwhile
                given, times = usable_pose(pose, self._node.get_clock().now()), times + 1
                given.header.frame_id = next(iter(self.floors.loaded if grids else ()), floor)
                self.localizer.give(given)
            silent = self._settle(parameters.nomotion_updates, deadline)
            if must_show and (gone := silent or self.localizer.missing()):
                raise NoLocalizerError('the localizer took the pose, but has ended or hangs: '
                                       f'{gone}; see its log, then retry')
            if must_show and not self._is_taken(given, _CARRY_S):
                raise NoLocalizerError(self._not_taken(given, times))
        except CliplocError as error:
            raise type(error)(f'{error}{self.floors.restore(before, grids)}') from error
        if silent:
            self._node.get_logger().warning(
                f'{silent}: the localizer has the pose, but may not converge while the robot is '
                'at rest', throttle_duration_sec=5.0)

    def _is_shown(self, given: PoseWithCovarianceStamped, deadline: float) -> bool:
        """Return whether the localizer's pose agrees with `given`; wait briefly for that."""
        with self.localizer.changed:
            self.localizer.changed.wait_for(
                lambda: self._stopped.is_set() or self._is_taken(given),
                min(_REPEAT_S, _left_s(deadline)))
            return self._is_taken(given)

    def _is_taken(self, given: PoseWithCovarianceStamped, patience_s: float = 0.0) -> bool:
        """Return whether the localizer's pose agrees with `given`; wait for odometry at it."""
        shown = self.localizer.shown()
        return shown is not None and not difference(
            self._carried(given, shown.header.stamp, patience_s), shown)

    def _carried(self, given: PoseWithCovarianceStamped, stamp: Stamp, patience_s: float = 0.0
                 ) -> PoseWithCovarianceStamped:
        """Return a given pose, moved by odometry to a stamp; unchanged if that is unknown."""
        pose = pose_from_msg(given.pose.pose)
        try:
            motion, frame = self._odometry.motion(given.header.stamp, stamp, patience_s)
            base_from_body = np.eye(4) if frame == self._base_frame else self._transforms.lookup(
                self._base_frame, frame, given.header.stamp, 0.0)
        except CliplocError:
            return given
        assert pose is not None  # it was accepted
        carried = deepcopy(given)
        carried.pose.pose = pose_to_msg(
            pose @ base_from_body @ motion @ invert_transform(base_from_body))
        return carried

    def _not_taken(self, given: PoseWithCovarianceStamped, times: int) -> str:
        """Return why the localizer has not taken the given pose, for a message."""
        shown, why = self.localizer.shown(), 'the localizer did not take the pose: '
        if not times:
            return 'too little time is left for the localizer to take the pose: retry'
        if shown is None:
            source = self.localizer.pose_topic or 'tf from the map'
            return (f'{why}no message on {source} since initialpose was published {times} times: '
                    f'{self.localizer.silence()}')
        given = self._carried(given, shown.header.stamp)
        return f'{why}{self.localizer.pose_topic or "tf"} {difference(given, shown)}'

    def check_rest(self, max_speed_m_s: float, max_turn_rad_s: float, deadline: float) -> None:
        """Raise HandOffError unless odometry shows that the robot is at rest.

        Without a publisher of odometry, the robot is assumed to be at rest.
        """
        odometry = self._odometry.recent(_MAX_ODOM_AGE_S, min(_ODOM_PATIENCE_S, _left_s(deadline)))
        if odometry is None:
            if not self._odometry.is_published:
                self._node.get_logger().warning(
                    f'nobody publishes {self._odometry.topic}: the robot is assumed to be at rest',
                    once=True)
                return
            raise HandOffError(f'{self._odometry.topic} has a publisher but no messages, so the '
                               'robot may be moving: check the odometry')
        left_s = _left_s(deadline)
        by_poses = self._odometry.speeds_by_poses(left_s)
        if by_poses is None and left_s < MOMENT_PATIENCE_S:
            raise HandOffError(f'{self._odometry.topic} has just begun, and too little time is '
                               'left to check that the robot is at rest: retry')
        v, w = odometry.twist.twist.linear, odometry.twist.twist.angular
        by_twist = math.hypot(v.x, v.y, v.z), math.hypot(w.x, w.y, w.z)
        if by_poses is None and by_twist == (0.0, 0.0):
            raise HandOffError(f'the speed is unknown: {self._odometry.topic} has neither a twist '
                               'nor poses with valid stamps; publish either at 1 Hz or more')
        # np.maximum propagates NaN, which fails the comparison below
        speed_m_s, turn_rad_s = np.maximum(by_twist, by_poses or (0.0, 0.0))
        if not (speed_m_s <= max_speed_m_s and turn_rad_s <= max_turn_rad_s):
            raise HandOffError(f'the robot moves at {speed_m_s:.2f} m/s and {turn_rad_s:.2f} '
                               f'rad/s (limits {max_speed_m_s:g} and {max_turn_rad_s:g}): stop it')

    def _check_place(self, stamp: Stamp, deadline: float, received_at: float) -> None:
        """Raise HandOffError unless the robot is still where its image was taken.

        AMCL would correct the pose by tf, but robot_localization's set_pose does not. No odometry
        shows a lift.
        """
        is_published = self._odometry.is_published
        if (age_s := time.monotonic() - received_at) > _LIFT_S:
            raise HandOffError(
                f'the image is {age_s:.1f} s old, as by a lift (limit {_LIFT_S:g}): retry')
        moved = self._odometry.moved_since(
            stamp, min(_ODOM_PATIENCE_S, _left_s(deadline)) if is_published else 0.0)
        if moved is None and is_published:
            raise HandOffError(f'{self._odometry.topic} does not cover the time since the image: '
                               'stamp both by the same clock, publish at 1 Hz or more, then retry')
        distance_m, angle_deg = moved or (0.0, 0.0)
        if distance_m > SAME_SPOT.distance_m or angle_deg > SAME_SPOT.angle_deg:
            raise HandOffError(
                f'the robot has moved by {distance_m:.2f} m and {angle_deg:.0f} degrees since its '
                f'image (limits {SAME_SPOT.distance_m:g} and {SAME_SPOT.angle_deg:g}): stop it')

    def _settle(self, updates: int, deadline: float) -> str:
        """Make AMCL process some scans while the robot is at rest, as far as time allows.

        Return an error message if a call times out and AMCL publishes no pose meanwhile; else ''.
        """
        for _ in range(updates):
            timeout_s = min(_UPDATE_PATIENCE_S, _left_s(deadline))
            if not self._updater.service_is_ready() or timeout_s < _LEAST_S:
                return ''
            called_at, answered = time.monotonic(), threading.Event()
            future = self._updater.call_async(Empty.Request())
            future.add_done_callback(lambda _, answered=answered: answered.set())
            if not answered.wait(timeout_s):
                self._updater.remove_pending_request(future)
                return '' if self.localizer.shown_at > called_at else \
                    f'{self._updater.service_name} did not answer within {timeout_s:.1f} s'
            if self._stopped.wait(_UPDATE_PERIOD_S):
                return ''
        return ''


def _left_s(deadline: float) -> float:
    """Return the time left until a deadline (monotonic clock), at least 0 [s]."""
    return max(0.0, deadline - time.monotonic())


def usable_pose(pose: PoseWithCovarianceStamped, now: Time) -> PoseWithCovarianceStamped:
    """Return a pose that AMCL can use.

    A stamp in the future, for which AMCL has no odometry, is replaced by `now`, unless that is 0:
    simulated time has not begun. Small variances are raised, because otherwise all particles
    would coincide. AMCL reads elements 0, 1, 6, 7 and 35 of the covariance.
    """
    usable = deepcopy(pose)
    covariance = np.array(pose.pose.covariance).reshape(6, 6)
    usable.pose.covariance = (covariance + np.diag(np.maximum(
        0.0, _MIN_VARIANCES - np.diag(covariance)))).ravel()
    if 0 < now.nanoseconds < stamp_ns(pose.header.stamp):
        usable.header.stamp = now.to_msg()
    return usable

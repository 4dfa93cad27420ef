# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The topic `odom`: how fast the robot moves, and where its camera took each image."""

import math
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node

from cliploc_ros.core.geometry.transforms import pose_error
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.odometry_window import (
    LONG_NS,
    MOMENT_NS,
    NoOdometryError,
    OdometryWindow,
)
from cliploc_ros.ros.inputs.subscription import AdaptiveSubscription
from cliploc_ros.units import NS_PER_S

# The boxes of a slow detector arrive long after their image was taken.
_LENGTH_S = 30.0
# The message that follows an image arrives within this time: wheels publish faster.
_PATIENCE_S = 0.2
# Odometry that ends or begins this close to an image may cover the next image.
_NEARLY_NS = 2_000_000_000
#: How long odometry that has just begun may take to show a speed [s]: a late answer is better than
#: taking a moving robot on a busy machine for one at rest.
MOMENT_PATIENCE_S = 2.0


class BodyPose(NamedTuple):
    """Where odometry had the robot at the stamp of an image."""

    odom_from_body: NDArray[np.float64]
    #: The coordinate frame that odometry tracks (child_frame_id).
    body_frame: str
    #: Poses of one run share their odometry frame; those of different runs do not compare.
    run: int
    #: Driven since the run began.
    way_m: float


class OdometrySource:
    """Subscribes to odometry while the node is active: it costs little, and links frames."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._heard = threading.Condition()
        self._window = OdometryWindow(_LENGTH_S)
        self._newest: Odometry | None = None
        self._newest_at = 0.0
        self._frames = ('', '')
        self._on_restart: list[Callable[[int], None]] = []
        self._subscription: AdaptiveSubscription | None = None

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

    def close(self) -> None:
        """Unsubscribe, and forget what was heard."""
        if self._subscription is not None:
            self._subscription.destroy()
            self._subscription = None
        self.forget()

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

        Raises
        ------
        NoOdometryError
            Odometry does not cover that time.
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

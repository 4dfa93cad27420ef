# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The topic `odom`: how fast the robot is, and where its camera was when it took an image."""

import math
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node

from cliploc_ros.core.geometry.transforms import invert_transform, pose_error
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames
from cliploc_ros.ros.inputs.odometry_window import NoOdometryError, OdometryWindow
from cliploc_ros.ros.inputs.subscription import AdaptiveSubscription

# A slow detector's image is no older when its boxes come.
_LENGTH_S = 30.0
# The message after an image is no later than that, and wheels talk more often.
_PATIENCE_S = 0.2
# What so nearly covers an image may cover the next one: odometry has just begun, or it pauses.
_NEARLY_NS = 2_000_000_000
# Over a shorter time the noise of poses would be taken for a speed.
_MOMENT_NS = 300_000_000
# A moment of what has just begun, and what a busy machine makes of it: a robot that is taken to
# stand although it moves is worse than an answer that comes later.
_MOMENT_PATIENCE_S = 2.0
# How long a publisher that has just been found may need for its first message.
_DISCOVERY_S = 1.0


class CameraPlace(NamedTuple):
    """Where a camera was.

    Parameters
    ----------
    odom_from_camera : ndarray (4, 4)
    run : int
        Only places of equal run have the same odometry frame.
    """

    odom_from_camera: NDArray[np.float64]
    run: int


class OdometrySource:
    """Listens to odometry while somebody needs it, and only then.

    Parameters
    ----------
    node : Node
    base : CoordinateFrames
        Knows how the camera is mounted.
    """

    def __init__(self, node: Node, base: CoordinateFrames) -> None:
        self._node = node
        self._base = base
        self._heard = threading.Condition()
        self._window = OdometryWindow(_LENGTH_S)
        self._newest: Odometry | None = None
        self._newest_at = 0.0
        self._frames = ('', '')
        self._listeners = 0
        self._subscription: AdaptiveSubscription | None = None
        self._unmounted = ''

    @property
    def topic(self) -> str:
        """Return what it listens to."""
        return str(self._node.resolve_topic_name('odom'))

    @property
    def is_published(self) -> bool:
        """Return whether anybody publishes odometry."""
        return bool(self._node.count_publishers(self.topic))

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Listen for the length of a with statement."""
        with self._heard:
            self._listeners += 1
            if self._subscription is None:
                self._subscription = AdaptiveSubscription(self._node, Odometry, 'odom', self.take,
                                                          qos.ODOM)
        try:
            yield
        finally:
            with self._heard:
                self._listeners -= 1
                if self._listeners == 0:
                    self._subscription.destroy()
                    self._subscription = None
                    self._newest = None
                    self._window.clear()

    def forget(self) -> None:
        """Forget all messages: time jumped."""
        with self._heard:
            self._newest = None
            self._window.clear()

    def take(self, msg: Odometry) -> None:
        """Take a message in."""
        p, q = msg.pose.pose.position, msg.pose.pose.orientation
        with self._heard:
            self._newest, self._newest_at = msg, time.monotonic()
            frames = (msg.header.frame_id, msg.child_frame_id)
            if frames != self._frames:
                self._window.clear()
                self._frames = frames
            self._window.add(stamp_ns(msg.header.stamp), np.array([p.x, p.y, p.z]),
                             np.array([q.x, q.y, q.z, q.w]))
            self._heard.notify_all()

    def recent(self, patience_s: float) -> Odometry | None:
        """Return the newest message, if it came that long ago or comes in that time [s].

        Where nobody publishes any, no time is lost.
        """
        def is_recent() -> bool:
            return (self._newest is not None
                    and time.monotonic() - self._newest_at <= patience_s)
        with self._heard:
            if self.is_published:
                self._heard.wait_for(is_recent, patience_s)
            return self._newest if is_recent() else None

    def speeds_by_poses(self, patience_s: float = _MOMENT_PATIENCE_S) -> tuple[float, float]:
        """Return how fast the poses of the last moment drove [m/s] and turned [rad/s].

        Many sources of poses leave the twist empty. Where poses do not tell, it is 0; what has
        just begun is waited for.
        """
        with self._heard:
            self._heard.wait_for(lambda: self._last_moment() is not None,
                                 min(patience_s, _MOMENT_PATIENCE_S))
            moment = self._last_moment()
        if moment is None:
            return 0.0, 0.0
        distance_m, angle_deg = pose_error(*moment)
        seconds = _MOMENT_NS / 1e9
        return distance_m / seconds, math.radians(angle_deg) / seconds

    def _last_moment(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return the robot a moment ago, and now; None where that is not known."""
        if self._newest is None:
            return None
        now_ns = stamp_ns(self._newest.header.stamp)
        try:
            return self._window.pose_at(now_ns - _MOMENT_NS), self._window.pose_at(now_ns)
        except NoOdometryError:
            return None

    def follows(self, stamp: Time) -> bool:
        """Return whether odometry tells of about the time of an image, and so of the next."""
        at_ns = stamp_ns(stamp)
        with self._heard:
            if self.is_published:
                self._heard.wait_for(lambda: len(self._window), _DISCOVERY_S)
            return self._window.spans(at_ns, _NEARLY_NS)

    def camera_place(self, values: Mapping[str, Any], camera_from_base: NDArray[np.float64],
                     camera_frame: str, stamp: Time) -> CameraPlace:
        """Return where the camera was.

        Parameters
        ----------
        values : mapping
            Of the relocalizer's parameters.
        camera_from_base : ndarray (4, 4)
            How the camera is mounted.
        camera_frame : str
            frame_id of the image.
        stamp : Time
            Of the image.

        Raises
        ------
        NoOdometryError
            Odometry says nothing of that time.
        NoTransformError
            How the camera is mounted on the body of odometry is unknown.
        """
        at_ns = stamp_ns(stamp)
        with self._heard:
            # the message after the image may not have come yet
            if self._window.is_ahead(at_ns):
                self._heard.wait_for(lambda: not self._window.is_ahead(at_ns), _PATIENCE_S)
            odom_from_body = self._window.pose_at(at_ns)
            run, body_frame = self._window.run, self._frames[1]
        if not body_frame:
            raise NoOdometryError(f'{self.topic} has no child_frame_id')
        if body_frame == camera_frame:
            return CameraPlace(odom_from_body, run)
        camera_from_body = camera_from_base if body_frame == values['base_frame'] else \
            self._lookup(camera_frame, body_frame, stamp, values['tf_timeout_s'])
        return CameraPlace(odom_from_body @ invert_transform(camera_from_body), run)

    def _lookup(self, camera_frame: str, body_frame: str, stamp: Time, timeout_s: float
                ) -> NDArray[np.float64]:
        """Ask tf2; what it did not know once it need not be waited for again."""
        known = self._unmounted != body_frame
        self._unmounted = body_frame
        camera_from_body = self._base.lookup(camera_frame, body_frame, stamp,
                                             timeout_s if known else 0.0)
        self._unmounted = ''
        return camera_from_body

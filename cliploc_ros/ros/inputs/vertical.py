# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Which way is up for the camera: by the robot's base, or by an IMU."""

import math
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

from cliploc_ros.errors import CliplocError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.coordinate_frames import BaseFrame
from cliploc_ros.ros.inputs.subscription import AdaptiveSubscription

SOURCES = ('none', 'base_frame', 'imu')
_UP = np.array([0.0, 0.0, 1.0])
_STANDARD_GRAVITY = 9.80665
# An accelerometer that measures something else than this much about gravity is being moved.
_MAX_ACCELERATION = 0.5
# Samples so near an image are averaged: vibration is faster, and robots turn slowly meanwhile.
_WINDOW_NS = 100_000_000
# A second of the fastest usual IMU.
_MAX_SAMPLES = 1000


class NoVerticalError(CliplocError):
    """The vertical is not known now; the message says why."""


class Sample(NamedTuple):
    """What an IMU said at one instant: up in its frame times m/s^2, or a unit vector."""

    stamp_ns: int
    up: NDArray[np.float64]
    is_acceleration: bool


def sample_from_msg(msg: Imu) -> Sample | None:
    """Return what a message says of the vertical; None if it says nothing.

    The orientation is taken where there is one: its filter knows how the robot moves. Else the
    acceleration: at rest it points up (REP 145).
    """
    q, a = msg.orientation, msg.linear_acceleration
    quat_xyzw = np.array([q.x, q.y, q.z, q.w])
    # a covariance that begins with -1 says that the field is not measured (sensor_msgs/Imu)
    if msg.orientation_covariance[0] != -1.0 and abs(np.linalg.norm(quat_xyzw) - 1.0) < 0.01:
        up = Rotation.from_quat(quat_xyzw).inv().apply(_UP)
        return Sample(stamp_ns(msg.header.stamp), up, False)
    acceleration = np.array([a.x, a.y, a.z])
    if msg.linear_acceleration_covariance[0] == -1.0 or not np.isfinite(acceleration).all():
        return None
    return Sample(stamp_ns(msg.header.stamp), acceleration, True)


class VerticalSource:
    """Knows the vertical in the camera's frame; listens to an IMU only while it is needed.

    Parameters
    ----------
    node : Node
    base : BaseFrame
        Knows how the camera and the IMU are mounted.
    """

    def __init__(self, node: Node, base: BaseFrame) -> None:
        self._node = node
        self._base = base
        self._lock = threading.Lock()
        self._samples: deque[Sample] = deque(maxlen=_MAX_SAMPLES)
        self._imu_frame = ''
        self._subscription: AdaptiveSubscription | None = None

    def open(self, source: str) -> None:
        """Subscribe to the IMU where it is the source."""
        if source == 'imu':
            self._subscription = AdaptiveSubscription(self._node, Imu, 'imu', self.take, qos.IMU)

    def close(self) -> None:
        """Unsubscribe, and forget what was heard."""
        if self._subscription is not None:
            self._subscription.destroy()
            self._subscription = None
        with self._lock:
            self._samples.clear()

    def take(self, msg: Imu) -> None:
        """Take a message of the IMU in."""
        sample = sample_from_msg(msg)
        if sample is None:
            return
        with self._lock:
            if self._samples and sample.stamp_ns < self._samples[-1].stamp_ns:
                self._samples.clear()  # time jumped back: what was before means nothing now
            self._samples.append(sample)
            self._imu_frame = msg.header.frame_id

    def up_in_camera(self, values: Mapping[str, Any], camera_from_base: NDArray[np.float64],
                     camera_frame: str, stamp: Time) -> NDArray[np.float64] | None:
        """Return the vertical (3,), a unit vector in the camera's optical frame.

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

        Returns
        -------
        ndarray (3,) or None
            None where gravity is 'none'.

        Raises
        ------
        NoVerticalError
            The IMU said nothing at that time, or was being moved.
        FrameError
            Nobody says how the IMU is mounted.
        """
        if values['gravity'] == 'none':
            return None
        if values['gravity'] == 'base_frame':
            return np.asarray(camera_from_base[:3, :3] @ _UP)
        up_in_imu, imu_frame = self._up_in_imu(stamp_ns(stamp))
        if imu_frame == camera_frame:
            return up_in_imu
        camera_from_imu = camera_from_base if imu_frame == values['base_frame'] else \
            self._base.camera_from_base(imu_frame, [], camera_frame, stamp,
                                        values['tf_timeout_s'])
        return np.asarray(camera_from_imu[:3, :3] @ up_in_imu)

    def _up_in_imu(self, at_ns: int) -> tuple[NDArray[np.float64], str]:
        """Return the mean vertical about an instant, and the frame it is in."""
        with self._lock:
            frame = self._imu_frame
            near = [one for one in self._samples if abs(one.stamp_ns - at_ns) <= _WINDOW_NS]
        if near and not frame:
            raise NoVerticalError("the IMU's messages have no frame_id, so nobody can say how it "
                                  'is mounted')
        if not near:
            topic = self._node.resolve_topic_name('imu')
            raise NoVerticalError(f'no usable message of {topic} is within '
                                  f'{_WINDOW_NS // 1_000_000} ms of the image')
        mean = np.mean([one.up for one in near], axis=0)
        length = float(np.linalg.norm(mean))
        expected = _STANDARD_GRAVITY if near[-1].is_acceleration else 1.0
        if not math.isclose(length, expected, rel_tol=_MAX_ACCELERATION / _STANDARD_GRAVITY):
            raise NoVerticalError(f'the IMU is being moved: it measures {length:.2f} where rest '
                                  f'is {expected:.2f}')
        return mean / length, frame

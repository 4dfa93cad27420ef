# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mount, vertical, odometry and last pose of the robot: everything but its image."""

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.observation import Region
from cliploc_ros.errors import CliplocError
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.odometry import (
    NoOdometryError,
    OdometryPlace,
    OdometrySource,
)
from cliploc_ros.ros.inputs.prior import PriorSource
from cliploc_ros.ros.inputs.stamps import StampOrder, stamp_problem
from cliploc_ros.ros.node.diagnostics import Health
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.parameters import RelocalizerParameters

_UP = np.array([0.0, 0.0, 1.0])
_STANDARD_GRAVITY = 9.80665
# An acceleration further from gravity than this is one of a moving IMU (a guess) [m/s^2].
_MAX_ACCELERATION = 0.5
# An orientation that changes faster than this within the window below is of no use (a guess).
_MIN_MEAN_LENGTH = 0.95
# An orientation is refused where gravity contradicts it by more than this (a guess): a cheap
# accelerometer at rest is off by up to 3 degrees, a wrong or missing orientation mostly by more.
_MAX_CONTRADICTION_DEG = 5.0
#: Samples so near an image are averaged [ns]: vibration is faster, and robots turn slowly.
WINDOW_NS = 100_000_000
# Messages of the fastest usual IMU in a second.
_MAX_SAMPLES = 1000
# sensor_msgs/Imu: the first element of the covariance of a field that is not measured.
_NOT_MEASURED = -1.0
_LOG_PERIOD_S = 5.0
_RETRY_S = 0.02
# Time for a publisher of odometry that has just been discovered to deliver its first message.
_DISCOVERY_S = 1.0


class NoVerticalError(CliplocError):
    """The vertical is not known now; the message says why."""


class Sample(NamedTuple):
    """Measurements of an IMU at one instant, in its own coordinate frame; at least one of two."""

    stamp_ns: int
    #: A unit vector (3,), by the orientation.
    up: NDArray[np.float64] | None
    #: (3,) [m/s^2]; at rest it points up (REP 145).
    acceleration: NDArray[np.float64] | None


def sample_from_msg(msg: Imu) -> Sample | None:
    """Return the vertical by a message; None if it has none.

    A field is missing if its covariance begins with -1, or if it has its default value: no
    acceleration at all, or no rotation with a covariance of zeros. The latter may be a
    measurement, but then the acceleration says the same.
    """
    q, a = msg.orientation, msg.linear_acceleration
    quat_xyzw, acceleration = np.array([q.x, q.y, q.z, q.w]), np.array([a.x, a.y, a.z])
    is_default = np.array_equal(quat_xyzw, [0.0, 0.0, 0.0, 1.0]) \
        and not np.any(msg.orientation_covariance)
    has_up = (msg.orientation_covariance[0] != _NOT_MEASURED and not is_default
              and abs(np.linalg.norm(quat_xyzw) - 1.0) < 0.01)
    has_acceleration = (msg.linear_acceleration_covariance[0] != _NOT_MEASURED
                        and acceleration.any() and np.isfinite(acceleration).all())
    if not has_up and not has_acceleration:
        return None
    return Sample(stamp_ns(msg.header.stamp),
                  np.asarray(Rotation.from_quat(quat_xyzw).inv().apply(_UP)) if has_up else None,
                  acceleration if has_acceleration else None)


class VerticalSource(qos.Listener):
    """The vertical in the camera's coordinate frame.

    An IMU's orientation is preferred to its acceleration, because its filter removes the robot's
    motion. But many drivers leave the orientation at its default or fill it wrongly. It has to
    agree with the acceleration at rest, where the IMU measures both.

    `transforms` has the mounts of the camera and the IMU.
    """

    def __init__(self, node: Node, transforms: CoordinateFrames) -> None:
        self._node = node
        self._transforms = transforms
        self._lock = threading.Lock()
        self._samples: deque[Sample] = deque(maxlen=_MAX_SAMPLES)
        self._stamps = StampOrder()
        self._imu_frame = ''
        self._newest_is_empty = False
        #: What is wrong with the stamp of the newest message, and what to do; empty if nothing is.
        self.problem = ''

    def open(self, source: str) -> None:
        """Listen to the IMU, if the source is 'imu'; does nothing if it already does."""
        if source == 'imu' and self._subscription is None:
            self._subscription = qos.AdaptiveSubscription(
                self._node, Imu, 'imu', self.take, qos.IMU)

    def forget(self) -> None:
        """Forget all samples: time jumped."""
        with self._lock:
            self._samples.clear()
            self._stamps.clear()
            self.problem = ''

    def take(self, msg: Imu) -> None:
        """Take in a message of the IMU."""
        sample = sample_from_msg(msg)
        with self._lock:
            self._newest_is_empty = sample is None
            why, topic = stamp_problem(msg.header.stamp), self._node.resolve_topic_name('imu')
            self.problem = why and f'the stamp of {topic} {why}: its driver must stamp each sample'
            if sample is None or why:
                return
            if self._stamps.goes_back('imu', sample.stamp_ns):
                self._samples.clear()
            self._samples.append(sample)
            self._imu_frame = msg.header.frame_id

    def up_in_camera(self, parameters: RelocalizerParameters,
                     camera_from_base: NDArray[np.float64], camera_frame: str, stamp: Time
                     ) -> NDArray[np.float64] | None:
        """Return the vertical (3,), a unit vector in the camera's optical coordinate frame.

        None where gravity is 'none'. `camera_frame` and `stamp` are those of the image.

        Raises
        ------
        NoVerticalError
            The IMU measured nothing at that time, was moving, or contradicts itself.
        NoTransformError
            The IMU's mount is unknown.
        """
        if parameters.gravity == 'none':
            return None
        if parameters.gravity == 'base_frame':
            return np.asarray(camera_from_base[:3, :3] @ _UP)
        up_in_imu, imu_frame = self._up_in_imu(stamp_ns(stamp))
        if imu_frame == camera_frame:
            return up_in_imu
        camera_from_imu = camera_from_base if imu_frame == parameters.base_frame else \
            self._transforms.camera_from_base(imu_frame, [], camera_frame, stamp,
                                              parameters.tf_timeout_s)
        return np.asarray(camera_from_imu[:3, :3] @ up_in_imu)

    def _up_in_imu(self, at_ns: int) -> tuple[NDArray[np.float64], str]:
        """Return the mean vertical about an instant, and the coordinate frame it is in."""
        with self._lock:
            frame, samples = self._imu_frame, list(self._samples)
            newest_is_empty = self._newest_is_empty
        near = [sample for sample in samples if abs(sample.stamp_ns - at_ns) <= WINDOW_NS]
        topic = self._node.resolve_topic_name('imu')
        if not near and self.problem:
            raise NoVerticalError(self.problem)
        if not near and newest_is_empty:
            raise NoVerticalError(f'{topic} has neither an orientation nor an acceleration: fill '
                                  'at least one')
        if not near:
            raise NoVerticalError(f'no message of {topic} is within {WINDOW_NS // 1_000_000} ms '
                                  'of the image')
        if not frame:
            raise NoVerticalError(f'{topic} has no frame_id, so its mount is unknown: fill it')
        return mean_up(near, samples, topic), frame


def mean_up(near: Sequence[Sample], samples: Sequence[Sample], topic: str
            ) -> NDArray[np.float64]:
    """Return the mean vertical (3,) of the samples about an image, a unit vector in the IMU.

    By their orientations, if all recent samples of the topic do not contradict them; else by
    their accelerations. NoVerticalError: see VerticalSource.up_in_camera.
    """
    ups = [one.up for one in near if one.up is not None]
    if not ups:
        mean = np.mean([one.acceleration for one in near if one.acceleration is not None],
                       axis=0)
        if not _is_gravity(mean):
            raise NoVerticalError(
                f'the IMU is moving: it measures {np.linalg.norm(mean):.2f} m/s^2, at rest it '
                f'measures {_STANDARD_GRAVITY:.2f}')
        return np.asarray(mean / np.linalg.norm(mean))
    contradiction_deg = _contradiction_deg(samples)
    if contradiction_deg > _MAX_CONTRADICTION_DEG:
        raise NoVerticalError(
            f'the orientation of {topic} is {contradiction_deg:.0f} degrees off gravity '
            f'(limit {_MAX_CONTRADICTION_DEG:g}): correct it, or set '
            'orientation_covariance[0] to -1')
    mean = np.mean(ups, axis=0)
    length = float(np.linalg.norm(mean))
    if not length > _MIN_MEAN_LENGTH:
        raise NoVerticalError(
            'the IMU turns too fast: its orientations about the image differ')
    return np.asarray(mean / length)


def _is_gravity(acceleration: NDArray[np.float64]) -> bool:
    return bool(abs(np.linalg.norm(acceleration) - _STANDARD_GRAVITY) <= _MAX_ACCELERATION)


def _contradiction_deg(samples: Sequence[Sample]) -> float:
    """Return the median angle between up by orientation and by acceleration at rest [deg].

    The median over all samples, not those about the image alone: a robot that starts or brakes
    deflects its accelerometer for a moment. 0 where no sample measures both at rest.
    """
    cosines = [float(sample.up @ sample.acceleration) / float(np.linalg.norm(sample.acceleration))
               for sample in samples if sample.up is not None and sample.acceleration is not None
               and _is_gravity(sample.acceleration)]
    return float(np.degrees(np.median(np.arccos(np.clip(cosines, -1.0, 1.0))))) \
        if cosines else 0.0


@dataclass(frozen=True)
class RobotState:
    """The robot at the stamp of one image."""

    #: The mount (4, 4); identity where the camera's own pose is wanted.
    camera_from_base: NDArray[np.float64]
    #: The vertical, a unit vector (3,) in the camera's optical frame; None if it is not known.
    up_in_camera: NDArray[np.float64] | None = None
    #: Place of the camera; None if odometry does not cover the image.
    place: OdometryPlace | None = None
    #: (4, 4): the pose of a depth camera that is not registered; None if tf2 lacks it
    camera_from_depth: NDArray[np.float64] | None = None


class KnownBefore(NamedTuple):
    """Knowledge about an instant that its messages do not hold."""

    state: RobotState  #: At the stamp of the frame to localize
    #: The frames of other cameras whose mounts are known, with the robot's state at each
    beside: Sequence[tuple[Frame, RobotState]] = ()
    region: Region | None = None  #: Where the robot probably is


class RobotStateSource:
    """Gathers the mount, the vertical and odometry while the node is active."""

    def __init__(self, node: ManagedNode[RelocalizerParameters]) -> None:
        self._node = node
        self.transforms = CoordinateFrames(node)
        self.odometry = OdometrySource(node)
        self.vertical = VerticalSource(node, self.transforms)
        self.prior = PriorSource(node, self.transforms)
        self._unknown = set[str]()  # coordinate frames that tf2 did not know the last time

    def open(self) -> None:
        """Subscribe to the inputs that the parameters select."""
        parameters = self._node.settings.values
        self.vertical.open(parameters.gravity)
        self.prior.open(parameters)
        self.odometry.open()
        if parameters.publish_tf or parameters.watch == 'tf' or (
                parameters.base_frame and not any(parameters.base_from_camera)):
            # in the worker, for importing tf2 takes a while
            self._node.worker.run(self.transforms.open)

    def close(self) -> None:
        """Unsubscribe."""
        self.odometry.close()
        self.vertical.close()
        self.prior.close()
        self._node.worker.submit(self.transforms.close)  # after a search that may be under way

    def forget(self) -> None:
        """Forget what was heard: time jumped."""
        self.transforms.forget()
        self.vertical.forget()
        self.odometry.forget()

    def examine(self, health: Health) -> None:
        """Report invalid stamps of odometry and of the IMU."""
        for problem in (self.odometry.problem, self.vertical.problem):
            if problem:
                health.warn(problem)

    def is_linked_soon(self, stamp: Time, deadline: float) -> bool:
        """Return whether odometry can link the frame that follows an image.

        Waits for odometry that has just begun, until `deadline` (monotonic clock) [s].
        """
        patience_s = min(_DISCOVERY_S, max(0.0, deadline - time.monotonic()))
        return (self._node.settings.values.fuse_frames > 1
                and self.odometry.covers_soon(stamp, patience_s))

    def at_instant(self, frame: Frame, parameters: RelocalizerParameters,
                   frame_ids: Sequence[str], map_hash: str, deadline: float = math.inf
                   ) -> KnownBefore:
        """Return the knowledge at the instant of a frame, given the maps; see at."""
        header = frame.image.header
        state = self.at(header, parameters.of_camera(frame.camera), deadline, frame.depth_frame)
        beside = []
        for one in frame.beside:
            soon = min(deadline, time.monotonic() + parameters.tf_timeout_s)
            try:
                beside.append((one, self.at(one.image.header, parameters.of_camera(one.camera),
                                            soon, one.depth_frame)))
            except NoTransformError as error:
                self._warn(f'localizing without {one.camera}: {error}')
        return KnownBefore(state, beside, self.prior.region(
            header.stamp, parameters, state.camera_from_base, frame_ids, map_hash))

    def at(self, image: Header, parameters: RelocalizerParameters, deadline: float = math.inf,
           depth_frame: str = '') -> RobotState:
        """Return the robot's state at the stamp of an image.

        Without a vertical, odometry, or the pose of depth in another coordinate frame, the search
        does without.

        While the mount is not known, half of the time until `deadline` (monotonic clock) [s] may
        pass, and half remains for a newer image.

        NoTransformError: the mount is not known.
        """
        camera_from_base = self._mount(image, parameters, deadline)
        up_in_camera = None
        try:
            up_in_camera = self.vertical.up_in_camera(parameters, camera_from_base,
                                                       image.frame_id, image.stamp)
        except (NoVerticalError, NoTransformError) as error:
            self._warn(f'localizing without the vertical: {error}')
        camera_from_depth = None
        if depth_frame not in ('', image.frame_id):
            with suppress(NoTransformError):  # what becomes of the depth is said there
                camera_from_depth = self._lookup(image, depth_frame, parameters)
        return RobotState(camera_from_base, up_in_camera,
                          self._place(image, parameters, camera_from_base), camera_from_depth)

    def _mount(self, image: Header, parameters: RelocalizerParameters, deadline: float
               ) -> NDArray[np.float64]:
        now = time.monotonic()
        slice_s = parameters.tf_timeout_s
        until = now + slice_s if math.isinf(deadline) else 0.5 * (now + deadline)
        while True:
            wait_s = min(slice_s, max(0.0, until - time.monotonic()))
            try:
                return self.transforms.camera_from_base(
                    parameters.base_frame, parameters.base_from_camera, image.frame_id,
                    image.stamp, wait_s)
            except NoTransformError:
                if time.monotonic() + _RETRY_S > until:
                    raise
                self._node.check_active()
                time.sleep(_RETRY_S)

    def _place(self, image: Header, parameters: RelocalizerParameters,
               camera_from_base: NDArray[np.float64]) -> OdometryPlace | None:
        if parameters.fuse_frames == 1:
            return None
        try:
            body = self.odometry.pose_at(image.stamp)
            if body.frame == image.frame_id:
                return body
            camera_from_body = camera_from_base if body.frame == parameters.base_frame else \
                self._lookup(image, body.frame, parameters)
        except NoOdometryError as error:
            self._node.get_logger().debug(f'one frame alone: {error}')
            return None
        except NoTransformError as error:
            self._warn(f'one frame alone: {error}')
            return None
        return body._replace(
            odom_from_frame=body.odom_from_frame @ invert_transform(camera_from_body),
            frame=image.frame_id)

    def _lookup(self, image: Header, frame: str, parameters: RelocalizerParameters
                ) -> NDArray[np.float64]:
        """Return camera_from_frame; do not wait again for one that tf2 did not know."""
        timeout_s = 0.0 if frame in self._unknown else parameters.tf_timeout_s
        self._unknown.add(frame)
        found = self.transforms.lookup(image.frame_id, frame, image.stamp, timeout_s)
        self._unknown.discard(frame)
        return found

    def _warn(self, text: str) -> None:
        self._node.get_logger().warning(text, throttle_duration_sec=_LOG_PERIOD_S)

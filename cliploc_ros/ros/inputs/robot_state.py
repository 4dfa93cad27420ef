# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""All inputs except the frames: mount, vertical, odometry, laser and prior of the robot."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import OccupancyGrid as OccupancyGridMsg
from numpy.typing import NDArray
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Imu, LaserScan
from std_msgs.msg import Header

from cliploc_ros.core.geometry.grid import OccupancyGrid
from cliploc_ros.core.geometry.transforms import invert_transform, transform_from_pose
from cliploc_ros.core.observation import Region, Scan
from cliploc_ros.errors import CliplocError, OptionsError
from cliploc_ros.messages import camera_from_frame, grid_from_msg, scan_from_msg
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import stamp_ns
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.odometry import NoOdometryError, OdometryPlace, OdometrySource
from cliploc_ros.ros.inputs.prior import PriorSource
from cliploc_ros.ros.inputs.stamps import StampOrder, stamp_problem
from cliploc_ros.ros.node.diagnostics import Health
from cliploc_ros.ros.node.lifecycle import LOG_PERIOD_S, ManagedNode
from cliploc_ros.ros.parameters import RelocalizerParameters
from cliploc_ros.units import NS_PER_S

_UP = np.array([0.0, 0.0, 1.0])
_STANDARD_GRAVITY = 9.80665
# Greatest difference of the acceleration of an IMU at rest from gravity [m/s^2]. Not measured.
_MAX_ACCELERATION = 0.5
# Least length of the mean vertical: it is shorter if the IMU turns within the window below. Not
# measured.
_MIN_MEAN_LENGTH = 0.95
# Greatest angle between the vertical by orientation and by gravity. A cheap accelerometer at rest
# is off by up to 3 degrees, a wrong or missing orientation usually by more. Not measured.
_MAX_CONTRADICTION_DEG = 5.0
#: Samples within this time of an image are averaged [ns]: vibration is faster, robots turn slower.
WINDOW_NS = 100_000_000
# Number of messages of a fast IMU in one second.
_MAX_SAMPLES = 1000
# sensor_msgs/Imu: the first element of the covariance of a field that is not measured.
_NOT_MEASURED = -1.0
_RETRY_S = 0.02
# Longest wait for the first message of a publisher of odometry that was just discovered.
_DISCOVERY_S = 1.0
# Longest wait for the message of odometry that follows a scan.
_PATIENCE_S = 0.2
# Greatest time between image and scan if odometry does not cover it: a laser at 5 Hz has a scan
# within this time. Not measured.
_UNLINKED_NS = NS_PER_S // 10
# Number of scans of a fast laser in ten seconds: boxes of a slow detector arrive late.
_MOST_SCANS = 400
# Greatest time between image and scan. Not measured.
_LATEST_NS = NS_PER_S // 2
# Returns the pose (4, 4) of a coordinate frame of the robot in the camera at an image.
type MountOf = Callable[[str], NDArray[np.float64]]


class NoVerticalError(CliplocError):
    """The vertical at the stamp of the image is unknown; the message says why."""


class Sample(NamedTuple):
    """A sample of an IMU in its own coordinate frame; at least one of its two fields is known."""

    stamp_ns: int
    #: Vertical by the orientation, a unit vector (3,).
    up: NDArray[np.float64] | None
    #: (3,) [m/s^2]; at rest it points up (REP 145).
    acceleration: NDArray[np.float64] | None


def sample_from_msg(msg: Imu) -> Sample | None:
    """Return the sample in a message; None if it has neither orientation nor acceleration.

    A field is missing if its covariance begins with -1, or if it has its default value: zero
    acceleration, or identity rotation with a covariance of zeros. An identity rotation may also be
    measured, but then the acceleration gives the same vertical.
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
    motion. But many drivers leave the orientation at its default or fill it wrongly. If the IMU
    measures both, the orientation must agree with the acceleration at rest.

    `transforms` looks up the mount of the IMU.
    """

    def __init__(self, node: Node, transforms: CoordinateFrames) -> None:
        self._node = node
        self._transforms = transforms
        self._lock = threading.Lock()
        self._samples: deque[Sample] = deque(maxlen=_MAX_SAMPLES)
        self._stamps = StampOrder()
        self._imu_frame = ''
        #: Fault of the newest message, and the remedy; empty if it is valid.
        self.problem = ''

    def open(self, source: str) -> None:
        """Subscribe to the IMU if the source is 'imu' and it is not yet subscribed."""
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
        """Process a message of the IMU."""
        sample = sample_from_msg(msg)
        with self._lock:
            why, topic = stamp_problem(msg.header.stamp), self._node.resolve_topic_name('imu')
            self.problem = f'the stamp of {topic} {why}: its driver must stamp each sample' \
                if why else '' if sample is not None else \
                f'{topic} has neither an orientation nor an acceleration: publish at least one'
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

        None if gravity is 'none'. `camera_frame` and `stamp` are those of the image.

        Raises
        ------
        NoVerticalError
            The IMU has no sample at that time, was moving, or contradicts itself.
        NoTransformError
            The IMU's mount is unknown.
        """
        if parameters.gravity == 'none':
            return None
        if parameters.gravity == 'base_frame':
            return np.asarray(camera_from_base[:3, :3] @ _UP)
        with self._lock:
            imu_frame, samples = self._imu_frame, list(self._samples)
        at_ns, topic = stamp_ns(stamp), self._node.resolve_topic_name('imu')
        near = [sample for sample in samples if abs(sample.stamp_ns - at_ns) <= WINDOW_NS]
        if not near:
            raise NoVerticalError(self.problem or f'no message on {topic} within '
                                  f'{WINDOW_NS // 1_000_000} ms of the image')
        if not imu_frame:
            raise NoVerticalError(f'{topic} has no frame_id, so its mount is unknown: set it')
        up_in_imu = mean_up(near, samples, topic)
        if imu_frame == camera_frame:
            return up_in_imu
        camera_from_imu = camera_from_base if imu_frame == parameters.base_frame else \
            self._transforms.camera_from_base(imu_frame, [], camera_frame, stamp,
                                              parameters.tf_timeout_s)
        return np.asarray(camera_from_imu[:3, :3] @ up_in_imu)


def mean_up(near: Sequence[Sample], samples: Sequence[Sample], topic: str) -> NDArray[np.float64]:
    """Return the mean vertical (3,), a unit vector in the IMU's frame, of samples near an image.

    It is the mean of their orientations, or without orientations, of their accelerations. The
    orientations must agree with gravity in all recent `samples` of the topic. NoVerticalError:
    see VerticalSource.up_in_camera.
    """
    ups = [sample.up for sample in near if sample.up is not None]
    if not ups:
        mean = np.mean([sample.acceleration for sample in near
                        if sample.acceleration is not None], axis=0)
        if not _is_gravity(mean):
            raise NoVerticalError(
                f'the IMU is moving: it measures {np.linalg.norm(mean):.2f} m/s^2, at rest '
                f'{_STANDARD_GRAVITY:.2f}')
        return np.asarray(mean / np.linalg.norm(mean))
    # all samples, not only those around the image: acceleration and braking of the robot deflect
    # the vertical briefly
    cosines = [float(sample.up @ sample.acceleration) / float(np.linalg.norm(sample.acceleration))
               for sample in samples if sample.up is not None and sample.acceleration is not None
               and _is_gravity(sample.acceleration)] or [1.0]
    contradiction_deg = float(np.degrees(np.median(np.arccos(np.clip(cosines, -1.0, 1.0)))))
    if contradiction_deg > _MAX_CONTRADICTION_DEG:
        raise NoVerticalError(
            f'the orientation of {topic} is {contradiction_deg:.0f} degrees off gravity (limit '
            f'{_MAX_CONTRADICTION_DEG:g}): correct it, or set orientation_covariance[0] to -1')
    mean = np.mean(ups, axis=0)
    length = float(np.linalg.norm(mean))
    if not length > _MIN_MEAN_LENGTH:
        raise NoVerticalError('the IMU turns too fast: its orientations around the image differ')
    return np.asarray(mean / length)


def _is_gravity(acceleration: NDArray[np.float64]) -> bool:
    return bool(abs(np.linalg.norm(acceleration) - _STANDARD_GRAVITY) <= _MAX_ACCELERATION)


class LaserSource:
    """Subscribes to scans and the grid while the node is active, if the parameter scan is set."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscriptions = list[qos.AdaptiveSubscription]()
        #: The last scans, oldest first
        self.scans = deque[LaserScan](maxlen=_MOST_SCANS)
        self._heard_at = -math.inf
        # The current grid, or why it is invalid.
        self._grid: OccupancyGrid | None = None
        self._fault = ''

    def open(self, parameters: RelocalizerParameters) -> None:
        """Subscribe to the topics that the parameters name."""
        topics = [(LaserScan, parameters.scan, self.take, qos.SCAN),
                  (OccupancyGridMsg, '' if parameters.grid_file else parameters.grid,
                   lambda msg: self.use(lambda: grid_from_msg(msg)), qos.LATCHED)]
        self._subscriptions = [qos.AdaptiveSubscription(self._node, *topic) for topic in topics
                               if parameters.scan and topic[1]]

    def close(self) -> None:
        """Unsubscribe, and forget the scans."""
        while self._subscriptions:
            self._subscriptions.pop().destroy()
        self.scans.clear()

    def take(self, msg: LaserScan) -> None:
        """Keep a scan."""
        msg.intensities, self._heard_at = [], time.monotonic()
        if self.scans and _between_ns(self.scans[-1], msg.header) > 0:  # time jumped back
            self.scans.clear()
        self.scans.append(msg)

    def use(self, read: Callable[[], OccupancyGrid]) -> None:
        """Replace the grid; an invalid grid replaces it, too, because the former is outdated."""
        try:
            grid, self._fault = read(), ''
            _ = grid.field  # no request waits for it
            self._grid = grid
        except CliplocError as error:
            self._grid, self._fault = None, str(error)

    def problem(self, parameters: RelocalizerParameters) -> str:
        """Return why scans or the grid are missing, and the remedy; empty without a problem."""
        is_silent = time.monotonic() - self._heard_at > parameters.stale_after_s
        if not parameters.scan or not (is_silent or (self._grid is None and not self._fault)):
            return self._fault
        name, kind = ('scan', LaserScan) if is_silent else ('grid', OccupancyGridMsg)
        return qos.why_silent(self._node, name, qos.resolved(
            self._node, getattr(parameters, name)), kind)

    def near(self, image: Header, parameters: RelocalizerParameters, frame_ids: Sequence[str]
             ) -> tuple[LaserScan, OccupancyGrid]:
        """Return the scan that is nearest to an image, and the grid of a map with these frames.

        OptionsError: there is none, or the grid is of no map.
        """
        grid, scan = self._grid, min(tuple(self.scans), default=None,
                                     key=lambda scan: abs(_between_ns(scan, image)))
        if scan is None or grid is None or abs(_between_ns(scan, image)) > _LATEST_NS:
            raise OptionsError(self.problem(parameters) or 'no scan within '
                               f'{_LATEST_NS / NS_PER_S} s of the image: stamp both by one clock')
        if grid.frame_id not in frame_ids:
            raise OptionsError(f"the grid is in frame '{grid.frame_id}', the map in "
                               f"'{', '.join(frame_ids)}': correct the frame_id of one of them")
        return scan, grid


def _between_ns(scan: LaserScan, other: Header) -> int:
    return stamp_ns(scan.header.stamp) - stamp_ns(other.stamp)


@dataclass(frozen=True)
class RobotState:
    """The robot at the stamp of one image."""

    #: The mount (4, 4); identity without base_frame.
    camera_from_base: NDArray[np.float64]
    #: The vertical, a unit vector (3,) in the camera's optical frame; None if unknown.
    up_in_camera: NDArray[np.float64] | None = None
    #: Pose of the camera by odometry; None if odometry does not cover the image.
    place: OdometryPlace | None = None
    #: Pose (4, 4) of a depth camera that is not registered; None if unknown to tf2
    camera_from_depth: NDArray[np.float64] | None = None
    #: The scan of the laser, and the grid that it shows; None if they are unknown or not asked for
    scan: Scan | None = None
    grid: OccupancyGrid | None = None
    no_scan: str = ''  #: Why it is unknown


class KnownBefore(NamedTuple):
    """Prior knowledge about the instant of a frame."""

    state: RobotState  #: The robot at the stamp of the frame to localize
    #: The frames of other cameras with known mounts, and the robot's state at their stamps
    beside: Sequence[tuple[Frame, RobotState]] = ()
    region: Region | None = None  #: The prior of the robot's pose


class RobotStateSource:
    """Gathers the mount, the vertical and odometry while the node is active."""

    def __init__(self, node: ManagedNode[RelocalizerParameters]) -> None:
        self._node = node
        self.transforms = CoordinateFrames(node)
        self.odometry = OdometrySource(node)
        self.vertical = VerticalSource(node, self.transforms)
        self.prior, self.laser = PriorSource(node, self.transforms), LaserSource(node)
        self._unknown = set[str]()  # coordinate frames that tf2 did not know the last time
        #: Why optional inputs were not used for the newest image, by input
        self.problems: dict[str, str] = {}

    def open(self) -> None:
        """Subscribe to the inputs that the parameters select."""
        parameters = self._node.settings.values
        self.vertical.open(parameters.gravity)
        self.prior.open(parameters)
        self.odometry.open()
        self.laser.open(parameters)
        remedy = 'set publish_tf: false' if parameters.publish_tf else 'set watch: amcl_pose' \
            if parameters.watch == 'tf' else 'set base_from_camera' \
            if parameters.base_frame and not any(parameters.base_from_camera) else ''
        if remedy:  # in the worker, because importing tf2 takes long
            self._node.worker.run(partial(self.transforms.open, remedy=remedy))

    def close(self) -> None:
        """Unsubscribe."""
        self.odometry.close()
        self.vertical.close()
        self.prior.close()
        self.laser.close()
        self._node.worker.submit(self.transforms.close)  # after a search that may be running

    def forget(self) -> None:
        """Forget all messages: time jumped."""
        self.transforms.forget()
        self.vertical.forget()
        self.odometry.forget()
        self.laser.scans.clear()

    def examine(self, health: Health) -> None:
        """Report invalid messages of odometry and the IMU, and why the laser is not used."""
        for problem in (self.odometry.problem, self.vertical.problem, self.problems.get(
                'scan', self.laser.problem(self._node.settings.values))):
            if problem:
                health.warn(problem)

    def is_linked_soon(self, stamp: Time, deadline: float) -> bool:
        """Return whether odometry can link the next frame after an image.

        Waits for odometry that has just begun, until `deadline` (monotonic clock) [s].
        """
        patience_s = min(_DISCOVERY_S, max(0.0, deadline - time.monotonic()))
        return (self._node.settings.values.fuse_frames > 1
                and self.odometry.covers_soon(stamp, patience_s))

    def at_instant(self, frame: Frame, parameters: RelocalizerParameters,
                   frame_ids: Sequence[str], map_hash: str, deadline: float = math.inf
                   ) -> KnownBefore:
        """Return the prior knowledge at the instant of a frame; see `at`.

        `frame_ids` and `map_hash` are those of the loaded maps.
        """
        header = frame.image.header
        state = self.at(header, parameters.of_camera(frame.camera), deadline, frame.depth_frame,
                        frame.camera_info, frame_ids)
        beside = []
        for other in frame.beside:
            soon = min(deadline, time.monotonic() + parameters.tf_timeout_s)
            try:
                beside.append((other, self.at(other.image.header,
                                              parameters.of_camera(other.camera), soon,
                                              other.depth_frame, other.camera_info)))
            except NoTransformError as error:
                self._warn(other.camera, f'localizing without {other.camera}: {error}')
        return KnownBefore(state, beside, self.prior.region(
            header.stamp, parameters, state.camera_from_base, frame_ids, map_hash))

    def at(self, image: Header, parameters: RelocalizerParameters, deadline: float = math.inf,
           depth_frame: str = '', info: CameraInfo | None = None, frame_ids: Sequence[str] = ()
           ) -> RobotState:
        """Return the robot's state at the stamp of an image.

        Vertical, odometry, and the pose of unregistered depth are optional, and so is the scan,
        which is asked for by the frames of the maps. `info` of the second
        camera of a stereo pair puts this camera beside its frame, see messages.camera_from_frame.

        The wait for the mount takes at most half of the time until `deadline` (monotonic clock)
        [s], so that half remains for a newer image.

        NoTransformError: the mount is unknown.
        """
        begun_s, wait_s, camera_from_base = time.monotonic(), parameters.tf_timeout_s, None
        until = begun_s + wait_s if math.isinf(deadline) else 0.5 * (begun_s + deadline)
        while camera_from_base is None:
            try:
                camera_from_base = self.transforms.camera_from_base(
                    parameters.base_frame, parameters.base_from_camera, image.frame_id,
                    image.stamp, min(wait_s, max(0.0, until - time.monotonic())))
            except NoTransformError:
                if time.monotonic() + _RETRY_S > until:
                    raise
                self._node.check_active()
                time.sleep(_RETRY_S)
        from_frame = np.eye(4) if info is None else camera_from_frame(info)
        camera_from_base, up_in_camera = from_frame @ camera_from_base, None
        try:
            up_in_camera = self.vertical.up_in_camera(parameters, camera_from_base,
                                                       image.frame_id, image.stamp)
            self.problems.pop('vertical', None)
        except (NoVerticalError, NoTransformError) as error:
            self._warn('vertical', f'localizing without the vertical: {error}')
        camera_from_depth = None
        if depth_frame not in ('', image.frame_id):
            with suppress(NoTransformError):  # depths_from_msg reports it
                camera_from_depth = from_frame @ self._lookup(image, depth_frame, parameters)

        def mount_of(frame: str) -> NDArray[np.float64]:
            return from_frame if frame == image.frame_id else camera_from_base if (
                frame == parameters.base_frame) else from_frame @ self._lookup(
                    image, frame, parameters)
        return RobotState(
            camera_from_base, up_in_camera, self._place(image, parameters, mount_of),
            camera_from_depth, *(self._scan(image, parameters, mount_of, frame_ids)
                                 if frame_ids and parameters.scan else ()))

    def _scan(self, image: Header, parameters: RelocalizerParameters, mount_of: MountOf,
              frame_ids: Sequence[str]) -> tuple[Scan | None, OccupancyGrid | None, str]:
        """Return the scan as it is seen from the image, and its grid, or why it is unknown."""
        try:
            msg, grid = self.laser.near(image, parameters, frame_ids)
            mount = np.array(parameters.base_from_laser)
            camera_from_laser = mount_of(msg.header.frame_id) if not mount.any() else mount_of(
                parameters.base_frame) @ transform_from_pose(mount[:3], mount[3:])
            # without odometry, the robot is assumed to be at rest for a moment
            with suppress(*[NoOdometryError] * (abs(_between_ns(msg, image)) <= _UNLINKED_NS)):
                motion, body = self.odometry.motion(image.stamp, msg.header.stamp, _PATIENCE_S)
                camera_from_laser = mount_of(body) @ motion @ invert_transform(
                    mount_of(body)) @ camera_from_laser
            found = Scan(*scan_from_msg(msg), camera_from_laser)
        except CliplocError as error:
            self._warn('scan', f'localizing without the scan: {error}')
            return None, None, str(error)
        self.problems.pop('scan', None)
        return found, grid, ''

    def _place(self, image: Header, parameters: RelocalizerParameters, mount_of: MountOf
               ) -> OdometryPlace | None:
        if parameters.fuse_frames == 1:
            return None
        try:
            body = self.odometry.pose_at(image.stamp)
            camera_from_body = mount_of(body.frame)
        except NoOdometryError as error:
            if self.odometry.is_published:
                self.problems['odometry'] = f'localizing without odometry: {error}'
            return None
        except NoTransformError as error:
            self._warn('odometry', f'localizing without odometry: {error}')
            return None
        self.problems.pop('odometry', None)
        return body._replace(
            odom_from_frame=body.odom_from_frame @ invert_transform(camera_from_body),
            frame=image.frame_id)

    def _lookup(self, image: Header, frame: str, parameters: RelocalizerParameters
                ) -> NDArray[np.float64]:
        """Return camera_from_frame; wait for a frame only if it was known the last time."""
        timeout_s = 0.0 if frame in self._unknown else parameters.tf_timeout_s
        self._unknown.add(frame)
        found = self.transforms.lookup(image.frame_id, frame, image.stamp, timeout_s,
                                       f'set base_frame to {frame}, and base_from_camera, or '
                                       'base_from_laser')
        self._unknown.discard(frame)
        return found

    def _warn(self, what: str, text: str) -> None:
        """Log a problem that is new: tf2_ros that is missing lacks at each request."""
        if text != self.problems.get(what):
            self._node.get_logger().warning(text, throttle_duration_sec=LOG_PERIOD_S)
        self.problems[what] = text

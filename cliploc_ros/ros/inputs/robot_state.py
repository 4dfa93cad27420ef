# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What the robot knows besides its image: mount, vertical, odometry, and where it was."""

import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.core.observation import Region
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.inputs.frame_source import Frame
from cliploc_ros.ros.inputs.odometry import NoOdometryError, OdometrySource
from cliploc_ros.ros.inputs.prior import PriorSource
from cliploc_ros.ros.inputs.vertical import NoVerticalError, VerticalSource
from cliploc_ros.ros.node.diagnostics import Health
from cliploc_ros.ros.node.lifecycle import ManagedNode
from cliploc_ros.ros.parameters import RelocalizerParameters

_LOG_PERIOD_S = 5.0
_RETRY_S = 0.02
# Time for a publisher of odometry that has just been discovered to deliver its first message.
_DISCOVERY_S = 1.0


@dataclass(frozen=True)
class CameraPlace:
    """Where odometry had the camera."""

    odom_from_camera: NDArray[np.float64]
    #: Places of one run share their odometry frame.
    run: int
    #: Driven since the run began.
    way_m: float


@dataclass(frozen=True)
class RobotState:
    """The robot at the stamp of one image."""

    #: The mount (4, 4); identity where the camera's own pose is wanted.
    camera_from_base: NDArray[np.float64]
    #: The vertical, a unit vector (3,) in the camera's optical frame; None where it is not known.
    up_in_camera: NDArray[np.float64] | None = None
    #: None where odometry does not cover the image.
    place: CameraPlace | None = None
    #: (4, 4): the pose of a depth camera that is not registered; None where tf2 lacks it
    camera_from_depth: NDArray[np.float64] | None = None


class KnownBefore(NamedTuple):
    """What is known at an instant besides its messages."""

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
        """Subscribe to what the parameters ask for."""
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
        """Report stamps of odometry and of the IMU that are no time."""
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
        """Return what is known at the instant of a frame, given the maps; see at."""
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
               camera_from_base: NDArray[np.float64]) -> CameraPlace | None:
        if parameters.fuse_frames == 1:
            return None
        try:
            body = self.odometry.pose_at(image.stamp)
            if body.body_frame == image.frame_id:
                return CameraPlace(body.odom_from_body, body.run, body.way_m)
            camera_from_body = camera_from_base
            if body.body_frame != parameters.base_frame:
                camera_from_body = self._lookup(image, body.body_frame, parameters)
        except NoOdometryError as error:
            self._node.get_logger().debug(f'one frame alone: {error}')
            return None
        except NoTransformError as error:
            self._warn(f'one frame alone: {error}')
            return None
        return CameraPlace(body.odom_from_body @ invert_transform(camera_from_body), body.run,
                           body.way_m)

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

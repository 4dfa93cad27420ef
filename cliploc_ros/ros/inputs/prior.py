# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The prior: the probable pose of the robot before an image.

A message on `~/prior` is used until the next one. Without a message, the prior is the last pose of
the previous run: accepted poses, and later poses of the localizer, are stored in a file. This
prior is used until the first pose is accepted.
"""

import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.subscription import Subscription
from std_msgs.msg import Header

from cliploc_ros.core.geometry.transforms import SAME_SPOT, is_rigid
from cliploc_ros.core.observation import OPTICAL_FROM_BODY, Region, check_planar
from cliploc_ros.errors import CliplocError, OptionsError
from cliploc_ros.files.storage import parse_json, read_file, write_text
from cliploc_ros.ros import qos
from cliploc_ros.ros.conversions import pose_from_msg, pose_with_covariance_msg
from cliploc_ros.ros.inputs.coordinate_frames import CoordinateFrames, NoTransformError
from cliploc_ros.ros.node.lifecycle import LOG_PERIOD_S, ManagedNode
from cliploc_ros.ros.parameters import RelocalizerParameters

# Least time between two stored poses of a localizer [s].
_WRITE_PERIOD_S = 1.0
_PLANAR = np.array([0, 1, 5])  # x, y and yaw in a covariance of ROS
_LEVEL_COSINE = 0.7


class PriorSource:
    """Receives priors, and stores the robot's last pose."""

    def __init__(self, node: ManagedNode[RelocalizerParameters], transforms: CoordinateFrames
                 ) -> None:
        self._node, self._transforms = node, transforms
        # The last message.
        self._told: PoseWithCovarianceStamped | None = None
        # The last pose of the previous run and the hash of its map, until a pose is accepted.
        self._last: tuple[PoseWithCovarianceStamped, str] | None = None
        # The pose that was stored last, its time, and the hash of the current map.
        self._written: NDArray[np.float64] | None = None
        self._written_at, self._map_hash, self._warned = 0.0, '', ''
        self._subscriptions: list[Subscription] = []

    def open(self, parameters: RelocalizerParameters) -> None:
        """Subscribe, and read the last pose."""
        if self._subscriptions:
            return
        # a volatile publisher does not match a transient local subscription
        group = MutuallyExclusiveCallbackGroup()
        self._subscriptions = [self._node.create_subscription(
            PoseWithCovarianceStamped, '~/prior', self.hear, profile, callback_group=group)
            for profile in (qos.LATCHED, qos.POSE)]
        if parameters.last_pose_file and self._written is None:
            self._last = self._read(Path(parameters.last_pose_file))

    def close(self) -> None:
        """Unsubscribe."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []

    def hear(self, msg: PoseWithCovarianceStamped) -> None:
        """Use a message as prior. An empty frame_id withdraws the prior."""
        self._told = msg if msg.header.frame_id else None

    def region(self, stamp: Time, parameters: RelocalizerParameters,
               camera_from_base: NDArray[np.float64], frame_ids: Sequence[str], map_hash: str
               ) -> Region | None:
        """Return the prior at a stamp in one of the maps with these frames; None without a prior.

        `map_hash` is that of the loaded map: a stored pose of another map is not used.
        """
        told, probability = self._told, parameters.prior_probability
        last = self._last  # read once, because a request may drop it
        if told is None and last is not None and last[1] == map_hash:
            told, probability = last[0], parameters.last_pose_probability
        if told is None:
            return None
        try:
            return self._region(told, probability, stamp, parameters, camera_from_base, frame_ids)
        except CliplocError as error:
            self._warn(f'localizing without the prior: {error}')
            return None

    def keep(self, accepted: PoseWithCovarianceStamped, parameters: RelocalizerParameters,
             map_hash: str) -> None:
        """Store an accepted pose for the next run, and stop using the pose of the last run."""
        self._last, self._map_hash = None, map_hash
        self._store(accepted, parameters)

    def follow(self, shown: PoseWithCovarianceStamped) -> None:
        """Store a pose of the localizer, if a pose was accepted before."""
        if self._map_hash and time.monotonic() - self._written_at >= _WRITE_PERIOD_S:
            self._store(shown, self._node.settings.snapshot())

    def _store(self, pose: PoseWithCovarianceStamped, parameters: RelocalizerParameters) -> None:
        """Store a pose if the robot has moved. The worker writes it after its other tasks."""
        if not parameters.last_pose_file:
            return
        try:
            at, _ = planar_of(pose)
        except CliplocError:
            return  # an invalid pose of the localizer
        if self._written is None or not SAME_SPOT.agree(at, self._written):
            self._written, self._written_at = at, time.monotonic()
            fields = {'map_hash': self._map_hash, 'frame_id': pose.header.frame_id,
                      'written': time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime()),
                      'map_from_robot': at.tolist(),
                      'covariance': np.reshape(pose.pose.covariance, (6, 6)).tolist()}
            self._node.worker.submit(partial(self._write, Path(parameters.last_pose_file),
                                             json.dumps(fields, indent=1)))

    def _write(self, path: Path, text: str) -> None:
        try:
            write_text(path, text)
        except CliplocError as error:
            self._warn(f'last_pose_file {error}')

    def _read(self, path: Path) -> tuple[PoseWithCovarianceStamped, str] | None:
        """Return the last pose and the hash of its map; None without a valid file."""
        try:
            fields: dict[str, Any] = parse_json(read_file(path))
            pose = np.array(fields['map_from_robot'], dtype=np.float64)
            if not is_rigid(pose):
                raise ValueError('map_from_robot is not a pose')
            msg = pose_with_covariance_msg(Header(), pose, np.array(
                fields['covariance'], dtype=np.float64).reshape(6, 6))
            msg.header.frame_id = str(fields['frame_id'])
            planar_of(msg)
            return msg, str(fields['map_hash'])
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError, OverflowError, CliplocError) as error:
            self._node.get_logger().warning(f'last_pose_file {path}: not used: {error}')
            return None

    def _region(self, told: PoseWithCovarianceStamped, probability: float, stamp: Time,
                parameters: RelocalizerParameters, camera_from_base: NDArray[np.float64],
                frame_ids: Sequence[str]) -> Region:
        """Convert a pose to a region of a map. NoTransformError: its frame is unknown to tf2."""
        pose, covariance = planar_of(told)
        frame_id = told.header.frame_id.lstrip('/')
        if frame_id not in frame_ids:
            map_from_frame = self._transforms.lookup(
                frame_ids[0], frame_id, stamp, parameters.tf_timeout_s,
                'publish the prior in the frame of the map')
            if not is_rigid(map_from_frame):
                raise NoTransformError(f"the transform of '{frame_id}' is not a pose: correct it")
            pose, turn = map_from_frame @ pose, np.eye(3)
            turn[:2, :2] = map_from_frame[:2, :2]
            covariance, frame_id = turn @ covariance @ turn.T, frame_ids[0]
        camera_from_body = camera_from_base
        if not parameters.base_frame:
            camera_from_body = OPTICAL_FROM_BODY
            if pose[2, 2] < _LEVEL_COSINE:  # axes of a camera; poses from RViz are level bodies
                pose = pose @ OPTICAL_FROM_BODY
        mean = np.array([*pose[:2, 3], np.arctan2(pose[1, 0], pose[0, 0])])
        return Region(frame_id, mean, covariance, probability, camera_from_body)

    def _warn(self, text: str) -> None:
        if text != self._warned:
            self._node.get_logger().warning(text, throttle_duration_sec=LOG_PERIOD_S)
        self._warned = text


def planar_of(msg: PoseWithCovarianceStamped) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a pose (4, 4) and the covariance (3, 3) of x, y and yaw.

    The covariances of yaw with x and y are set to 0. CliplocError: pose or covariance is invalid.
    """
    pose = pose_from_msg(msg.pose.pose)
    covariance = np.reshape(msg.pose.covariance, (6, 6))[np.ix_(_PLANAR, _PLANAR)]
    if pose is None:
        raise OptionsError('the pose has NaN or a quaternion that is not of unit length')
    covariance = 0.5 * covariance + 0.5 * covariance.T  # a sum could overflow
    covariance[2, :2] = covariance[:2, 2] = 0.0
    check_planar(covariance)
    return pose, covariance

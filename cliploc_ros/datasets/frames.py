# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Frames (image, camera and true pose of one stamp) of TUM folders and recordings."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.datasets.bag_messages import stamp_ns
from cliploc_ros.datasets.bag_reader import BagReader
from cliploc_ros.datasets.trajectory import Trajectory
from cliploc_ros.datasets.tum import TumSequence
from cliploc_ros.errors import CliplocError, DatasetError
from cliploc_ros.messages import camera_from_msg, image_from_msg
from cliploc_ros.units import NS_PER_S

_IMAGES = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
_CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
# How to get the pose of each message type.
_POSES: dict[str, Callable[[Any], Any]] = {
    'geometry_msgs/msg/PoseStamped': lambda message: message.pose,
    'geometry_msgs/msg/PoseWithCovarianceStamped': lambda message: message.pose.pose,
    'nav_msgs/msg/Odometry': lambda message: message.pose.pose,
}


@dataclass(frozen=True)
class Frame:
    """An image (h, w, 3) uint8, red first, with the camera and the true pose of its stamp.

    ``map_from_camera`` is None where no ground truth lies within 20 ms of ``stamp_ns``.
    """

    stamp_ns: int
    image_rgb: NDArray[np.uint8]
    camera: Camera
    map_from_camera: NDArray[np.float64] | None


@dataclass(frozen=True)
class Frames:
    """Frames of a source. Each iteration reads it again, with one image in memory at a time.

    Parameters
    ----------
    source : Path
        Folder or file.
    count : int
        Number of frames.
    read : callable
        Returns a new iterator over the frames.
    """

    source: Path
    count: int
    read: Callable[[], Iterator[Frame]]


@dataclass(frozen=True)
class BagTopics:
    """The topics of a recording that hold images, intrinsics and ground truth.

    Parameters
    ----------
    image, camera_info : str
        sensor_msgs/Image or CompressedImage, and CameraInfo.
    ground_truth : str
        geometry_msgs/PoseStamped, PoseWithCovarianceStamped or nav_msgs/Odometry: the pose in the
        map of the camera (optical axes), or of a body on which the camera is mounted.
    rectified : bool
        Whether images are rectified: then P of CameraInfo holds, without distortion.
    """

    image: str = '/image'
    camera_info: str = '/camera_info'
    ground_truth: str = '/ground_truth'
    rectified: bool = False


def tum_frames(sequence: TumSequence, camera: Camera) -> Frames:
    """Return the frames of a TUM folder, taken by one camera."""
    def read() -> Iterator[Frame]:
        for stamp, path in zip(sequence.stamps_ns, sequence.image_paths, strict=True):
            image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            if image is None:
                raise DatasetError(f'{path} cannot be read as an image')
            if image.shape[:2] != (camera.height, camera.width):
                raise DatasetError(f'{path} has {image.shape[1]}x{image.shape[0]} px, but the '
                                   f'camera has {camera.width}x{camera.height} px')
            yield Frame(stamp, np.ascontiguousarray(image[..., ::-1]), camera,
                        sequence.pose_at(stamp))
    return Frames(sequence.folder, len(sequence), read)


def bag_frames(bag: Path, topics: BagTopics, body_from_camera: NDArray[np.float64] | None = None
               ) -> Frames:
    """Return the frames of a recording.

    Parameters
    ----------
    bag : Path
        A rosbag2 folder or file.
    topics : BagTopics
    body_from_camera : ndarray (4, 4), optional
        Mount of the camera on the body whose pose is the ground truth.

    Raises
    ------
    DatasetError
        If a topic is missing, empty or of another type; the message lists the topics.
    """
    mount = np.eye(4) if body_from_camera is None else body_from_camera
    with BagReader(bag) as reader:
        for name, types in ((topics.image, _IMAGES), (topics.camera_info, (_CAMERA_INFO,)),
                            (topics.ground_truth, tuple(_POSES))):
            topic = reader.topic(name)
            if topic.msgtype not in types:
                raise DatasetError(f'{bag}: {name} is of type {topic.msgtype}, not '
                                   f'{" or ".join(types)}')
            if topic.message_count == 0:
                raise DatasetError(f'{bag}: {name} has no messages')
        truth = _read_trajectory(reader, topics.ground_truth)
        count = reader.topic(topics.image).message_count

    def read() -> Iterator[Frame]:
        with BagReader(bag) as reader:
            info = None
            infos = next(reader.messages([topics.camera_info]), None)
            if infos is not None:
                info = reader.deserialize(infos)
            for recorded in reader.messages([topics.image]):
                yield _frame(bag, reader.deserialize(recorded), info, topics, truth, mount)
    return Frames(bag, count, read)


def _frame(bag: Path, message: Any, info: Any, topics: BagTopics, truth: Trajectory,
           mount: NDArray[np.float64]) -> Frame:
    stamp = stamp_ns(message)
    try:
        image = image_from_msg(message)
        camera = camera_from_msg(info, (image.shape[1], image.shape[0]), topics.rectified)
    except CliplocError as error:
        raise DatasetError(f'{bag}: {topics.image} at {stamp / NS_PER_S:.6f}: {error}') from error
    pose = truth.pose_at(stamp)
    return Frame(stamp, image, camera, None if pose is None else pose @ mount)


def _read_trajectory(reader: BagReader, name: str) -> Trajectory:
    pose_of = _POSES[reader.topic(name).msgtype]
    stamps, positions, quats = [], [], []
    for recorded in reader.messages([name]):
        message = reader.deserialize(recorded)
        p, q = pose_of(message).position, pose_of(message).orientation
        stamps.append(stamp_ns(message))
        positions.append((p.x, p.y, p.z))
        quats.append((q.x, q.y, q.z, q.w))
    order = np.unique(np.array(stamps, dtype=np.int64), return_index=True)[1]
    quats_xyzw = np.array(quats)[order]
    norms = np.linalg.norm(quats_xyzw, axis=1, keepdims=True)
    valid = (np.isfinite(np.array(positions)[order]).all(axis=1)
             & (np.abs(norms[:, 0] - 1.0) < 0.01))
    if not valid.all():
        raise DatasetError(f'{reader.path}: {name}: {int((~valid).sum())} poses are not finite '
                           'or have no unit quaternion')
    return Trajectory(np.array(stamps, dtype=np.int64)[order], np.array(positions)[order],
                      quats_xyzw / norms)


def mount_from_numbers(numbers: list[float]) -> NDArray[np.float64]:
    """Return the mount (4, 4) for x y z [m] and a quaternion qx qy qz qw.

    Raises
    ------
    DatasetError
        If a number is not finite, or the quaternion is far from unit norm.
    """
    norm = float(np.linalg.norm(numbers[3:]))
    if not (np.isfinite(numbers).all() and abs(norm - 1.0) < 0.01):
        raise DatasetError(f'mount {numbers}: expected x y z and a unit quaternion qx qy qz qw')
    return transform_from_pose(np.array(numbers[:3]), np.array(numbers[3:]) / norm)

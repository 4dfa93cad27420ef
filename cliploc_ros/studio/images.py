# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The images of a recording, one at a time, by the time of a view."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.datasets.bag_frames import BagTopics, bag_images
from cliploc_ros.datasets.folders import tum_frames
from cliploc_ros.datasets.frames import read_color, undistorted
from cliploc_ros.datasets.intrinsics import find_camera
from cliploc_ros.datasets.poses import TrajectoryPoses
from cliploc_ros.datasets.tum import read_tum
from cliploc_ros.errors import DatasetError
from cliploc_ros.mapping.posed_detections import PosedDetections
from cliploc_ros.units import NS_PER_S

# A view and its image have the same stamp; files hold it to a microsecond or so.
_MAX_DELAY_NS = 20_000_000
_IMAGES_KEPT = 32


class Images:
    """The images of a folder or a recording.

    Parameters
    ----------
    stamps_ns : ndarray (F,) of int
        When each was taken [ns].
    read : callable
        Returns image and camera of a place, 0 to F - 1.
    """

    def __init__(self, stamps_ns: NDArray[np.int64],
                 read: Callable[[int], tuple[NDArray[np.uint8], Camera]]):
        self._stamps_ns = stamps_ns
        self._read: Callable[[int], NDArray[np.uint8]] = lru_cache(_IMAGES_KEPT)(
            lambda place: undistorted(*read(place)))

    def near(self, stamp_s: float) -> NDArray[np.uint8] | None:
        """Return the undistorted image (h, w, 3) of a time [s], red first; None without one."""
        if not len(self._stamps_ns):
            return None
        offsets = np.abs(self._stamps_ns - round(stamp_s * NS_PER_S))
        place = int(np.argmin(offsets))
        return self._read(place) if offsets[place] <= _MAX_DELAY_NS else None


def open_images(path: Path, topics: BagTopics) -> Images:
    """Open the images of a TUM folder or of a rosbag2 recording.

    Raises
    ------
    DatasetError
        It is neither, or its images cannot be read.
    """
    if not path.exists():
        raise DatasetError(f'{path}: no such folder or recording')
    if (path / 'rgb.txt').exists():
        sequence, camera = read_tum(path), find_camera(None, path)[0]
        return Images(np.array(sequence.stamps_ns, dtype=np.int64),
                      lambda place: read_color(sequence.image_paths[place], camera))
    images = bag_images(path, topics)
    return Images(images.times_ns[:, 0], images.read)


def views_of_folder(path: Path) -> PosedDetections:
    """Return the poses of a TUM folder with ground truth as views without boxes.

    Raises
    ------
    DatasetError
        It is no such folder.
    """
    if not (path / 'rgb.txt').exists():
        raise DatasetError(f'{path}: has no poses to look from; give --observations, too')
    sequence, camera = read_tum(path), find_camera(None, path)[0]
    poses = TrajectoryPoses(sequence.trajectory)
    tum_frames(sequence, camera)  # refuses a folder without poses
    posed = [(stamp, pose) for stamp in sequence.stamps_ns
             if (pose := poses.pose_at(stamp)) is not None]
    if not posed:
        raise DatasetError(f'{path}: no image has a pose')
    none = np.empty(0, dtype=np.int64)
    return PosedDetections(
        camera=camera.pinhole, map_from_camera=np.array([pose for _, pose in posed]),
        stamps_s=np.array([stamp for stamp, _ in posed]) / NS_PER_S,
        frame_offsets=np.zeros(len(posed) + 1, dtype=np.int64), bboxes_xyxy=np.empty((0, 4)),
        class_names=(), classes=none, scores=np.empty(0))

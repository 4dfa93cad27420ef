# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random access to the images of a folder or a rosbag2 recording."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import DepthImage
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.bag_frames import BagTopics, bag_images
from cliploc_ros.offline.datasets.folders import find_layout, read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions, RawFrame, folder_frames, undistorted
from cliploc_ros.offline.datasets.map_recording import MapRecording
from cliploc_ros.offline.mapping.posed_detections import PosedDetections, group_cameras
from cliploc_ros.units import NS_PER_S

# A view and its image have the same stamp, but files round it to about a microsecond.
_MAX_DELAY_NS = 20_000_000
_IMAGES_KEPT = 32
_NO_OPTIONS = FolderOptions()


class Images:
    """The images of a folder or a recording, found by stamp, and by camera in a recording."""

    def __init__(self, frames: Sequence[RawFrame], of_folder: bool = False):
        self.frames, self.of_folder = frames, of_folder
        self._stamps_ns = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
        self._cameras = np.array([frame.camera for frame in frames], dtype=np.str_)
        self._lock = threading.Lock()  # readers of recordings are not thread-safe
        self._read: Callable[[int, Camera | None], NDArray[np.uint8]] = lru_cache(_IMAGES_KEPT)(
            lambda place, pinhole: undistorted(*frames[place].color(), pinhole))

    def near(self, stamp_s: float, camera: str = '', pinhole: Camera | None = None
             ) -> NDArray[np.uint8] | None:
        """Return the undistorted image (h, w, 3) of a camera at a time [s], RGB.

        `pinhole` is the camera model of the result, such as that of the boxes; default: the
        camera's own. None: there is no image at that time.
        """
        place = self._place(stamp_s, camera)
        with self._lock:
            return None if place is None else self._read(place, pinhole)

    def of(self, detections: PosedDetections, view: int) -> NDArray[np.uint8] | None:
        """Return the undistorted image (h, w, 3) of a view, RGB; None if there is none."""
        return self.near(float(detections.stamps_s[view]), detections.name_of(view),
                         detections.camera_of(view))

    def depth_near(self, stamp_s: float, camera: str = ''
                   ) -> tuple[NDArray[np.uint8], Camera, DepthImage] | None:
        """Return a camera's distorted image at a time [s], its camera and its depth image."""
        place = self._place(stamp_s, camera)
        with self._lock:
            read_depth = None if place is None else self.frames[place].depth
            return None if place is None or read_depth is None else (
                *self.frames[place].color(), read_depth())

    def _place(self, stamp_s: float, camera: str) -> int | None:
        # the stamps of a folder are unique, whatever its cameras; NAME#1: see join_detections
        places = np.nonzero(np.isin(self._cameras, (camera, camera.partition('#')[0], '')))[0]
        if not len(places):
            return None
        offsets = np.abs(self._stamps_ns[places] - round(stamp_s * NS_PER_S))
        nearest = int(np.argmin(offsets))
        return int(places[nearest]) if offsets[nearest] <= _MAX_DELAY_NS else None


def images_of_recording(recording: MapRecording, cameras: Sequence[str]) -> Images | None:
    """Open the images of all recordings of a map; None if they are missing."""
    parts = [(open_images(part.source, BagTopics(
        part.image, part.camera_info, part.rectified, intrinsics=part.intrinsics),
        part.cameras or cameras, FolderOptions(
            part.intrinsics, images=part.images, layout=part.layout)),
        round(part.later_s * NS_PER_S)) for part in (recording, *recording.others) if part.source]
    return Images([replace(frame, stamp_ns=frame.stamp_ns + later_ns) for part, later_ns in parts
                   for frame in part.frames], parts[0][0].of_folder) if parts else None


def open_images(path: Path, topics: BagTopics, cameras: Sequence[str] = ('',),
                folder: FolderOptions = _NO_OPTIONS) -> Images:
    """Open the images of a folder, or of all given cameras of a rosbag2 recording.

    DatasetError: the path is neither, or a camera is missing.
    """
    if not path.exists():
        raise DatasetError(f'{path}: no such folder or recording')
    if (layout := find_layout(path, folder.layout)) is not None:
        capture = layout.read(path, folder)
        return Images(list(folder_frames(path, capture.files, capture.depth).read_raw(
            lambda place, stamp_ns, pose: True)), of_folder=True)
    return Images([frame for name in cameras
                   for frame in bag_images(path, topics.of_camera(name), name)])


def views_of_folder(path: Path) -> PosedDetections:
    """Read the poses of a folder as views without boxes; DatasetError: it has no poses."""
    layout = find_layout(path)
    if layout is None:
        raise DatasetError(f'{path}: has no camera poses; also give `observations`')
    capture = layout.read(path, FolderOptions())
    if not capture.is_metric:
        raise DatasetError(f'{path}: the unit of {layout.name} is unknown; also give '
                           '`observations`, which build_map writes with `scale`')
    posed = list(read_folder(path).read_raw(lambda place, stamp_ns, pose: pose is not None))
    if not posed:
        raise DatasetError(f'{path}: no image has a pose')
    each, rows, names = group_cameras([capture.files[raw.place].camera.pinhole for raw in posed])
    return PosedDetections(
        cameras=each, map_from_camera=np.array([raw.map_from_camera for raw in posed]),
        stamps_s=np.array([raw.stamp_ns for raw in posed]) / NS_PER_S,
        frame_offsets=np.zeros(len(posed) + 1, dtype=np.int64), bboxes_xyxy=np.empty((0, 4)),
        class_names=(), classes=np.empty(0, dtype=np.int64), scores=np.empty(0),
        camera_rows=None if names == ('',) else rows, camera_names=names)

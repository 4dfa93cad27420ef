# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Random access to the images of a folder or a rosbag2 recording."""

import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth_image import DepthImage
from cliploc_ros.errors import DatasetError
from cliploc_ros.offline.datasets.bag_frames import BagTopics, bag_images
from cliploc_ros.offline.datasets.captures.capture import FolderOptions
from cliploc_ros.offline.datasets.folders import find_layout, read_folder
from cliploc_ros.offline.datasets.frames import read_color, read_depth, undistorted
from cliploc_ros.offline.datasets.map_recording import MapRecording
from cliploc_ros.offline.mapping.posed_detections import (
    PosedDetections,
    group_cameras,
    names_of_group,
)
from cliploc_ros.units import NS_PER_S

# A view and its image have the same stamp, but files round it to about a microsecond.
_MAX_DELAY_NS = 20_000_000
_IMAGES_KEPT = 32
_NO_OPTIONS = FolderOptions()


class Images:
    """The images of a folder or a recording, by their stamps (F,) [ns].

    ``read`` returns the image and camera of an index, 0 to F - 1. ``cameras`` are the camera names
    (F,) of a recording; a folder needs none, because its stamps are unique. ``read_depth`` returns
    the depth image of an index, or None.
    """

    def __init__(self, stamps_ns: NDArray[np.int64],
                 read: Callable[[int], tuple[NDArray[np.uint8], Camera]],
                 cameras: Sequence[str] = (),
                 read_depth: Callable[[int], DepthImage | None] = lambda place: None):
        self._stamps_ns = stamps_ns
        self._read_raw, self._read_depth = read, read_depth
        self._cameras = np.array(cameras, dtype=np.str_)
        self._lock = threading.Lock()  # readers of recordings are not thread-safe
        self._read: Callable[[int, Camera | None], NDArray[np.uint8]] = lru_cache(_IMAGES_KEPT)(
            lambda place, pinhole: undistorted(*read(place), pinhole))

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
            depth = None if place is None else self._read_depth(place)
            return None if place is None or depth is None else (*self._read_raw(place), depth)

    def _place(self, stamp_s: float, camera: str) -> int | None:
        places = (np.nonzero(self._cameras == camera)[0] if len(self._cameras)
                  else np.arange(len(self._stamps_ns)))
        if not len(places):
            return None
        offsets = np.abs(self._stamps_ns[places] - round(stamp_s * NS_PER_S))
        nearest = int(np.argmin(offsets))
        return int(places[nearest]) if offsets[nearest] <= _MAX_DELAY_NS else None


def images_of_recording(recording: MapRecording, cameras: Sequence[str]) -> Images | None:
    """Open the images that a map was built from; None if they are missing."""
    if recording.source is None:
        return None
    return open_images(recording.source, BagTopics(
        recording.image, recording.camera_info, recording.rectified,
        intrinsics=recording.intrinsics), cameras, FolderOptions(
        recording.intrinsics, images=recording.images, layout=recording.layout))


def open_images(path: Path, topics: BagTopics, cameras: Sequence[str] = ('',),
                folder: FolderOptions = _NO_OPTIONS) -> Images:
    """Open the images of a folder, or of all given cameras of a rosbag2 recording.

    DatasetError: the path is neither, or a camera is missing.
    """
    if not path.exists():
        raise DatasetError(f'{path}: no such folder or recording')
    if (layout := find_layout(path, folder.layout)) is not None:
        capture = layout.read(path, folder)
        files = capture.files
        return Images(np.array([file.stamp_ns for file in files], dtype=np.int64),
                      lambda place: read_color(files[place]), (),
                      lambda place: (None if files[place].depth is None
                                     else read_depth(files[place], capture.depth)))
    of_cameras = [bag_images(path, topics.of_camera(name)) for name in cameras]
    places = [(images, place) for images in of_cameras for place in range(len(images.times_ns))]
    names = np.repeat(np.array(cameras), [len(images.times_ns) for images in of_cameras])
    return Images(np.concatenate([images.times_ns[:, 0] for images in of_cameras]),
                  lambda number: places[number][0].read(places[number][1]), names.tolist())


def views_of_folder(path: Path) -> PosedDetections:
    """Read the poses of a folder as views without boxes; DatasetError: it has no poses."""
    layout = find_layout(path)
    if layout is None:
        raise DatasetError(f'{path}: has no camera poses; also give --observations')
    capture = layout.read(path, FolderOptions())
    if not capture.is_metric:
        raise DatasetError(f'{path}: the unit of {layout.name} is unknown; also give '
                           '--observations, which build_map writes with --scale')
    posed, cameras = [], []
    for raw in read_folder(path).read_raw(lambda place, stamp_ns, pose: pose is not None):
        posed.append((raw.stamp_ns, raw.map_from_camera))
        cameras.append(capture.files[raw.place].camera.pinhole)
    if not posed:
        raise DatasetError(f'{path}: no image has a pose')
    each, rows = group_cameras(cameras)
    names = names_of_group(each)
    return PosedDetections(
        cameras=each, map_from_camera=np.array([pose for _, pose in posed]),
        stamps_s=np.array([stamp for stamp, _ in posed]) / NS_PER_S,
        frame_offsets=np.zeros(len(posed) + 1, dtype=np.int64), bboxes_xyxy=np.empty((0, 4)),
        class_names=(), classes=np.empty(0, dtype=np.int64), scores=np.empty(0),
        camera_rows=None if names == ('',) else rows, camera_names=names)

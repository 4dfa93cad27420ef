# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The recording of a map, NAME.recording.json next to NAME.yaml, and random access to its images.

``check_map`` and the studio use it to find observations and images. Its paths are relative to the
map, so that the folders can be moved together.
"""

import json
import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.depth import DepthImage
from cliploc_ros.core.geometry.transforms import is_rigid, make_transform
from cliploc_ros.core.map.parameter_file import check_set, set_of
from cliploc_ros.errors import DatasetError
from cliploc_ros.files.storage import open_file, parse_json, read_file, write_text
from cliploc_ros.offline.datasets.bag_frames import BagTopics, bag_images
from cliploc_ros.offline.datasets.folders import find_layout, read_folder
from cliploc_ros.offline.datasets.frames import FolderOptions, RawFrame, folder_frames, undistorted
from cliploc_ros.offline.datasets.observations import load_observations
from cliploc_ros.offline.mapping.posed_detections import (
    PosedDetections,
    group_cameras,
    names_of_group,
)
from cliploc_ros.units import NS_PER_S

# The comments at the head of a map are shorter than this [bytes].
_HEAD = 65_536
_PATHS = ('observations', 'source', 'images')
# A view and its image have the same stamp, but files round it to about a microsecond.
_MAX_DELAY_NS = 20_000_000
_IMAGES_KEPT = 32
_NO_OPTIONS = FolderOptions()


@dataclass(frozen=True)
class MapRecording:
    """The recording that a map was built from."""

    observations: Path
    source: Path | None = None  #: The bag or folder with the images; None if unknown
    #: For a bag: topics of image and camera_info, and whether images are rectified
    image: str = ''
    camera_info: str = ''
    rectified: bool = False
    #: For a folder: key of the layout, camera, and folder of the images
    layout: str = ''
    intrinsics: str | None = None
    images: Path | None = None
    #: The options that were given for the poses of a folder, see FolderOptions
    placing: dict[str, Any] = field(default_factory=dict)
    #: From poses of the observations to poses in the map: a factor of the positions, then a
    #: rotation (3, 3)
    scale: float = 1.0
    rotation: list[list[float]] = field(default_factory=lambda: np.eye(3).tolist())

    @property
    def is_moved(self) -> bool:
        """Return whether the poses of the map differ from those of the recording."""
        return self.scale != 1.0 or not np.array_equal(self.rotation, np.eye(3))

    def load(self) -> PosedDetections:
        """Read the observations, with poses in the map; DatasetError: they cannot be read."""
        return load_observations(self.observations).moved(self.scale, np.array(self.rotation))


def recording_path(map_file: Path) -> Path:
    """Return the file that describes the recording of a map."""
    return map_file.with_suffix('.recording.json')


def save_recording(map_file: Path, recording: MapRecording, place: Path | None = None,
                   set_digest: str = '') -> None:
    """Write the recording of a map next to it, or to another file in the same folder.

    CliplocError: the file cannot be written.
    """
    folder = map_file.resolve().parent
    values: dict[str, Any] = asdict(recording) | ({'set': set_digest} if set_digest else {})
    for name in _PATHS:
        if values[name] is not None:
            values[name] = os.path.relpath(values[name].resolve(), folder)
    write_text(place or recording_path(map_file), json.dumps(values, indent=1))


def load_recording(map_file: Path) -> MapRecording | None:
    """Read the recording of a map; None if there is none, or if its observations are missing.

    Missing images are None. DatasetError: the file is damaged.
    """
    path = recording_path(map_file)
    if not path.is_file():
        return None
    try:
        values = parse_json(read_file(path))
        digest = str(values.pop('set', ''))
        if digest and map_file.exists():
            with open_file(map_file) as file:
                check_set(digest, set_of(file.read(_HEAD).decode(errors='replace')).digest)
        paths = {name: map_file.resolve().parent / values[name] for name in _PATHS
                 if values.get(name) is not None}
        found = MapRecording(**(values | {
            name: path if path.exists() else None for name, path in paths.items()}))
        turn = np.array(found.rotation, dtype=float)
        is_valid = turn.shape == (3, 3) and 0.0 < found.scale < np.inf and is_rigid(
            make_transform(turn, np.zeros(3)))
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DatasetError(f'{path}: cannot be read: {error}; remove it') from error
    if not is_valid:
        raise DatasetError(f'{path}: has no valid scale and rotation; remove it')
    return None if found.observations is None else found


class Images:
    """The images of a folder or a recording, found by stamp, and by camera in a recording."""

    def __init__(self, frames: Sequence[RawFrame]):
        self._frames = frames
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
            read_depth = None if place is None else self._frames[place].depth
            return None if place is None or read_depth is None else (
                *self._frames[place].color(), read_depth())

    def _place(self, stamp_s: float, camera: str) -> int | None:
        # the stamps of a folder are unique, whatever its cameras
        places = np.nonzero((self._cameras == camera) | (self._cameras == ''))[0]
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
        return Images(list(folder_frames(path, capture.files, capture.depth).read_raw(
            lambda place, stamp_ns, pose: True)))
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

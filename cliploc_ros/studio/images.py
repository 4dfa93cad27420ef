# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The images of a recording, and the picture of a view: its image with boxes and landmarks."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.camera import Camera
from cliploc_ros.core.geometry.ellipsoid import (
    ellipses_in_pixels,
    outline_points,
    project_ellipsoids,
    shape_matrices,
)
from cliploc_ros.core.geometry.transforms import invert_transform
from cliploc_ros.datasets.bag_frames import BagTopics, bag_images
from cliploc_ros.datasets.depth import DepthImage
from cliploc_ros.datasets.folders import FolderOptions, find_layout, read_folder
from cliploc_ros.datasets.frames import read_color, read_depth, undistorted
from cliploc_ros.errors import DatasetError
from cliploc_ros.mapping.posed_detections import PosedDetections, group_cameras, names_of_group
from cliploc_ros.studio.landmark import Landmark
from cliploc_ros.units import NS_PER_S

SELECTED_RGB = (255, 220, 0)
_DRAWN_RGB = (255, 0, 220)
_DETECTED_RGB = (255, 255, 255)
_BLANK = 70
# A view and its image have the same stamp; files hold it to a microsecond or so.
_MAX_DELAY_NS = 20_000_000
_IMAGES_KEPT = 32
# More outlines hide the image, and a drag would wait for them.
_MAX_OUTLINES = 200
# Subpixel bits of OpenCV's drawing functions; larger coordinates overflow its integers.
_SHIFT = 4
_MAX_PIXEL = 20_000.0

#: x and y [px].
Pixel = Sequence[float] | NDArray[np.float64]


class Images:
    """The images of a folder or a recording, taken at stamps (F,) [ns].

    ``read`` returns image and camera of a place, 0 to F - 1; ``cameras`` are the names (F,) of
    several cameras; of a folder, whose stamps differ, the stamp is enough. ``read_depth`` returns
    the depth image of a place, or None.
    """

    def __init__(self, stamps_ns: NDArray[np.int64],
                 read: Callable[[int], tuple[NDArray[np.uint8], Camera]],
                 cameras: Sequence[str] = (),
                 read_depth: Callable[[int], DepthImage | None] = lambda place: None):
        self._stamps_ns = stamps_ns
        self._read_raw, self._read_depth = read, read_depth
        self._cameras = np.array(cameras, dtype=np.str_)
        self._read: Callable[[int, Camera | None], NDArray[np.uint8]] = lru_cache(_IMAGES_KEPT)(
            lambda place, pinhole: undistorted(*read(place), pinhole))

    def near(self, stamp_s: float, camera: str = '', pinhole: Camera | None = None
             ) -> NDArray[np.uint8] | None:
        """Return the undistorted image (h, w, 3) of a camera at a time [s], red first.

        It is as a pinhole shows it, such as that of the boxes. None without one.
        """
        place = self._place(stamp_s, camera)
        return None if place is None else self._read(place, pinhole)

    def depth_near(self, stamp_s: float, camera: str = ''
                   ) -> tuple[NDArray[np.uint8], Camera, DepthImage] | None:
        """Return a camera's image at a time [s], distorted as it is, with its depth image."""
        place = self._place(stamp_s, camera)
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


def open_images(path: Path, topics: BagTopics, cameras: Sequence[str] = ('',)) -> Images:
    """Open the images of a folder, or those of each camera of a rosbag2 recording.

    DatasetError: it is neither, or lacks a camera.
    """
    if not path.exists():
        raise DatasetError(f'{path}: no such folder or recording')
    if (layout := find_layout(path)) is not None:
        capture = layout.read(path, FolderOptions())
        files = capture.files
        return Images(np.array([one.stamp_ns for one in files], dtype=np.int64),
                      lambda place: read_color(files[place]), (),
                      lambda place: (None if files[place].depth is None
                                     else read_depth(files[place], capture.depth)))
    of_cameras = [bag_images(path, topics.of_camera(name)) for name in cameras]
    places = [(one, place) for one in of_cameras for place in range(len(one.times_ns))]
    names = np.repeat(np.array(cameras), [len(one.times_ns) for one in of_cameras])
    return Images(np.concatenate([one.times_ns[:, 0] for one in of_cameras]),
                  lambda number: places[number][0].read(places[number][1]), names.tolist())


def views_of_folder(path: Path) -> PosedDetections:
    """Return the poses of a folder as views without boxes; DatasetError: it has no poses."""
    layout = find_layout(path)
    if layout is None:
        raise DatasetError(f'{path}: has no poses to look from; give --observations, too')
    capture = layout.read(path, FolderOptions())
    if not capture.is_metric:
        raise DatasetError(f'{path}: {layout.name} does not know its unit; give --observations, '
                           'too: build_map makes them, with --scale')
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


class Outline(NamedTuple):
    """The outline of a landmark in a view: cx, cy, exx, exy, eyy [px]."""

    landmark_id: str
    ellipse: NDArray[np.float64]
    distance_m: float


def outlines_of(landmarks: Mapping[str, Landmark], camera: Camera,
                map_from_camera: NDArray[np.float64]) -> list[Outline]:
    """Return the outlines of the landmarks in a view, the nearest first."""
    if not landmarks:
        return []
    centers = np.array([one.center for one in landmarks.values()])
    shapes = shape_matrices(np.array([one.semi_axes for one in landmarks.values()]),
                            np.array([one.quat_xyzw for one in landmarks.values()]))
    camera_from_map = invert_transform(map_from_camera)
    ellipses = ellipses_in_pixels(project_ellipsoids(camera_from_map, centers, shapes), camera)
    distances = np.linalg.norm(centers - map_from_camera[:3, 3], axis=1)
    half = np.sqrt(ellipses[:, [2, 4]])
    with np.errstate(invalid='ignore'):
        inside = ((ellipses[:, :2] + half > 0.0).all(axis=1)
                  & (ellipses[:, :2] - half < (camera.width, camera.height)).all(axis=1))
    ids = list(landmarks)
    return sorted((Outline(ids[row], ellipses[row], float(distances[row]))
                   for row in np.nonzero(inside)[0]), key=lambda one: one.distance_m)


def landmark_at(outlines: Sequence[Outline], pixel: Pixel) -> str | None:
    """Return the landmark with the smallest outline around a pixel (2,)."""
    around = []
    for one in outlines:
        cx, cy, exx, exy, eyy = one.ellipse
        x, y = pixel[0] - cx, pixel[1] - cy
        determinant = exx * eyy - exy * exy
        if (eyy * x * x - 2.0 * exy * x * y + exx * y * y) <= determinant:
            around.append((determinant, one.landmark_id))
    return min(around)[1] if around else None


def box_at(boxes_xyxy: NDArray[np.float64], pixel: Pixel) -> int | None:
    """Return the row of the smallest box (n, 4) around a pixel (2,)."""
    x, y = pixel
    left, top, right, bottom = boxes_xyxy.T
    rows = np.nonzero((left <= x) & (x <= right) & (top <= y) & (y <= bottom))[0]
    areas = (right - left) * (bottom - top)
    return int(rows[np.argmin(areas[rows])]) if len(rows) else None


def draw(camera: Camera, image: NDArray[np.uint8] | None, boxes_xyxy: NDArray[np.float64],
         drawn_xyxy: Sequence[float] | None, outlines: Sequence[Outline],
         colors: Mapping[str, tuple[int, int, int]], selection: Sequence[str]
         ) -> NDArray[np.uint8]:
    """Return the picture (h, w, 3) of a view, red first; grey without an image.

    It shows the detector's boxes (n, 4), the box that a person drew (4,) [px], and the outlines
    in the colours of their landmarks, or in the selection's.
    """
    picture = np.full((camera.height, camera.width, 3), _BLANK, dtype=np.uint8)
    if image is not None and image.shape == picture.shape:
        picture = image.copy()
    for box in boxes_xyxy:
        _rectangle(picture, box, _DETECTED_RGB, 1)
    # the farthest first, so that the nearest lie on top
    shown = [one for number, one in enumerate(outlines)
             if number < _MAX_OUTLINES or one.landmark_id in selection]
    for one in reversed(shown):
        is_selected = one.landmark_id in selection
        points = outline_points(one.ellipse)
        if np.abs(points).max() < _MAX_PIXEL:
            cv2.polylines(picture, [np.round(points * 2**_SHIFT).astype(np.int32)], True,
                          SELECTED_RGB if is_selected else colors[one.landmark_id],
                          3 if is_selected else 2, cv2.LINE_AA, _SHIFT)
    if drawn_xyxy is not None:
        _rectangle(picture, np.array(drawn_xyxy), _DRAWN_RGB, 2)
    return picture


def _rectangle(picture: NDArray[np.uint8], box: NDArray[np.float64], rgb: tuple[int, int, int],
               width: int) -> None:
    left, top, right, bottom = (int(value) for value in np.clip(box, -_MAX_PIXEL, _MAX_PIXEL))
    cv2.rectangle(picture, (left, top), (right, bottom), rgb, width, cv2.LINE_AA)

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The surfaces around the landmarks, as a coloured cloud.

The points come from the recording's depth images, or without depth, from the keyframes. They are
thinned, and cut above the highest camera and landmark: a ceiling would hide the room from above.
"""

from typing import Any, NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from cliploc_ros.core.geometry.depth import points_in_color
from cliploc_ros.core.keyframes.layer import PIXEL_SCALE, KeyframeLayer
from cliploc_ros.offline.datasets.images import Images
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.studio.recording import Recording
from cliploc_ros.offline.studio.viewpoint import Bounds

#: Greatest number of points: more slow down the browser.
MAX_POINTS = 100_000
# Number of views whose depth is read, and step between the pixels that are used.
_DEPTH_VIEWS, _DEPTH_STEP = 50, 5
# Greatest depth used: greater depth is mostly noise [m].
_MOST_DEPTH_M = 8.0
# One point per cube of this side is kept [m]. The side grows by a factor until few enough remain.
_LEAST_SIDE_M, _GROWTH = 0.02, 1.25
_HEADROOM_M = 0.2
_PALE = 0.25
# Colours by height, from the floor to the top of the map, for points without an image.
_HEIGHT_RGB = np.array([(150, 110, 60), (60, 150, 110), (60, 100, 190)], dtype=np.float64)
# Size of a point relative to the side of its cube. Points of depth almost touch. Points of
# keyframes lie on edges of objects and are smaller, so that they do not hide the landmarks.
_DEPTH_SIZE, _KEYFRAME_SIZE = 0.25, 0.15


class Cloud(NamedTuple):
    """Points of surfaces."""

    points: NDArray[np.float32]  #: (n, 3), in the map [m]
    colors: NDArray[np.uint8]  #: (n, 3)
    point_m: float  #: Size of a point


def find_cloud(recording: Recording | None, layer: KeyframeLayer | None, extent: Bounds
               ) -> Cloud | None:
    """Return the points of a map's surfaces; None without depth and keyframes.

    CliplocError: an image or depth image cannot be read.
    """
    parts = [] if recording is None or recording.images is None else _points_of_depth(
        recording.detections, recording.images)
    size = _DEPTH_SIZE if parts else _KEYFRAME_SIZE
    if not parts and layer is not None:
        parts = [_points_of_keyframe(layer, row, extent) for row in range(len(layer))]
    if not parts:
        return None
    points = np.concatenate([part[0] for part in parts]).astype(np.float32)
    colors = np.concatenate([part[1] for part in parts])
    with np.errstate(invalid='ignore'):  # pixels at the edge of a lens may have no ray
        is_low = points @ extent.up.astype(np.float32) < extent.top_m + _HEADROOM_M
    return _thinned(points[is_low], colors[is_low], size)


def _points_of_depth(detections: PosedDetections, images: Images
                     ) -> list[tuple[NDArray[np.float64], NDArray[np.uint8]]]:
    parts = []
    for view in np.unique(np.linspace(0, len(detections) - 1, _DEPTH_VIEWS).astype(np.int64)):
        found = images.depth_near(float(detections.stamps_s[view]), detections.name_of(view))
        if found is None:
            continue
        image, camera, depth = found
        pixels, depths_m = points_in_color(depth, camera, _DEPTH_STEP)
        columns, rows = np.round(pixels).astype(np.int64)
        is_inside = ((columns >= 0) & (rows >= 0) & (columns < camera.width)
                     & (rows < camera.height) & (depths_m < _MOST_DEPTH_M))
        rays = camera.normalize_points(pixels.T[is_inside])
        points = np.column_stack([rays, np.ones(len(rays))]) * depths_m[is_inside, None]
        pose = detections.map_from_camera[view]
        parts.append((points @ pose[:3, :3].T + pose[:3, 3],
                      image[rows[is_inside], columns[is_inside]]))
    return parts


def _points_of_keyframe(layer: KeyframeLayer, keyframe: int, extent: Bounds
                        ) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return points with the colours of the keyframe's image, without an image by height."""
    points, image = layer.points_in_map(keyframe), layer.image_rgb(keyframe)
    if image is None:
        levels = np.linspace(extent.floor_m, extent.top_m, len(_HEIGHT_RGB))
        return points, np.column_stack([np.interp(points @ extent.up, levels, channel)
                                        for channel in _HEIGHT_RGB.T]).astype(np.uint8)
    scale = image.shape[1] / layer.camera_of(keyframe).width / PIXEL_SCALE
    places = np.asarray(layer.pixels[layer.rows(keyframe)], dtype=np.float64) * scale
    columns, rows = np.clip(places.astype(np.int64), 0, np.array(image.shape[1::-1]) - 1).T
    return points, image[rows, columns]


def _thinned(points: NDArray[np.float32], colors: NDArray[np.uint8], size: float) -> Cloud:
    """Return one point per cube, in a colour that is paler than the landmarks.

    ``size`` is the size of a point relative to the side of its cube.
    """
    side = _LEAST_SIDE_M / _GROWTH
    rows = np.arange(len(points))
    while side < _LEAST_SIDE_M or len(rows) > MAX_POINTS:
        side *= _GROWTH
        cubes = np.floor(points / side).astype(np.int64) & 0x1FFFFF
        rows = np.unique(cubes @ np.array([1, 1 << 21, 1 << 42]), return_index=True)[1]
    pale = (1.0 - _PALE) * colors[rows] + _PALE * 255.0
    return Cloud(points[rows], pale.astype(np.uint8), size * side)


def draw_cloud(scene: viser.SceneApi, cloud: Cloud) -> list[Any]:
    """Draw the points."""
    return [scene.add_point_cloud('/cloud', cloud.points, cloud.colors, precision='float32',
                                  point_size=cloud.point_m, point_shading='flat',
                                  point_shape='circle')]

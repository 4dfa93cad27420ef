# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The room around the landmarks: its surfaces as a coloured cloud, and its walls.

The points come from the recording's depth images, or without depth, from the keyframes. They are
thinned, and cut above the highest camera and landmark: a ceiling would hide the room from above.
The walls are an occupancy grid in the format of nav2_map_server.
"""

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.depth import points_in_color
from cliploc_ros.core.keyframes.layer import PIXEL_SCALE, KeyframeLayer
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import MapError
from cliploc_ros.offline.datasets.images import Images
from cliploc_ros.offline.mapping.posed_detections import PosedDetections
from cliploc_ros.offline.studio.recording import Recording
from cliploc_ros.offline.studio.viewpoint import Bounds, wxyz_of

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
FREE, OCCUPIED, UNKNOWN = 1, 2, 0
_WALL_RGBA, _FREE_RGBA = (70, 80, 100, 255), (225, 232, 240, 150)
_COLORS = np.array([(0, 0, 0, 0), _FREE_RGBA, _WALL_RGBA], dtype=np.uint8)
# Limits of the image size: larger images slow down the browser, smaller ones are blurred [px].
_MOST_PIXELS, _LEAST_PIXELS = 2048, 512
# Depth below the floor grid, which would flicker through.
_BELOW_M = 0.01


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


def draw_cloud(scene: Any, cloud: Cloud) -> list[Any]:
    """Draw the points."""
    return [scene.add_point_cloud('/cloud', cloud.points, cloud.colors, precision='float32',
                                  point_size=cloud.point_m, point_shading='flat',
                                  point_shape='circle')]


# ---- walls -------------------------------------------------------------------------------------

class Walls(NamedTuple):
    """An occupancy grid."""

    #: (rows, columns): FREE, OCCUPIED or UNKNOWN. The last row is at the origin, columns run along
    #: x of the grid.
    cells: NDArray[np.uint8]
    resolution_m: float  #: Side of a cell
    origin: tuple[float, float, float]  #: x, y [m] and yaw [rad] of the grid in the map


def read_walls(file: Path) -> Walls:
    """Read a grid from the YAML file of nav2_map_server, modes trinary and scale.

    MapError: the file is invalid; the message names the file and the field.
    """
    fields = read_parameter_file(file)
    try:
        mode, image_file = fields.get('mode', 'trinary'), file.parent / str(fields['image'])
        if mode not in ('trinary', 'scale'):
            raise ValueError(f'mode {mode}: must be trinary or scale; save the grid again in one '
                             'of these modes')
        x, y, yaw, side, occupied, free, negate = map(float, (
            *fields['origin'], fields['resolution'], fields['occupied_thresh'],
            fields['free_thresh'], fields['negate']))
        if not np.isfinite([x, y, yaw]).all() or not 1e-3 <= side <= 100.0:
            raise ValueError(f'origin {fields["origin"]} must be finite, and resolution {side} m '
                             'within 0.001 and 100')
        if not 0.0 < free < occupied <= 1.0:
            raise ValueError(f'free_thresh {free} must be above 0 and below occupied_thresh '
                             f'{occupied}, which must be at most 1')
        # only regular files: a device would never end; OpenCV refuses images that are too large
        image = cv2.imread(str(image_file), cv2.IMREAD_GRAYSCALE) if image_file.is_file() else None
    except (ValueError, TypeError, KeyError, cv2.error) as error:
        text = f'{error} is missing' if isinstance(error, KeyError) else str(error)
        raise MapError(f'occupancy_grid {file}: {text.splitlines()[0]}') from error
    if image is None:
        raise MapError(f'occupancy_grid {file}: {image_file} is missing, damaged or not an image')
    dark = np.abs((0.0 if negate else 1.0) - image / 255.0)
    return Walls(np.where(dark > occupied, OCCUPIED, np.where(dark < free, FREE, UNKNOWN)
                          ).astype(np.uint8), side, (x, y, yaw))


def draw_walls(scene: Any, walls: Walls) -> list[Any]:
    """Draw an occupancy grid at z = 0: walls dark, free cells light, unknown cells transparent."""
    step = max(1, -(-max(walls.cells.shape) // _MOST_PIXELS))
    rows, columns = (-(-side // step) * step for side in walls.cells.shape)
    cells = np.pad(walls.cells, [(rows - walls.cells.shape[0], 0),
                                 (0, columns - walls.cells.shape[1])])
    # the maximum keeps walls of one cell
    picture = _COLORS[cells.reshape(rows // step, step, columns // step, step).max(axis=(1, 3))]
    least = max(1, -(-_LEAST_PIXELS // max(picture.shape)))
    x, y, yaw = walls.origin
    turn, size = Rotation.from_euler('z', yaw), np.array([columns, rows]) * walls.resolution_m
    # viser's images have y down and z away from the viewer: turn them to be seen from above
    return [scene.add_image(
        '/walls', np.repeat(np.repeat(picture, least, axis=0), least, axis=1), *size, format='png',
        cast_shadow=False, receive_shadow=False,
        position=np.array([x, y, -_BELOW_M]) + turn.apply([*(0.5 * size), 0.0]),
        wxyz=wxyz_of((turn * Rotation.from_euler('x', np.pi)).as_matrix()))]

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The walls around the landmarks: an occupancy grid in the format of nav2_map_server."""

from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import MapError
from cliploc_ros.offline.studio.viewpoint import wxyz_of

FREE, OCCUPIED, UNKNOWN = 1, 2, 0
_WALL_RGBA, _FREE_RGBA = (70, 80, 100, 255), (225, 232, 240, 150)
_COLORS = np.array([(0, 0, 0, 0), _FREE_RGBA, _WALL_RGBA], dtype=np.uint8)
# Limits of the image size: larger images slow down the browser, smaller ones are blurred [px].
_MOST_PIXELS, _LEAST_PIXELS = 2048, 512
# Depth below the floor grid, which would flicker through.
_BELOW_M = 0.01


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

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids from the files of Nav2's map_server: YAML that names a PGM or PNG image."""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.grid import OccupancyGrid
from cliploc_ros.core.geometry.transforms import transform_from_pose
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import MapError, OptionsError
from cliploc_ros.files.storage import read_file

_MODES = ('trinary', 'scale', 'raw')


def read_grid(path: str | Path, frame_id: str = 'map') -> OccupancyGrid:
    """Read a grid as map_server does (nav2_map_server, map_io.cpp).

    The files name no coordinate frame; map_server publishes in `map`.

    MapError: a file or a field is invalid.
    """
    path, tree = Path(path), read_parameter_file(path)
    try:
        mode, image = tree.get('mode', 'trinary'), path.parent / Path(tree['image']).expanduser()
        x, y, yaw, resolution_m, occupied, free = map(float, [*tree['origin'], *(
            tree[name] for name in ('resolution', 'occupied_thresh', 'free_thresh'))])
        pixels = cv2.imdecode(np.frombuffer(read_file(image), np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None or mode not in _MODES or not free < occupied:
            raise ValueError(f"image '{image.name}', mode '{mode}', free_thresh {free}")
        cells = _cells(pixels, mode, bool(tree.get('negate')), occupied, free)
        return OccupancyGrid(cells[::-1], resolution_m, transform_from_pose(
            np.array([x, y, 0.0]), np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])),
            frame_id)
    except (cv2.error, KeyError, OptionsError, OSError, TypeError, ValueError) as error:
        raise MapError(f'{path}: not a grid of map_server (image in PGM or PNG, resolution, '
                       'origin [x, y, yaw], free_thresh < occupied_thresh, mode '
                       f'{", ".join(_MODES)}): {error!r}') from error


def _cells(pixels: NDArray[Any], mode: str, negate: bool, occupied: float, free: float
           ) -> NDArray[np.int8]:
    """Return the cells (h, w) of an image, in the order of its rows; -1: unknown."""
    channels = np.atleast_3d(pixels).astype(np.float32) / np.iinfo(pixels.dtype).max
    # map_server averages alpha with the colours in this mode
    shade = channels[..., :3 + (mode == 'trinary')].mean(axis=2)
    if mode == 'raw':
        return np.where(shade > 100.5 / 255.0, -1.0, np.rint(255.0 * shade)).astype(np.int8)
    taken, is_clear = shade if negate else 1.0 - shade, (channels[..., 3:] < 1.0).any(axis=2)
    between = 100.0 * (taken - free) / (occupied - free) if mode == 'scale' else -1.0
    return np.select([is_clear & (mode == 'scale'), taken > occupied, taken < free],
                     [-1.0, 100.0, 0.0], np.rint(between)).astype(np.int8)

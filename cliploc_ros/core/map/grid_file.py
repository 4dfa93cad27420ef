# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids from the files of Nav2's map_server: YAML that names a PGM or PNG image."""

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.grid import OccupancyGrid
from cliploc_ros.core.geometry.transforms import is_rigid, make_transform
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import MapError
from cliploc_ros.files.storage import read_file

# Limit of memory: 400 m x 400 m at 5 cm have 64 million cells.
_MOST_CELLS = 2**26
# Greatest side of a cell [m]: a laser tells nothing about coarser grids.
_COARSEST_M = 1.0
_LEVEL_COSINE = 0.9999
_FREE, _OCCUPIED, _UNKNOWN = 0, 100, -1
_MODES = ('trinary', 'scale', 'raw')


def read_grid(path: str | os.PathLike[str], frame_id: str = 'map') -> OccupancyGrid:
    """Read a grid as map_server does (nav2_map_server, map_io.cpp).

    The files name no coordinate frame; map_server publishes in `map`.

    MapError: a file or field is invalid; the message names both.
    """
    path, tree = Path(path), read_parameter_file(path)
    resolution_m, occupied, free = (_number(tree, name, path) for name in (
        'resolution', 'occupied_thresh', 'free_thresh'))
    mode, origin, image = tree.get('mode', 'trinary'), tree.get('origin'), tree.get('image')
    if mode not in _MODES or not free < occupied:
        raise MapError(f"{path}: mode '{mode}' must be one of {', '.join(_MODES)}, and "
                       f'free_thresh {free} below occupied_thresh {occupied}')
    if not isinstance(image, str) or not image:
        raise MapError(f'{path}: image names no file')
    if not isinstance(origin, list) or len(origin) != 3:
        raise MapError(f'{path}: origin must be x [m], y [m] and yaw [rad]')
    x, y, yaw = (_number(dict(enumerate(origin)), index, path) for index in range(3))
    pixels = _pixels(path.parent / Path(image).expanduser())
    is_table = pixels.shape[2] == 1 and pixels.dtype == np.uint8  # which saves time and memory
    shades = np.arange(256, dtype=np.uint8).reshape(1, -1, 1) if is_table else pixels
    cells = _cells((shades / np.iinfo(pixels.dtype).max).astype(np.float32), mode,
                   bool(tree.get('negate')), occupied, free)
    cells = cells[0][pixels[..., 0]] if is_table else cells
    return checked_grid(cells[::-1], resolution_m, make_transform(
        Rotation.from_euler('z', yaw).as_matrix(), np.array([x, y, 0.0])), frame_id, str(path))


def checked_grid(cells: NDArray[np.int8], resolution_m: float,
                 frame_from_grid: NDArray[np.float64], frame_id: str, source: str
                 ) -> OccupancyGrid:
    """Return a grid; cells outside of 0 to 100 are unknown. MapError: it is invalid."""
    height, width = cells.shape
    if not 0 < cells.size <= _MOST_CELLS:
        raise MapError(f'{source}: {width} x {height} cells, expected 1 to {_MOST_CELLS}')
    if not 0.0 < resolution_m <= _COARSEST_M:
        raise MapError(f'{source}: resolution {resolution_m:g} m must be above 0, and at most '
                       f'{_COARSEST_M:g}')
    if not is_rigid(frame_from_grid) or frame_from_grid[2, 2] < _LEVEL_COSINE:
        raise MapError(f'{source}: the origin must be finite, and turned about z only')
    if not frame_id:
        raise MapError(f'{source}: has no frame_id: set that of the map')
    return OccupancyGrid(np.where((cells < _FREE) | (cells > _OCCUPIED), np.int8(_UNKNOWN), cells),
                         resolution_m, frame_from_grid, frame_id)


def _number(tree: dict[Any, Any], name: Any, path: Path) -> float:
    value = tree.get(name)
    if not isinstance(value, int | float) or not np.isfinite(value):
        raise MapError(f'{path}: {name} is {value!r}, expected a number')
    return float(value)


def _pixels(path: Path) -> NDArray[Any]:
    """Return the channels (h, w, c) of an image, uint8 or uint16: grey or colour, and alpha."""
    try:
        pixels = cv2.imdecode(np.frombuffer(read_file(path), np.uint8), cv2.IMREAD_UNCHANGED)
    except OSError as error:
        raise MapError(f'{path}: {error.strerror}') from error
    except cv2.error:
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise MapError(f'{path}: is not a PGM or PNG image')
    return np.atleast_3d(pixels)


def _cells(channels: NDArray[np.float32], mode: str, negate: bool, occupied: float, free: float
           ) -> NDArray[np.int8]:
    """Return the cells (h, w) of channels (h, w, c) from 0 to 1, in the order of the image."""
    has_alpha = channels.shape[2] == 4
    # map_server averages alpha with the colours in this mode
    shade = channels[..., :3 + (mode == 'trinary')].mean(axis=2)
    if mode == 'raw':
        cells = np.rint(255.0 * shade)
        return np.where(cells <= _OCCUPIED, cells, _UNKNOWN).astype(np.int8)
    occupancy = shade if negate else 1.0 - shade
    cells = np.rint(100.0 * (occupancy - free) / (occupied - free)) if mode == 'scale' else \
        np.full(shade.shape, float(_UNKNOWN))
    cells[occupancy > occupied], cells[occupancy < free] = _OCCUPIED, _FREE
    if mode == 'scale' and has_alpha:
        cells[channels[..., 3] < 1.0] = _UNKNOWN
    return cells.astype(np.int8)

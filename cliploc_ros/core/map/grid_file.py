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
from cliploc_ros.core.geometry.transforms import make_transform
from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import MapError, OptionsError
from cliploc_ros.files.storage import read_file

_FREE, _OCCUPIED, _UNKNOWN = 0, 100, -1
_MODES = ('trinary', 'scale', 'raw')


def read_grid(path: str | os.PathLike[str], frame_id: str = 'map') -> OccupancyGrid:
    """Read a grid as map_server does (nav2_map_server, map_io.cpp).

    The files name no coordinate frame; map_server publishes in `map`.

    MapError: a file or a field is invalid.
    """
    path, tree = Path(path), read_parameter_file(path)
    try:
        mode = tree.get('mode', 'trinary')
        x, y, yaw, resolution_m, occupied, free = map(float, [*tree['origin'], *(
            tree[name] for name in ('resolution', 'occupied_thresh', 'free_thresh'))])
        content = read_file(path.parent / Path(tree['image']).expanduser())
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None or mode not in _MODES or not free < occupied:
            raise ValueError(f"image '{tree['image']}', mode '{mode}', free_thresh {free}")
        return OccupancyGrid(
            _cells(pixels, mode, bool(tree.get('negate')), occupied, free)[::-1], resolution_m,
            make_transform(Rotation.from_euler('z', yaw).as_matrix(), np.array([x, y, 0.0])),
            frame_id)
    except (cv2.error, KeyError, OptionsError, OSError, TypeError, ValueError) as error:
        raise MapError(f'{path}: not a grid of map_server (image in PGM or PNG, resolution, '
                       'origin [x, y, yaw], free_thresh < occupied_thresh, mode '
                       f'{", ".join(_MODES)}): {error!r}') from error


def _cells(pixels: NDArray[Any], mode: str, negate: bool, occupied: float, free: float
           ) -> NDArray[np.int8]:
    """Return the cells (h, w) of an image, in the order of its rows."""
    channels = np.atleast_3d(pixels).astype(np.float32) / np.iinfo(pixels.dtype).max
    # map_server averages alpha with the colours in this mode
    shade = channels[..., :3 + (mode == 'trinary')].mean(axis=2)
    if mode == 'raw':
        cells = np.rint(255.0 * shade)
        return np.where(cells <= _OCCUPIED, cells, _UNKNOWN).astype(np.int8)
    occupancy = shade if negate else 1.0 - shade
    cells = np.rint(100.0 * (occupancy - free) / (occupied - free)) if mode == 'scale' else \
        np.full_like(shade, _UNKNOWN)
    cells[occupancy > occupied], cells[occupancy < free] = _OCCUPIED, _FREE
    if mode == 'scale':
        cells[(channels[..., 3:] < 1.0).any(axis=2)] = _UNKNOWN
    return cells.astype(np.int8)

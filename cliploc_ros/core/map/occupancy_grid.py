# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Walls: an occupancy grid as of nav2_map_server, read from its YAML file and image."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.map.parameter_file import read_parameter_file
from cliploc_ros.errors import MapError

FREE, OCCUPIED, UNKNOWN = 0, 1, -1
#: Larger grids are refused: 64 MB, or 3 km^2 at .25 m and 400 m x 400 m at .05 m.
MAX_CELLS = 64_000_000
_MOST_METRES = 1e6
_PGM = re.compile(rb'P[25](?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)\s')


@dataclass(frozen=True)
class OccupancyGrid:
    """Cells of a horizontal plane, most often that of a lidar."""

    frame_id: str  #: The coordinate frame of the origin
    #: (rows, columns): FREE, OCCUPIED or UNKNOWN; the first cell lies at the origin, columns along
    #: x of the grid, rows along y
    cells: NDArray[np.int8]
    resolution_m: float  #: Side of a cell
    origin: tuple[float, float, float]  #: x, y [m] and yaw [rad] of the grid in the frame

    def __post_init__(self) -> None:
        """Refuse what is no grid; MapError names the value."""
        check_size(self.cells.shape[1], self.cells.shape[0])
        if not 1e-3 <= self.resolution_m <= 100.0:
            raise MapError(f'resolution {self.resolution_m} m: must be .001 to 100')
        if not all(abs(one) <= _MOST_METRES for one in self.origin):
            raise MapError(f'origin {self.origin}: must be finite, within {_MOST_METRES:g} m')

    def at(self, points: NDArray[np.float64]) -> NDArray[np.int8]:
        """Return the state of the cell of each point (..., 2) [m]; beyond the grid UNKNOWN."""
        x, y, yaw = self.origin
        cos, sin = math.cos(yaw), math.sin(yaw)
        steps = points - [x, y]
        spots = np.floor(steps @ [[cos, -sin], [sin, cos]] / self.resolution_m)
        inside = ((spots >= 0) & (spots < self.cells.shape[::-1])).all(axis=-1)
        columns, rows = np.moveaxis(np.where(inside[..., None], spots, 0).astype(np.int64), -1, 0)
        return np.where(inside, self.cells[rows, columns], np.int8(UNKNOWN))

    def around(self, point: NDArray[np.float64], radius_m: float) -> NDArray[np.int8]:
        """Return the states within a radius of a point (2,), its own first."""
        steps = np.linspace(-radius_m, radius_m, 2 * math.ceil(radius_m / self.resolution_m) + 1)
        disk = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        disk = disk[np.linalg.norm(disk, axis=1) <= radius_m]
        return self.at(point + np.concatenate([np.zeros((1, 2)), disk]))

    def are_blocked(self, start: NDArray[np.float64], ends: NDArray[np.float64], skip_m: float,
                    stop_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether an occupied cell lies between a point (2,) and each of others (n, 2).

        The first skip_m and the last stop_m (n,) of the way do not count [m].
        """
        ways = np.linalg.norm(ends - start, axis=1)
        longest = min(float(ways.max(initial=0.0)), _MOST_METRES * self.resolution_m)
        along = np.arange(skip_m, longest, 0.5 * self.resolution_m)
        aims = (ends - start) / np.maximum(ways, 1e-9)[:, None]
        states = self.at(start + along[:, None] * aims[:, None])
        return np.asarray(((states == OCCUPIED) & (along < (ways - stop_m)[:, None])).any(axis=1))


def check_size(width: int, height: int) -> None:
    """Raise MapError for a grid without cells, or with too many for the memory of a robot."""
    if not 0 < width * height <= MAX_CELLS:
        raise MapError(f'{width} x {height} cells: must be 1 to {MAX_CELLS}; use a coarser grid')


def read_occupancy_grid(file: Path, frame_id: str) -> OccupancyGrid:
    """Read a grid of a coordinate frame from the YAML file of nav2_map_server.

    The image is PGM or PNG; pixels lighter than free_thresh are free, darker than occupied_thresh
    occupied, as there.

    MapError: names the file and what to correct.
    """
    fields = read_parameter_file(file)
    try:
        return _grid(fields, file, frame_id)
    except MapError as error:
        raise MapError(f'occupancy_grid {file}: {error}') from error
    except (OSError, ValueError, TypeError, KeyError, OverflowError) as error:
        text = f'{error} is missing' if isinstance(error, KeyError) else str(error)
        raise MapError(f'occupancy_grid {file}: {text.splitlines()[0]}') from error


def _grid(fields: dict[str, Any], file: Path, frame_id: str) -> OccupancyGrid:
    image = _read_image(file.parent / str(fields['image']))
    x, y, yaw = map(float, fields['origin'])
    occupied, free = float(fields['occupied_thresh']), float(fields['free_thresh'])
    if not 0.0 < free < occupied <= 1.0:
        raise MapError(f'free_thresh {free} and occupied_thresh {occupied}: must rise, 0 to 1')
    dark = np.arange(256) / 255.0
    if not int(fields['negate']):
        dark = 1.0 - dark
    states = np.full(256, UNKNOWN, dtype=np.int8)
    states[dark > occupied], states[dark < free] = OCCUPIED, FREE
    # the image's first row is the grid's last one
    return OccupancyGrid(frame_id, states[image[::-1]], float(fields['resolution']), (x, y, yaw))


def _read_image(path: Path) -> NDArray[np.uint8]:
    """Return the grey values (rows, columns) of a PGM or PNG file; its size is checked before."""
    data = path.read_bytes()
    header = _PGM.match(data)
    if data.startswith(b'\x89PNG') and len(data) >= 24:
        size = int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    elif header is not None:
        size = int(header[1]), int(header[2])
    else:
        raise MapError(f'{path.name} is neither PGM nor PNG')
    check_size(*size)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        image = None
    if image is None or image.shape != size[::-1]:
        raise MapError(f'{path.name} is damaged')
    return image.astype(np.uint8)

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The floor below the landmarks: an occupancy grid, read from a file of nav2_map_server."""

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
#: Larger grids are refused: 3 km^2 at .25 m and 400 m x 400 m at .05 m.
MAX_CELLS = 64_000_000
_MOST_METRES = 1e6
# An image without compression, as 16-bit text, is smaller [bytes].
_MOST_BYTES = 6 * MAX_CELLS
_PGM = re.compile(rb'P[25](?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)\s')


@dataclass(frozen=True)
class OccupancyGrid:
    """Cells of a horizontal plane, most often that of a lidar."""

    #: (rows, columns): FREE, OCCUPIED or UNKNOWN; the first cell lies at the origin, columns along
    #: x of the grid, rows along y
    cells: NDArray[np.int8]
    resolution_m: float  #: Side of a cell
    origin: tuple[float, float, float]  #: x, y [m] and yaw [rad] of the grid in the map

    def __post_init__(self) -> None:
        """Refuse what is no grid; MapError names the value."""
        if not 1e-3 <= self.resolution_m <= 100.0:
            raise MapError(f'resolution {self.resolution_m} m: must be .001 to 100')
        if not all(abs(value) <= _MOST_METRES for value in self.origin):
            raise MapError(f'origin {self.origin}: must be finite, within {_MOST_METRES:g} m')


def read_occupancy_grid(file: Path) -> OccupancyGrid:
    """Read a grid from the YAML file of nav2_map_server.

    The image is PGM or PNG; pixels lighter than free_thresh are free, darker than occupied_thresh
    occupied, as there in the modes trinary and scale.

    MapError: names the file and what to correct.
    """
    fields = read_parameter_file(file)
    try:
        return _grid(fields, file)
    except MapError as error:
        raise MapError(f'occupancy_grid {file}: {error}') from error
    except (OSError, ValueError, TypeError, KeyError, OverflowError) as error:
        text = f'{error} is missing' if isinstance(error, KeyError) else str(error)
        raise MapError(f'occupancy_grid {file}: {text.splitlines()[0]}') from error


def _grid(fields: dict[str, Any], file: Path) -> OccupancyGrid:
    mode = fields.get('mode', 'trinary')
    if mode not in ('trinary', 'scale'):
        raise MapError(f'mode {mode}: must be trinary or scale; save the grid in one of them')
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
    return OccupancyGrid(states[image[::-1]], float(fields['resolution']), (x, y, yaw))


def _read_image(path: Path) -> NDArray[np.uint8]:
    """Return the grey values (rows, columns) of a PGM or PNG file; its size is checked before."""
    if not path.is_file():
        raise MapError(f'{path} is no file')
    if path.stat().st_size > _MOST_BYTES:
        raise MapError(f'{path.name} has more than {_MOST_BYTES} bytes')
    data = path.read_bytes()
    header = _PGM.match(data)
    if data.startswith(b'\x89PNG') and len(data) >= 24:
        width, height = int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    elif header is not None:
        width, height = int(header[1]), int(header[2])
    else:
        raise MapError(f'{path.name} is neither PGM nor PNG')
    if not 0 < width * height <= MAX_CELLS:
        raise MapError(f'{width} x {height} cells: must be 1 to {MAX_CELLS}; use a coarser grid')
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        image = None
    if image is None or image.shape != (height, width):
        raise MapError(f'{path.name} is damaged')
    return image.astype(np.uint8)

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids, in the conventions of nav_msgs/OccupancyGrid."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import is_rigid
from cliploc_ros.errors import OptionsError


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """A horizontal grid of free, occupied and unknown cells.

    Raises
    ------
    OptionsError
        It has no cells, no positive resolution, or its axes are not level and right-handed.
    """

    #: (h, w) int8: probability that a cell is occupied [%], 0 to 100; -1: unknown. Row 0 is at the
    #: grid's origin, the row is y and the column is x.
    cells: NDArray[np.int8]
    resolution_m: float  #: Side of a cell [m]
    #: (4, 4): the corner of the first cell, and the grid's axes, in its coordinate frame
    frame_from_grid: NDArray[np.float64]
    frame_id: str  #: Its coordinate frame, that of a map

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.cells.ndim != 2 or not self.cells.size or not 0.0 < self.resolution_m < np.inf:
            raise OptionsError(f'grid: {self.cells.shape} cells of {self.resolution_m} m; '
                               'expected rows and columns of cells, and a resolution above 0')
        if not is_rigid(self.frame_from_grid) or self.frame_from_grid[2, 2] < 0.999:
            raise OptionsError('grid: its origin must be a finite pose with a vertical z axis')

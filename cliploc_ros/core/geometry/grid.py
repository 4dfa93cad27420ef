# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids, in the conventions of nav_msgs/OccupancyGrid."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """A horizontal grid of free, occupied and unknown cells."""

    #: (h, w) int8: probability that a cell is occupied [%], 0 to 100; -1: unknown. Row 0 is at the
    #: grid's origin, the row is y and the column is x.
    cells: NDArray[np.int8]
    resolution_m: float  #: Side of a cell [m]
    #: (4, 4): the corner of the first cell, and the grid's axes, in its coordinate frame
    frame_from_grid: NDArray[np.float64]
    frame_id: str  #: Its coordinate frame, that of a map

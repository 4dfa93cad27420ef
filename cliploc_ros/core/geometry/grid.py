# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Occupancy grids, in the conventions of nav_msgs/OccupancyGrid."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.geometry.transforms import is_rigid
from cliploc_ros.errors import OptionsError

#: Cells with at least, and with less than this value are occupied, and free [%]: the thresholds of
#: map_server. Others are unknown.
OCCUPIED, FREE = 65, 25
#: Unit of GridField.gaps [m], their largest value, and their value where nothing is known.
#: Deviation of the distance between the end of a beam and its wall [m], and the likelihood (256,)
#: that a beam ends at each value of gaps.
GAP_M, FAR, UNKNOWN, DEVIATION_M = 0.005, 254, 255, 0.1
LIKELIHOODS = np.exp(-0.5 * (GAP_M / DEVIATION_M * np.arange(256.0)) ** 2)
# This deviation in the coarse field, and the side of its cells unless the grid is coarser [m].
_COARSE_DEVIATION_M, _COARSE_M = 0.25, 0.2
# Number of the random poses, and their least distance from occupied cells [m]. Margin of the
# field, so that walls at the border have a gradient on both sides [m].
_POSES, _CLEARANCE_M, _MARGIN_M = 2000, 0.2, 0.5


class GridField(NamedTuple):
    """The likelihood field of a grid (Thrun, Burgard and Fox 2005, ch. 6.4), and random poses."""

    #: (h, w): distance of each cell from the nearest occupied cell [GAP_M]; UNKNOWN in unknown
    #: cells that are farther than three deviations from an occupied cell
    gaps: NDArray[np.uint8]
    side_m: float  #: Side of a cell [m]
    #: The least distances in larger cells, in a unit that is larger, for a larger deviation
    coarse: NDArray[np.uint8]
    coarse_m: float
    margin_m: float  #: The field begins with such a margin of unknown cells [m]
    poses: NDArray[np.float64]  #: (n, 3): x, y [m] and yaw [rad] of random poses in free space


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
        if self.cells.ndim != 2 or not self.cells.size or not 0.0 < self.resolution_m < np.inf or (
                not is_rigid(self.frame_from_grid) or self.frame_from_grid[2, 2] < 0.999):
            raise OptionsError('grid: cells, resolution or origin (with z up) are invalid')

    @cached_property
    def field(self) -> GridField:
        """Return the likelihood field. The first call takes time for a large grid."""
        side_m, margin = self.resolution_m, round(_MARGIN_M / self.resolution_m) + 1
        cells = np.pad(self.cells, margin, constant_values=-1)
        away = cv2.distanceTransform((cells < OCCUPIED).astype(np.uint8), cv2.DIST_L2, 5)
        gaps = cv2.convertScaleAbs(np.minimum(away, FAR * GAP_M / side_m), alpha=side_m / GAP_M)
        is_free = (cells >= 0) & (cells < FREE)
        gaps[~is_free & (gaps > 3.0 * DEVIATION_M / GAP_M)] = UNKNOWN
        factor = max(1, round(_COARSE_M / side_m))
        coarse = (DEVIATION_M / _COARSE_DEVIATION_M * cv2.erode(gaps, np.ones(
            (factor, factor), np.uint8), anchor=(0, 0))[::factor, ::factor]).astype(np.uint8)
        rng = np.random.default_rng(0)
        spots = np.argwhere(is_free & (gaps >= _CLEARANCE_M / GAP_M))
        spots = rng.choice(spots, _POSES if len(spots) else 0)
        poses = side_m * np.column_stack([spots[:, ::-1] + rng.random(spots.shape),
                                          rng.uniform(-np.pi, np.pi, len(spots)) / side_m])
        return GridField(gaps, side_m, coarse, factor * side_m, margin * side_m, poses)

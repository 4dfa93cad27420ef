# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Where the robot probably is, and where walls are: evidence, never a cut.

A region is right with its probability p; otherwise the robot may be anywhere in the map. So a pose
has the density p N(pose) + (1 - p) u, where u is uniform over the map. Its logarithm over u is
bounded: 0 in the region, a constant elsewhere. So a region never raises a pose against the case
that no pose is right, and lifts none that its objects support weakly: the confidence of a pose
stays below that without its rivals. Nor does it decide alone between two places that look the
same: the robot may have been told the wrong one of them.

An occupancy grid speaks against the leading pose alone. So it never decides between poses, and a
grid of another floor or frame makes no wrong pose more likely.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.acceptance.calibration import CALIBRATION
from cliploc_ros.core.map.joined_map import parts_of, place_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.map.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from cliploc_ros.core.observation import Region

# A robot drives about beyond the outermost landmarks, too [m].
_MARGIN_M = 1.0
# A body that points up or down has no yaw: of its x axis, this much must be level.
_LEAST_AHEAD = 0.5
# A camera is so near to free space: errors of pose and grid, and what a camera reaches over [m].
_REACH_M = 0.3


def region_odds(landmark_map: LandmarkMap, region: Region, poses: NDArray[np.float64]
                ) -> NDArray[np.float64]:
    """Return the log odds (m,), 0 or less, that a region gives to camera poses (m, 4, 4) of a map.

    A region of a map that is not there says nothing.
    """
    parts = parts_of(landmark_map)
    shift = next((one.shift for one in parts if one.landmark_map.frame_id == region.frame_id),
                 None)
    if shift is None:
        return np.zeros(len(poses))
    terms = CALIBRATION.prior
    bodies = poses @ region.camera_from_body
    steps = np.c_[bodies[:, :2, 3] - shift[:2], np.arctan2(bodies[:, 1, 0], bodies[:, 0, 0])]
    steps -= region.mean
    steps[:, 2] = (steps[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    steps[np.hypot(*bodies[:, :2, 0].T) < _LEAST_AHEAD, 2] = 0.0
    covariance = region.covariance + np.diag(
        [terms.least_m, terms.least_m, math.radians(terms.least_deg)]) ** 2
    spot, yaw = covariance[:2, :2], covariance[2, 2]
    squares = (np.einsum('ni,ij,nj->n', steps[:, :2], np.linalg.inv(spot), steps[:, :2])
               + steps[:, 2] ** 2 / yaw)
    area = sum(float(np.prod(np.ptp(one.landmark_map.centers[:, :2], axis=0) + 2.0 * _MARGIN_M))
               for one in parts)
    # a region wider than the map is as good as the map
    peak = (max(0.0, math.log(area / (2.0 * math.pi)) - 0.5 * np.linalg.slogdet(spot)[1])
            + max(0.0, 0.5 * math.log(2.0 * math.pi / yaw)))
    p = min(max(region.probability, 1e-9), 1.0 - 1e-9)
    odds = np.logaddexp(math.log(1.0 - p), math.log(p) + peak - 0.5 * squares)
    return np.asarray(np.clip(odds, -terms.most, 0.0))


class Walls(NamedTuple):
    """What an occupancy grid says against a pose."""

    is_inside: bool = False  #: No free cell is near the camera, but an occupied one
    is_outside: bool = False  #: Nothing near the camera is known
    blocked: int = 0  #: Matched objects behind an occupied cell
    seen: int = 0  #: Matched objects with a free way

    @property
    def odds(self) -> float:
        """Return the log odds against the pose, 0 or less."""
        terms = CALIBRATION.prior
        # a lidar's plane shows tables that the camera looks over: most of the ways must be blocked
        behind = min(int(terms.most_blocked), max(0, self.blocked - self.seen))
        return (terms.in_wall * self.is_inside + terms.outside * self.is_outside
                + terms.blocked * behind)

    def in_words(self) -> str:
        """Return what is wrong; empty where nothing is."""
        if self.is_inside:
            return 'the pose lies in a wall of the occupancy grid'
        if self.is_outside:
            return 'the pose lies outside of the known area of the occupancy grid'
        return f'the occupancy grid has walls before {self.blocked} of ' \
            f'{self.blocked + self.seen} matched objects' if self.odds < 0.0 else ''


def walls_against(landmark_map: LandmarkMap, grid: OccupancyGrid, pose: NDArray[np.float64],
                  matched: Sequence[int]) -> Walls | None:
    """Return what a grid says against a camera pose (4, 4) that matches some landmarks.

    None where the pose is in another of several maps. A way ends before the object itself, whose
    own cells may be occupied.
    """
    place = place_of(landmark_map, pose)
    its, rows = place.part.landmark_map, np.array(matched, dtype=np.int64) - place.part.first
    if its.frame_id != grid.frame_id:
        return None
    camera = place.map_from_camera[:2, 3]
    near = grid.around(camera, _REACH_M)
    rows = rows[(rows >= 0) & (rows < len(its))]
    # the largest semi-axis bounds an object from all sides
    blocked = grid.are_blocked(camera, its.centers[rows, :2], _REACH_M,
                               its.semi_axes[rows].max(axis=1) + _REACH_M)
    has_free, has_wall = bool((near == FREE).any()), bool((near == OCCUPIED).any())
    return Walls(not has_free and has_wall, not has_free and not has_wall, int(blocked.sum()),
                 int((~blocked).sum()))

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scans of accepted poses: what they have in common is no error of the poses.

A wrong mount of the laser moves all poses alike in the axes of the robot, a wrong origin of the
grid in those of the map. A grid that is mirrored, or that has a wrong resolution, fits nowhere.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.scan_match import ScanFit
from cliploc_ros.core.geometry.grid import OccupancyGrid

# Looks within this distance [m] and turn [rad] of the look before are not counted. A verdict needs
# the second number of looks, and uses the last ones. All chosen.
_APART_M, _APART, _LEAST_LOOKS, _MOST_LOOKS = 0.3, 0.3, 5, 20
# Least mean step [m] and turn [rad] of a fault, in standard errors as well; and least share of the
# beams that a right grid explains. Chosen.
_STEP_M, _TURN, _ERRORS, _EXPLAINED = 0.06, math.radians(1.5), 3.0, 0.5
# A cause is excluded if the steps spread by this factor more in its axes. Chosen.
_SPREAD = 2.0


class ScanCheck:
    """Compares the scans of accepted poses with each other."""

    def __init__(self) -> None:
        self._grid: OccupancyGrid | None = None
        # The pose (3,) of each look, its step in the axes of robot and map (5,), and its share of
        # explained beams.
        self._looks: deque[tuple[NDArray[np.float64], NDArray[np.float64], float]] = deque(
            maxlen=_MOST_LOOKS)

    def add(self, grid: OccupancyGrid, fit: ScanFit, map_from_base: NDArray[np.float64]) -> None:
        """Add the scan of an accepted pose (4, 4), after forgetting those on another grid."""
        if grid is not self._grid:
            self._grid = grid
            self._looks.clear()
        x, y, turn = fit.step
        (cos, _), (sin, _) = map_from_base[:2, :2]
        pose = np.array([*map_from_base[:2, 3], math.atan2(sin, cos)])
        away = np.abs(pose - self._looks[-1][0]) if self._looks else np.array([np.inf] * 3)
        if math.hypot(*away[:2]) > _APART_M or _APART < away[2] < 2.0 * math.pi - _APART:
            self._looks.append((pose, np.array([
                cos * x + sin * y, cos * y - sin * x, turn, x, y]), fit.explained))

    @property
    def fault(self) -> str:
        """Return what is wrong with laser or grid, and the remedy; empty without evidence."""
        if len(self._looks) < _LEAST_LOOKS:
            return ''
        _, steps, explained = map(np.array, zip(*self._looks, strict=True))
        if np.median(explained) < _EXPLAINED:
            return (f'scans at {len(steps)} accepted poses explain {np.median(explained):.2f} of '
                    'their beams by the grid: check that the grid is of this place and not '
                    'mirrored, its resolution and origin, and the mount of the laser')
        (ahead, left, turn, x, y), error = steps.mean(axis=0), steps.std(axis=0) / math.sqrt(
            len(steps))
        if not (np.abs(steps.mean(axis=0)) > np.maximum(
                _ERRORS * error, [_STEP_M, _STEP_M, _TURN, _STEP_M, _STEP_M])).any():
            return ''
        by_robot, by_map = np.hypot(*error[:2]), np.hypot(*error[3:])
        causes = [f'the laser in tf or base_from_laser ({ahead:+.2f} m ahead, {left:+.2f} m left, '
                  f'{math.degrees(turn):+.1f} degrees)'] * bool(by_robot < _SPREAD * by_map)
        causes += [f'the origin of the grid ({-x:+.2f} m, {-y:+.2f} m)'] * bool(
            by_map < _SPREAD * by_robot)
        return f'scans move {len(steps)} accepted poses alike: correct {" or ".join(causes)}'

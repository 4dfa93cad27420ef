# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Scans of accepted poses: what they have in common is no error of these poses.

A wrong mount of the laser moves all poses alike in the axes of the robot, a wrong origin of the
grid in those of the map. A grid that is mirrored, or has a wrong resolution, fits nowhere.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.fit.scan_match import ScanFit
from cliploc_ros.core.geometry.transforms import SAME_BOXES

# Least and greatest number of looks for a verdict, least step [m] and turn [rad] of a fault, which
# is also this many standard errors, and the least share of beams that a right grid explains. All
# chosen.
_LEAST, _MOST, _STEP_M, _TURN, _ERRORS, _EXPLAINED = 5, 20, 0.1, math.radians(2.0), 3.0, 0.5


class ScanCheck:
    """Compares the scans of accepted poses with each other."""

    def __init__(self) -> None:
        # Each pose with the step of its laser in the axes of robot and map, and its explained
        # share of beams: ahead, left, turn, x, y, share.
        self._looks = deque[tuple[NDArray[np.float64], tuple[float, ...]]](maxlen=_MOST)

    def add(self, fit: ScanFit, map_from_base: NDArray[np.float64]) -> None:
        """Add the scan of an accepted pose (4, 4), unless it is that of the look before."""
        (x, y, turn), ((cos, _), (sin, _)) = fit.step, map_from_base[:2, :2]
        if not self._looks or not SAME_BOXES.agree(self._looks[-1][0], map_from_base):
            self._looks.append((map_from_base, (
                cos * x + sin * y, cos * y - sin * x, turn, x, y, fit.explained)))

    @property
    def fault(self) -> str:
        """Return what is wrong with laser or grid, and the remedy; empty without evidence."""
        if len(self._looks) < _LEAST:
            return ''
        numbers = np.array([look for _, look in self._looks])
        ahead, left, turn, x, y, share = numbers.mean(axis=0)
        is_alike = np.abs(numbers.mean(axis=0)) > np.maximum(
            _ERRORS * numbers.std(axis=0) / math.sqrt(len(numbers)),
            [_STEP_M, _STEP_M, _TURN, _STEP_M, _STEP_M, np.inf])
        if share >= _EXPLAINED and not is_alike.any():
            return ''
        wrong = 'the mount of the laser, or the origin of the grid' if share >= _EXPLAINED else \
            'the grid (place, mirror, resolution, origin), or the mount of the laser'
        return (f'scans of {len(numbers)} accepted poses have {share:.2f} of beams explained, and '
                f'move the laser by {ahead:+.2f} m ahead, {left:+.2f} m left and '
                f'{math.degrees(turn):+.1f} degrees, by {x:+.2f} and {y:+.2f} m in the map: '
                f'correct {wrong}')

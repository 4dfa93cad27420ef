# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check the depths of a request, so that wrong depths do no harm, and the scans of several.

Depth may have a wrong unit or scale, be of another camera, or be noise. Then it agrees with no
pose that fits the boxes. Right depths agree with the pose that the boxes determine, and hardly
change it.
"""

import math
from collections import deque
from itertools import pairwise
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit import refinement
from cliploc_ros.core.fit.finalists import Finalist
from cliploc_ros.core.fit.scan_match import ScanFit
from cliploc_ros.core.fit.verification import Rig, camera_pose, verify_rig
from cliploc_ros.core.geometry.depth import depth_odds
from cliploc_ros.core.geometry.transforms import SAME_BOXES

_TERMS = CALIBRATION.depth
# Of scans: least and greatest number of looks for a verdict, least steps [m] and turn [rad] of a
# fault, which are also this many standard errors, and the least share of beams that a right grid
# explains. All chosen.
_LEAST, _MOST, _ERRORS, _EXPLAINED = 5, 20, 3.0, 0.5
_LEAST_STEPS = (0.1, 0.1, math.radians(2.0), 0.1, 0.1, math.inf)


class DepthCheck(NamedTuple):
    """The agreement of depths and boxes of the objects that a pose matches."""

    objects: int  #: Number of matches with depth
    #: Log odds of depths that agree exactly minus those of the measured depths, summed
    lacking: float
    spoilt: float  #: By how much the depths raise the robust cost of the boxes
    ratio: float  #: Median ratio of the measured depths to the depths from the boxes alone

    @property
    def is_passed(self) -> bool:
        """Return whether the depths are plausible."""
        return self.lacking + _TERMS.spoilt * self.spoilt <= _TERMS.lacking * self.objects


class DepthScale:
    """The scale of a camera's depth, from its accepted poses."""

    def __init__(self) -> None:
        self._ratios: deque[float] = deque(maxlen=int(_TERMS.most_poses))

    def add(self, check: DepthCheck) -> None:
        """Add the check of an accepted pose."""
        self._ratios.append(check.ratio)

    @property
    def ratio(self) -> float:
        """Return the ratio of measured to true depth; 1 until there are enough poses."""
        return median(self._ratios) if len(self._ratios) >= _TERMS.least_poses else 1.0

    @property
    def is_wrong(self) -> bool:
        """Return whether the scale is too far off for the depths to be used."""
        return abs(math.log(self.ratio)) > math.log(_TERMS.most_ratio)


class ScanCheck:
    """Compares the scans of accepted poses: what they have in common is no error of these poses.

    A wrong mount of the laser moves all poses alike in the axes of the robot, a wrong origin of
    the grid in those of the map. A grid that is mirrored, or has a wrong resolution, fits nowhere.
    """

    def __init__(self) -> None:
        # Each pose, and the step of its laser ahead, left, in yaw, x and y, and its explained
        # share of beams.
        self._looks = deque[tuple[NDArray[np.float64], list[float]]](maxlen=_MOST)

    def add(self, fit: ScanFit, map_from_base: NDArray[np.float64]) -> None:
        """Add the scan of an accepted pose (4, 4), unless it is that of the look before."""
        if not self._looks or not SAME_BOXES.agree(self._looks[-1][0], map_from_base):
            x, y, turn = fit.step
            ahead, left = map_from_base[:2, :2].T @ (x, y)
            self._looks.append((map_from_base, [ahead, left, turn, x, y, fit.explained]))

    @property
    def fault(self) -> str:
        """Return what is wrong with laser or grid, and the remedy; empty without evidence."""
        numbers = np.array([look for _, look in self._looks] or [[0.0] * 6])
        ahead, left, turn, x, y, share = means = numbers.mean(axis=0)
        errors = _ERRORS * numbers.std(axis=0) / math.sqrt(len(numbers))
        is_alike = (np.abs(means) > np.maximum(errors, _LEAST_STEPS)).any()
        if len(numbers) < _LEAST or (share >= _EXPLAINED and not is_alike):
            return ''
        return (f'scans of {len(numbers)} accepted poses have {share:.2f} of beams explained, and '
                f'move the laser by {ahead:+.2f} m ahead, {left:+.2f} m left, '
                f'{math.degrees(turn):+.1f} degrees, in the map by {x:+.2f}, {y:+.2f} m: correct '
                f'its mount, or the grid{"" if share >= _EXPLAINED else ": place, resolution"}')


def check_depth(rig: Rig, pose: Finalist) -> DepthCheck | None:
    """Check the depths at a pose that was found with them; None if no match has depth."""
    if not rig.scene.depths.any():
        return None
    found = verify_rig(rig, pose.rotation, pose.translation)
    inliers = refinement.one_to_one(rig, found, pose.rotation, pose.translation)
    known = inliers.pairs[:, 15] > 0.0
    if not known.any():
        return None
    deviations = inliers.pairs[:, 15]
    depths = _depths(inliers, pose.rotation, pose.translation)
    errors = np.column_stack([depths - inliers.pairs[:, 14], deviations, depths])
    lacking = depth_odds(errors * (0.0, 1.0, 1.0)) - depth_odds(errors)
    boxes = rig._replace(scene=rig.scene._replace(depths=np.zeros_like(rig.scene.depths)))
    free = refinement.refine_rig(boxes, pose.rotation, pose.translation)
    edges = refinement.one_to_one(boxes, found, pose.rotation, pose.translation)
    costs = [refinement.robust_cost(residuals) if in_front else math.inf
             for in_front, residuals in (refinement.residuals_of_rig(
                 edges, fit.rotation, fit.translation) for fit in (pose, free))]
    measured = refinement.one_to_one(rig, found, free.rotation, free.translation).pairs[:, 14]
    return DepthCheck(
        int(known.sum()), float(lacking.sum()), costs[0] - costs[1],
        float(np.median((measured / _depths(inliers, free.rotation, free.translation))[known])))


def _depths(inliers: refinement.Inliers, rotation: NDArray[np.float64],
            translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the depth (m,) of each match's landmark in its camera."""
    depths = np.empty(len(inliers.pairs))
    for (first, last), camera in zip(pairwise(inliers.starts), inliers.cameras, strict=True):
        own_rotation, own_translation = camera_pose(camera, rotation, translation)
        depths[first:last] = inliers.pairs[first:last, 4:7] @ own_rotation[2] + own_translation[2]
    return depths

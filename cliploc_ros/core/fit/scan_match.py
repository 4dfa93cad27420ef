# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Compare a scan with an occupancy grid at a pose: how well it fits there, and only there.

A pose is moved to the best place of a window around it by correlation (Olson, "Real-time
correlative scan matching", 2009), then by Gauss-Newton on the likelihood field (Thrun, Burgard and
Fox 2005; Kohlbrecher et al. 2011).

The beams of a scan are no independent evidence: 90 beams on one wall are one wall. A fit is
therefore measured by its rank among random poses in the free space of the grid, which are moved
alike. In a corridor or an empty hall, many of them fit as well. Random poses at the same place do
not count, and those that correlate worst count as worse.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.covariance import moved_pose
from cliploc_ros.core.geometry import grid as grids
from cliploc_ros.core.geometry.transforms import move_covariance
from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.map.joined_map import place_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Scan

_TERMS = CALIBRATION.scan
# Number of beams that are compared, the least number that hits something, and the step between
# those that correlation uses, and those that are traced: neighbours meet the same walls.
_BEAMS, _LEAST_BEAMS, _EVERY = 90, 10, 2
# Windows: cells and steps of the yaw each way, and the step in the coarse and in the fine field
# [rad]. Penalty of a step, in beams, against moves that the scan does not observe.
_CELLS, _SIDE, _TURNS, _COARSE, _FINE, _STEP_COST = 2, 5, 3, 0.05, 0.0125, 0.1
_STEPS = np.add.outer(np.arange(-_CELLS, _CELLS + 1) ** 2, np.arange(-_CELLS, _CELLS + 1) ** 2)
# Number of the random poses that are moved in the fine field. Ranks with log odds in
# calibration.yaml; the logarithm of the rank is interpolated.
_REFINED, _RANKS = 250, (1, 4, 20, 100, 250)
# Random poses nearer than this to a pose [m] and in its direction are at the same place. Scores
# that differ by less are equal: poses along a corridor are no evidence against each other.
_SAME_M, _SAME_COSINE, _ALIKE = 0.5, 0.978, 0.05
# A beam passes through a wall if it ends farther behind it than this [m]. Score of a beam that
# does, and of one without an echo that does not.
_BEHIND_M, _THROUGH, _FREE = 0.3, -0.4, 0.5
# A beam is explained within two deviations. A scan with fewer explained beams moves no pose.
# A score is drawn to a usual value as if by a share of further beams, because nothing is known of
# beams that end in unknown cells.
_EXPLAINED, _LEAST_EXPLAINED, _USUAL, _USUAL_SHARE = math.exp(-2.0), 0.5, 0.3, 0.15
# Weight of 1 minus the mean likelihood of the beams: with all beams on one wall, the deviation
# is 4 cm.
_WEIGHT = 2.0 * (grids.DEVIATION_M / 0.04) ** 2
# Least deviations of a pose before it is moved [m] [rad], and the rows of x, y and yaw.
_LEAST_DEVIATIONS, _PLANAR = (0.05, 0.05, math.radians(1.0)), np.ix_([0, 1, 5], [0, 1, 5])


class ScanFit(NamedTuple):
    """How well a scan fits the grid at a pose."""

    odds: float  #: Log odds that the pose is right, by its rank
    explained: float  #: Share of the known beams that end at walls, or rightly have no echo
    rank: int  #: Rank of the pose, from 1, behind all of 2,000 random poses that fit as well
    #: x [m], y [m] and yaw [rad] by which the scan moves the laser, about the axes of the map
    step: tuple[float, ...]
    moved_m: float = 0.0  #: Distance by which the camera was moved [m]

    def __str__(self) -> str:
        """Return the fit in words."""
        return (f'scan {self.explained:.2f} of beams explained, rank {self.rank:,} of '
                f'2,000, moved {self.moved_m:.2f} m')


@compiled
def correlate(poses, beams, gaps, side_m, step):
    """Return the best pose of the window around each pose (n, 3), and its score: (n, 4).

    Parameters
    ----------
    beams : ndarray (b, 3)
        Their ends in the coordinate frame of the laser [m], and whether they hit something.
    gaps, side_m : ndarray (h, w), float
        A field, see GridField.
    step : float
        Step of the yaw [rad].
    """
    found, sums = np.full((len(poses), 4), -np.inf), np.empty((_SIDE, _SIDE))
    for row in range(len(poses)):
        for turn in range(-_TURNS, _TURNS + 1):
            yaw = poses[row, 2] + turn * step
            cos, sin = math.cos(yaw) / side_m, math.sin(yaw) / side_m
            x, y = poses[row, 0] / side_m - _CELLS, poses[row, 1] / side_m - _CELLS
            sums[:] = -_STEP_COST * (_STEPS + turn ** 2)
            for beam in range(0, len(beams), _EVERY):
                column = math.floor(x + cos * beams[beam, 0] - sin * beams[beam, 1])
                line = math.floor(y + sin * beams[beam, 0] + cos * beams[beam, 1])
                if (beams[beam, 2] and 0 <= column <= gaps.shape[1] - _SIDE
                        and 0 <= line <= gaps.shape[0] - _SIDE):
                    for i in range(_SIDE):
                        for j in range(_SIDE):
                            sums[i, j] += grids.LIKELIHOODS[gaps[line + i, column + j]]
            at, best = np.argmax(sums), sums.max()
            if best > found[row, 3]:
                found[row] = (poses[row, 0] + (at % _SIDE - _CELLS) * side_m,
                              poses[row, 1] + (at // _SIDE - _CELLS) * side_m, yaw, best)
    return found


@compiled
def score(pose, beams, gaps, side_m):
    """Return the score of a pose (3,), the share of explained beams, and that of known beams."""
    total, explained, known, is_free = 0.0, 0, 0, True
    for beam in range(len(beams)):
        angle = pose[2] + math.atan2(beams[beam, 1], beams[beam, 0])
        cos, sin = math.cos(angle), math.sin(angle)
        way_m, gone = math.hypot(beams[beam, 0], beams[beam, 1]), 0.0
        if beam % _EVERY == 0:
            is_free = True
            while is_free and gone < way_m - _BEHIND_M:
                j = math.floor((pose[0] + gone * cos) / side_m)
                i = math.floor((pose[1] + gone * sin) / side_m)
                if not (0 <= i < gaps.shape[0] and 0 <= j < gaps.shape[1]):
                    break
                is_free = gaps[i, j] > 0
                # unknown cells are at least three deviations from an occupied cell
                gap = _BEHIND_M if gaps[i, j] == grids.UNKNOWN else grids.GAP_M * gaps[i, j]
                gone += max(side_m, gap - side_m)
        j = math.floor((pose[0] + way_m * cos) / side_m)
        i = math.floor((pose[1] + way_m * sin) / side_m)
        is_inside = 0 <= i < gaps.shape[0] and 0 <= j < gaps.shape[1]
        if is_free and not (is_inside and gaps[i, j] != grids.UNKNOWN):
            continue
        known += 1
        reached = grids.LIKELIHOODS[gaps[i, j]] if beams[beam, 2] else _FREE
        value = reached if is_free else _THROUGH
        total, explained = total + value, explained + (value > _EXPLAINED)
    more, count = _USUAL_SHARE * len(beams), len(beams)
    return (total + more * _USUAL) / (known + more), explained / max(1, known), known / count


def _placed(poses: NDArray[np.float64], beams: NDArray[np.float64], field: grids.GridField
            ) -> NDArray[np.float64]:
    """Return poses (n, 3) where a scan fits best, with their scores: the best of them (m, 6)."""
    near = correlate(poses, beams, field.coarse, field.coarse_m, _COARSE)
    best, fine = np.argsort(-near[:, 3], kind='stable')[:_REFINED], field[:2]
    # a good pose may correlate worse
    found = [correlate(np.ascontiguousarray(starts), beams, *fine, _FINE)
             for starts in (poses[best], near[best, :3])]
    moved = np.where(found[0][:, 3:] > found[1][:, 3:], *found)[:, :3]
    return np.array([[*pose, *score(pose, beams, *fine)] for pose in moved])


@lru_cache(maxsize=2)
def _random(scan: Scan, grid: grids.OccupancyGrid, is_flipped: bool) -> NDArray[np.float64]:
    """Return the best of the random poses of a grid, see _placed."""
    return _placed(grid.field.poses, _beams(scan, is_flipped), grid.field)


def prepare(scan: Scan, grid: grids.OccupancyGrid) -> None:
    """Rank the random poses of a grid ahead, in another thread: the kernels hold no lock."""
    _random(scan, grid, False)


def _beams(scan: Scan, is_flipped: bool) -> NDArray[np.float64]:
    """Return the beams (b, 3) of a scan that are compared, see correlate."""
    rows = np.nonzero((scan.ranges > 0.0) & np.isfinite(scan.angles))[0]
    rows = rows[np.linspace(0, len(rows) - 1, min(_BEAMS, len(rows))).round().astype(np.int64)]
    angles, ranges = scan.angles[rows], np.minimum(scan.ranges[rows], scan.most_m)
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(
        -angles if is_flipped else angles), ranges < scan.most_m])


class ScanMatcher:
    """A scan, and the grid that it is compared with.

    Parameters
    ----------
    landmark_map : LandmarkMap
        The map of the poses, which may be a JoinedMap. The grid says nothing about poses on other
        maps than its own.
    """

    def __init__(self, scan: Scan, grid: grids.OccupancyGrid, landmark_map: LandmarkMap) -> None:
        self._scan, self._grid, self._map = scan, grid, landmark_map
        # rotates x, y and yaw from the grid to its coordinate frame, because it is level
        self._turn = grid.frame_from_grid[:3, :3]

    def fits(self, pose: NDArray[np.float64]) -> ScanFit | None:
        """Return how well the scan fits at a pose (4, 4); None if it says nothing."""
        at = self._laser(pose)
        if at is None:
            return None
        start, beams, is_flipped = at
        random, found = _random(self._scan, self._grid, is_flipped), _placed(
            start[None], beams, self._grid.field)[0]
        offsets = random[:, :3] - found[:3]
        others = random[(np.hypot(*offsets[:, :2].T) >= _SAME_M)
                        | (np.cos(offsets[:, 2]) <= _SAME_COSINE), 3]
        # behind the poses that fit clearly better, and behind all that fit as well
        better, rank = (others > found[3] + [[_ALIKE], [-_ALIKE]]).sum(axis=1) + 1
        against, by_rank = np.interp(np.log([better, rank]), np.log(_RANKS), [
            _TERMS[f'rank_{knot}'] for knot in _RANKS])
        odds = found[5] * (min(0.0, against) + max(0.0, by_rank) * np.interp(
            found[4], (_TERMS.explained, _TERMS.well_explained), (0.0, 1.0)) * min(
                1.0, np.ptp(self._scan.angles) / _TERMS.wide_rad))
        return ScanFit(float(odds), float(found[4]), int(rank),
                       tuple((self._turn @ (found[:3] - start)).tolist()))

    def moved(self, pose: NDArray[np.float64], covariance: NDArray[np.float64], fit: ScanFit
              ) -> tuple[NDArray[np.float64], NDArray[np.float64], ScanFit]:
        """Move a pose (4, 4) with a covariance (6, 6) where the scan observes it.

        A corridor fixes one direction and the yaw. The scan and the covariance are weighed by
        their information. A pose that the scan does not support is not moved.
        """
        at = self._laser(pose)
        if at is None or fit.odds < 0.0 or fit.explained < _LEAST_EXPLAINED:
            return pose, covariance, fit
        (start, beams, _), (gaps, side_m, *_), turn = at, self._grid.field, self._turn
        hits = beams[beams[:, 2] > 0.0, :2]
        lever = pose[:3, :3] @ self._scan.camera_from_laser[:3, 3]
        of_laser, seen = move_covariance(covariance, lever), np.zeros((6, 6))
        planar = turn.T @ of_laser[_PLANAR] @ turn + np.diag(_LEAST_DEVIATIONS) ** 2
        root, weight = np.linalg.cholesky(np.linalg.inv(planar)).T, _WEIGHT / len(hits)

        def errors(its: NDArray[np.float64]) -> NDArray[np.float64]:
            cos, sin = math.cos(its[2]), math.sin(its[2])
            ends = its[:2] + hits @ [[cos, sin], [-sin, cos]]
            away = map_coordinates(gaps, ends.T[::-1] / side_m - 0.5, float, 1, 'nearest')
            return np.append(np.sqrt(weight * (1.0 - grids.LIKELIHOODS[1] ** away ** 2)),
                             root @ (its - start))
        best = least_squares(errors, start + turn.T @ fit.step, diff_step=1e-4, max_nfev=12)
        seen[_PLANAR] = (rows := turn @ best.jac[:len(hits)].T) @ rows.T
        smaller = np.linalg.inv(np.linalg.inv(of_laser) + seen)
        x, y, yaw = (turn @ (best.x - start)).tolist()
        shifted = moved_pose(pose, np.array([x, y, 0.0, 0.0, 0.0, yaw]))  # about the camera
        shifted[:2, 3] += (lever - shifted[:3, :3] @ self._scan.camera_from_laser[:3, 3])[:2]
        return shifted, move_covariance((smaller + smaller.T) / 2, -lever), fit._replace(
            step=(x, y, yaw), moved_m=float(np.linalg.norm(shifted[:3, 3] - pose[:3, 3])))

    def _laser(self, pose: NDArray[np.float64]
               ) -> tuple[NDArray[np.float64], NDArray[np.float64], bool] | None:
        """Return the pose (3,) of the laser in the field, its beams, and if it is upside down.

        None if the pose is not in the grid's map, or if the scan cannot be compared. The laser of
        a standing robot is level, so the tilt of the pose is ignored.
        """
        its, grid = place_of(self._map, pose), self._grid
        its_laser = its.map_from_camera @ self._scan.camera_from_laser
        laser = np.linalg.solve(grid.frame_from_grid, its_laser)
        beams = _beams(self._scan, is_flipped := bool(laser[2, 2] < 0.0))
        if (its.part.landmark_map.frame_id != grid.frame_id or not len(grid.field.poses)
                or beams[:, 2].sum() < _LEAST_BEAMS):
            return None
        return np.append(laser[:2, 3] + grid.field.margin_m, math.atan2(
            laser[1, 0], laser[0, 0])), beams, is_flipped



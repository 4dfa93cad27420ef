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
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.fit.covariance import moved_pose
from cliploc_ros.core.fit.refinement import solve
from cliploc_ros.core.geometry.grid import GAP_M, UNKNOWN, OccupancyGrid
from cliploc_ros.core.geometry.transforms import invert_transform, move_covariance
from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.map.joined_map import place_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Scan

_TERMS = CALIBRATION.scan
# Number of beams that are compared, the least number that hits something, and the step between
# those that correlation uses, and those that are traced: neighbours meet the same walls.
_BEAMS, _LEAST_BEAMS, _EVERY = 90, 10, 2
# The window: cells of the coarse field and steps of the yaw each way. Penalty of a step, in
# likelihood of a beam, against moves that the scan does not observe.
_CELLS, _TURNS, _TURN, _STEP_COST = 2, 3, math.radians(3.0), 0.002
# Number of the random poses that are moved by Gauss-Newton, and its number of steps.
_REFINED, _STEPS = 250, 6
# Ranks with log odds in calibration.yaml. The logarithm of the rank is interpolated.
_RANKS = (1, 4, 20, 100, _REFINED)
# Damping for each beam. The errors are squares of distances, so a step of Gauss-Newton ends
# halfway to the wall: it is doubled. Information of the pose before it is moved, for each beam.
_DAMPING, _DOUBLE, _WEAK = 0.3, 2.0, 0.04 * np.diag([1.0, 1.0, 4.0])
# Random poses nearer than this to a pose [m] [rad] are at the same place. Scores that differ by
# less are equal: poses along a corridor are no evidence for or against each other.
_SAME_M, _SAME, _ALIKE = 0.5, math.radians(12.0), 0.05
# A beam passes through a wall if it ends farther behind it than this [m]. Score of a beam that
# does, of one without an echo that does, and of one without an echo that meets no wall.
_BEHIND_M, _THROUGH, _MISSED, _FREE = 0.3, -0.5, -0.25, 0.5
# A beam is explained within two deviations. A scan with fewer explained beams moves no pose.
_EXPLAINED, _LEAST_EXPLAINED = math.exp(-2.0), 0.5
# A score is drawn to this value as if by a share of further beams, because nothing is known of
# beams that end in unknown cells.
_USUAL, _USUAL_SHARE = 0.3, 0.15
# Information of a scan, in units of the squared errors of a beam: with all beams on one wall, the
# deviation is 4 cm. It is the mean at a distance from the pose [m], with yaw at a range [m].
_WEIGHT, _ASIDE = 20.0, np.diag([0.1, 0.1, 0.05])
# Least deviations of a pose before it is moved [m] [rad], and the rows of x, y and yaw.
_LEAST_DEVIATIONS, _PLANAR = (0.05, 0.05, math.radians(1.0)), np.ix_([0, 1, 5], [0, 1, 5])


class ScanFit(NamedTuple):
    """How well a scan fits the grid at a pose."""

    odds: float  #: Log odds that the pose is right, by its rank
    explained: float  #: Share of the beams that end at walls, among those that should
    rank: int  #: Rank of the pose, from 1, behind all random poses that fit as well
    better: int  #: The same behind those that fit clearly better
    of: int  #: Number of random poses
    #: x [m], y [m] and yaw [rad] by which the scan moves the laser, about the axes of the map
    step: tuple[float, ...]
    moved_m: float = 0.0  #: Distance by which the camera was moved [m]

    def __str__(self) -> str:
        """Return the fit in words."""
        return (f'scan {self.explained:.2f} of beams explained, rank {self.rank:,} of '
                f'{self.of:,}, moved {self.moved_m:.2f} m')


@compiled
def correlate(poses, beams, field):
    """Return each pose (n, 3) and the best one in the window (n, 2, 3), and its score (n,).

    The beams (b, 3) are their ends in the coordinate frame of the laser [m], and whether they hit
    something; the field is a GridField.
    """
    found, scores = np.empty((len(poses), 2, 3)), np.full(len(poses), -np.inf)
    side, coarse, side_m = 2 * _CELLS + 1, field.coarse, field.coarse_m
    sums = np.empty((side, side), dtype=np.int32)
    for row in range(len(poses)):
        found[row] = poses[row]
        for turn in range(-_TURNS, _TURNS + 1):
            yaw = poses[row, 2] + turn * _TURN
            cos, sin = math.cos(yaw) / side_m, math.sin(yaw) / side_m
            x, y = poses[row, 0] / side_m - _CELLS, poses[row, 1] / side_m - _CELLS
            sums[:] = 0
            for beam in range(0, len(beams), _EVERY):
                column = math.floor(x + cos * beams[beam, 0] - sin * beams[beam, 1])
                line = math.floor(y + sin * beams[beam, 0] + cos * beams[beam, 1])
                if (beams[beam, 2] and 0 <= column <= coarse.shape[1] - side
                        and 0 <= line <= coarse.shape[0] - side):
                    for i in range(side):
                        for j in range(side):
                            sums[i, j] += coarse[line + i, column + j]
            for i in range(side):
                for j in range(side):
                    steps = (i - _CELLS) ** 2 + (j - _CELLS) ** 2 + turn ** 2
                    value = sums[i, j] - 255.0 * _STEP_COST * steps * len(beams) / _EVERY
                    if value > scores[row]:
                        scores[row], found[row, 1, 2] = value, yaw
                        found[row, 1, 0] = poses[row, 0] + (j - _CELLS) * side_m
                        found[row, 1, 1] = poses[row, 1] + (i - _CELLS) * side_m
    return found, scores


@compiled
def equations(pose, beams, field):
    """Return the squared errors of the ends of beams, and the normal equations (3, 4).

    The error of an end is 1 minus its likelihood.
    """
    cos, sin, cost = math.cos(pose[2]), math.sin(pose[2]), 0.0
    sums, row, gaps, table = np.zeros((3, 4)), np.empty(4), field.gaps, field.table
    for beam in range(len(beams)):
        ahead = cos * beams[beam, 0] - sin * beams[beam, 1]
        aside = sin * beams[beam, 0] + cos * beams[beam, 1]
        u, v = (pose[0] + ahead) / field.side_m - 0.5, (pose[1] + aside) / field.side_m - 0.5
        j, i = math.floor(u), math.floor(v)
        if not beams[beam, 2]:
            continue
        cost += 1.0
        if not (0 <= i < gaps.shape[0] - 1 and 0 <= j < gaps.shape[1] - 1):
            continue
        u, v = u - j, v - i
        first, second = table[gaps[i, j]], table[gaps[i, j + 1]]
        third, fourth = table[gaps[i + 1, j]], table[gaps[i + 1, j + 1]]
        row[0] = ((1.0 - v) * (second - first) + v * (fourth - third)) / field.side_m
        row[1] = ((1.0 - u) * (third - first) + u * (fourth - second)) / field.side_m
        row[2] = row[1] * ahead - row[0] * aside
        row[3] = 1.0 - ((1.0 - v) * ((1.0 - u) * first + u * second)
                        + v * ((1.0 - u) * third + u * fourth))
        cost += row[3] * row[3] - 1.0
        for i in range(3):
            for j in range(4):
                sums[i, j] += row[i] * row[j]
    return cost, sums


@compiled
def climb(start, center, prior, beams, field):
    """Return the pose (3,) that minimizes the squared errors, and this minimum.

    They include the square of the step from `center` (3,), with information `prior` (3, 3).
    """
    pose, best, least, step = start.copy(), start.copy(), np.inf, np.empty(3)
    for _ in range(_STEPS + 1):
        cost, sums = equations(pose, beams, field)
        for i in range(3):
            for j in range(3):
                cost += (pose[i] - center[i]) * prior[i, j] * (pose[j] - center[j])
                sums[i, 3] -= prior[i, j] * (pose[j] - center[j])
                sums[i, j] += prior[i, j]
            sums[i, i] += _DAMPING * len(beams) * (1.0 if i < 2 else 4.0)
        if cost < least and solve(sums[:, :3], sums[:, 3], step):
            least, best[:] = cost, pose
            pose += _DOUBLE * step
        else:  # too far
            pose[:] = 0.5 * (pose + best)
    return best, least


@compiled
def score(pose, beams, field):
    """Return the score of a pose (3,), the share of explained beams, and that of known beams."""
    total, hits, explained, known, is_free = 0.0, 0, 0, 0, True
    gaps, side_m = field.gaps, field.side_m
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
                gap = _BEHIND_M if gaps[i, j] == UNKNOWN else GAP_M * gaps[i, j]
                gone += max(side_m, gap - side_m)
        j = math.floor((pose[0] + way_m * cos) / side_m)
        i = math.floor((pose[1] + way_m * sin) / side_m)
        is_inside = 0 <= i < gaps.shape[0] and 0 <= j < gaps.shape[1]
        if is_free and not (is_inside and gaps[i, j] != UNKNOWN):
            continue
        known += 1
        if beams[beam, 2]:
            value = field.table[gaps[i, j]] if is_free else _THROUGH
            hits, explained = hits + 1, explained + (value > _EXPLAINED)
        else:
            value = _FREE if is_free else _MISSED
        total += value
    share = _USUAL_SHARE * len(beams)
    return (total + share * _USUAL) / (known + share), explained / max(1, hits), known / len(beams)


@compiled
def place(starts, beams, field, prior):
    """Return the best pose of starts (n, s, 3), and its score: (n, 6), see climb and score."""
    found = np.empty((len(starts), 6))
    for row in range(len(starts)):
        least = np.inf
        for start in starts[row]:
            pose, cost = climb(start, start, prior, beams, field)
            if cost < least:
                least, found[row, :3] = cost, pose
        found[row, 3:] = score(found[row, :3], beams, field)
    return found


def _placed(poses: NDArray[np.float64], beams: NDArray[np.float64], grid: OccupancyGrid,
            most: int | None = None) -> NDArray[np.float64]:
    """Return the best `most` of poses (n, 3), moved to where a scan fits best, see place."""
    starts, scores = correlate(poses, beams, grid.field)
    best = np.argsort(-scores, kind='stable')[:most]
    return np.asarray(place(starts[best], beams, grid.field, len(beams) * _WEAK))


@lru_cache(maxsize=2)
def _random(scan: Scan, grid: OccupancyGrid, is_flipped: bool) -> NDArray[np.float64]:
    """Return the best of the random poses of a grid, see _placed."""
    return _placed(grid.field.poses, _beams(scan, is_flipped), grid, _REFINED)


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

    def __init__(self, scan: Scan, grid: OccupancyGrid, landmark_map: LandmarkMap) -> None:
        self._scan, self._grid, self._map = scan, grid, landmark_map
        self._turn = np.eye(3)  # rotates x, y and yaw from the grid to its coordinate frame
        self._turn[:2, :2] = grid.frame_from_grid[:2, :2]

    def fits(self, pose: NDArray[np.float64]) -> ScanFit | None:
        """Return how well the scan fits at a pose (4, 4); None if it says nothing."""
        at = self._laser(pose)
        if at is None:
            return None
        start, beams, is_flipped = at
        random, found = _random(self._scan, self._grid, is_flipped), _placed(
            start[None], beams, self._grid)[0]
        offsets = random[:, :3] - found[:3]
        apart = np.abs((offsets[:, 2] + math.pi) % (2.0 * math.pi) - math.pi)
        others = random[(np.hypot(*offsets[:, :2].T) >= _SAME_M) | (apart >= _SAME), 3]
        better, rank = (1 + int((others > found[3] + margin).sum()) for margin in (_ALIKE, -_ALIKE))
        against, by_rank = np.interp(np.log([better, rank]), np.log(_RANKS), [*_TERMS.values()])
        odds = found[5] * (max(0.0, by_rank) + min(0.0, against))
        return ScanFit(float(odds), float(found[4]), rank, better, len(self._grid.field.poses),
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
        (start, beams, _), field, turn = at, self._grid.field, self._turn
        lever = pose[:3, :3] @ self._scan.camera_from_laser[:3, 3]
        of_laser, seen = move_covariance(covariance, lever), np.zeros((6, 6))
        planar = turn.T @ of_laser[_PLANAR] @ turn + np.diag(_LEAST_DEVIATIONS) ** 2
        weight = _WEIGHT / beams[:, 2].sum()
        best = min((climb(each, start, np.linalg.inv(planar) / weight, beams, field)
                    for each in (start, start + turn.T @ fit.step)), key=itemgetter(1))[0]
        seen[_PLANAR] = weight * turn @ sum(
            equations(best + aside, beams, field)[1][:, :3] for aside in (*_ASIDE, *-_ASIDE)
        ) @ turn.T
        smaller = np.linalg.inv(np.linalg.inv(of_laser) + seen)
        x, y, yaw = (turn @ (best - start)).tolist()
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
        laser = (invert_transform(grid.frame_from_grid) @ its.map_from_camera
                 @ self._scan.camera_from_laser)
        is_flipped = bool(laser[2, 2] < 0.0)
        beams = _beams(self._scan, is_flipped)
        if (its.part.landmark_map.frame_id != grid.frame_id or not len(grid.field.poses)
                or beams[:, 2].sum() < _LEAST_BEAMS):
            return None
        spot = laser[:2, 3] + grid.field.margin_m
        return np.array([*spot, math.atan2(laser[1, 0], laser[0, 0])]), beams, is_flipped


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

from cliploc_ros.core.calibration import CALIBRATION
from cliploc_ros.core.geometry import grid as grids
from cliploc_ros.core.geometry.grid import GAP_M, UNKNOWN, OccupancyGrid, likelihoods
from cliploc_ros.core.geometry.transforms import invert_transform, make_transform, move_covariance
from cliploc_ros.core.kernels.compiled import compiled
from cliploc_ros.core.map.joined_map import parts_of, place_of
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Scan

_TERMS = CALIBRATION.scan
# Least number of beams that hit something, number of beams that are compared, and the share of
# them that correlation uses.
_LEAST_BEAMS, _BEAMS, _CORRELATED = 10, 90, 2
# The window: cells of the coarse field and steps of the yaw each way.
_CELLS, _TURNS, _TURN = 2, 3, math.radians(3.0)
# Penalty of a step in the window, in likelihood of a beam, against moves that the scan does not
# observe.
_STEP_COST = 0.002
# Share of the random poses that are moved by Gauss-Newton, the number of its starts, one for each
# yaw with the best correlation and the given pose, and its number of steps.
_REFINED, _STARTS, _STEPS = 0.125, 3, 6
# Damping for each beam. The errors are squares of distances, so a step of Gauss-Newton ends
# halfway to the wall: it is doubled.
_DAMPING, _DOUBLE = 0.3, 2.0
# Random poses nearer than this to a pose [m] [rad] are at the same place. Scores that differ by
# less are equal: poses along a corridor are no evidence for or against each other.
_SAME_M, _SAME, _ALIKE = 0.5, math.radians(12.0), 0.05
# A beam passes through a wall if it ends farther behind it than this [m]. Score of a beam that
# does, of one without an echo that does, and of one without an echo that meets no wall.
_BEHIND_M, _THROUGH, _MISSED, _FREE = 0.3, -0.5, -0.25, 0.5
# Every second beam is traced, because neighbours meet the same walls.
_TRACED = 2
# A beam is explained if its likelihood exceeds this, at two deviations.
_EXPLAINED = math.exp(-2.0)
# A scan with a smaller share of explained beams moves no pose.
_LEAST_EXPLAINED = 0.5
# A score is drawn to this value as if by a share of further beams, because nothing is known of
# beams that end in unknown cells.
_USUAL, _USUAL_SHARE = 0.3, 0.15
# Information of a scan with all beams on walls, in units of the squared errors of a beam: a
# deviation of 4 cm. The share of the information of such a scan on one wall below which a
# direction is not observed.
_WEIGHT, _LEAST_OBSERVED = 50.0, 0.08
_MOST_OBSERVED = _WEIGHT * ((1.0 - math.exp(-0.5)) / grids.DEVIATION_M) ** 2
# Steps of the differences that measure it [m], at the distance of a usual wall [m].
_DELTA_M, _LEVER_M = 0.1, 2.0
# Least deviations of a pose before it is moved [m] [rad].
_LEAST_DEVIATIONS = (0.05, 0.05, math.radians(1.0))
_TABLE = likelihoods(grids.DEVIATION_M)
_PLANAR = [0, 1, 5]


class ScanFit(NamedTuple):
    """How well a scan fits the grid at a pose."""

    odds: float  #: Log odds that the pose is right, by its rank
    explained: float  #: Share of the beams that end at walls, among those that should
    rank: int  #: Rank of the pose, from 1, behind all random poses that fit as well
    better: int  #: The same behind those that fit clearly better
    of: int  #: Number of random poses
    #: x [m], y [m] and yaw [rad] by which the scan moves the laser, about the axes of the map
    step: tuple[float, float, float]
    moved_m: float = 0.0  #: Distance by which the camera was moved [m]

    def __str__(self) -> str:
        """Return the fit in words."""
        return (f'scan {self.explained:.2f} of beams explained, rank {self.rank:,} of '
                f'{self.of:,}, moved {self.moved_m:.2f} m')


@compiled
def correlate(poses, points, field, side_m):
    """Return the starts (n, _STARTS, 3) around each pose (n, 3), and the best score (n,) to 255.

    The first start is the pose itself, the others are the best of the window at different yaws.

    Parameters
    ----------
    points : ndarray (b, 2)
        Ends of beams in the coordinate frame of the laser [m].
    field : ndarray (H, W)
        Coarse field, with cells of a side [m].
    """
    found, scores = np.empty((len(poses), _STARTS, 3)), np.empty(len(poses))
    side = 2 * _CELLS + 1
    sums, best = np.empty((side, side), dtype=np.int32), np.empty((2 * _TURNS + 1, 4))
    penalty = 255.0 * _STEP_COST * len(points)
    for row in range(len(poses)):
        best[:, 3] = -np.inf
        for turn in range(-_TURNS, _TURNS + 1):
            yaw = poses[row, 2] + turn * _TURN
            cos, sin = math.cos(yaw) / side_m, math.sin(yaw) / side_m
            x, y = poses[row, 0] / side_m - _CELLS, poses[row, 1] / side_m - _CELLS
            sums[:] = 0
            for beam in range(len(points)):
                column = math.floor(x + cos * points[beam, 0] - sin * points[beam, 1])
                line = math.floor(y + sin * points[beam, 0] + cos * points[beam, 1])
                if (0 <= column <= field.shape[1] - side) and (0 <= line <= field.shape[0] - side):
                    for i in range(side):
                        for j in range(side):
                            sums[i, j] += field[line + i, column + j]
            for i in range(side):
                for j in range(side):
                    steps = (i - _CELLS) ** 2 + (j - _CELLS) ** 2 + turn ** 2
                    if sums[i, j] - penalty * steps > best[_TURNS + turn, 3]:
                        best[_TURNS + turn] = (poses[row, 0] + (j - _CELLS) * side_m,
                                               poses[row, 1] + (i - _CELLS) * side_m, yaw,
                                               sums[i, j] - penalty * steps)
        scores[row], found[row, 0] = best[:, 3].max(), poses[row]
        for start in range(1, _STARTS):
            at = np.argmax(best[:, 3])
            found[row, start], best[at, 3] = best[at, :3], -np.inf
    return found, scores / max(1, len(points))


@compiled
def _gradient(pose, points, gaps, table, side_m, sums):
    """Return the squared errors of the ends of beams; sums (3, 4): normal equations.

    The error of an end is 1 minus its likelihood.
    """
    cos, sin, cost = math.cos(pose[2]), math.sin(pose[2]), 0.0
    sums[:] = 0.0
    for beam in range(len(points)):
        ahead = cos * points[beam, 0] - sin * points[beam, 1]
        aside = sin * points[beam, 0] + cos * points[beam, 1]
        u, v = (pose[0] + ahead) / side_m - 0.5, (pose[1] + aside) / side_m - 0.5
        j, i = math.floor(u), math.floor(v)
        if not (0 <= i < gaps.shape[0] - 1 and 0 <= j < gaps.shape[1] - 1):
            cost += 1.0
            continue
        u, v = u - j, v - i
        first, second = table[gaps[i, j]], table[gaps[i, j + 1]]
        third, fourth = table[gaps[i + 1, j]], table[gaps[i + 1, j + 1]]
        error = 1.0 - ((1.0 - v) * ((1.0 - u) * first + u * second)
                       + v * ((1.0 - u) * third + u * fourth))
        dx = ((1.0 - v) * (second - first) + v * (fourth - third)) / side_m
        dy = ((1.0 - u) * (third - first) + u * (fourth - second)) / side_m
        turn = dy * ahead - dx * aside
        cost += error * error
        sums[0, 0] += dx * dx
        sums[0, 1] += dx * dy
        sums[0, 2] += dx * turn
        sums[1, 1] += dy * dy
        sums[1, 2] += dy * turn
        sums[2, 2] += turn * turn
        sums[0, 3] += dx * error
        sums[1, 3] += dy * error
        sums[2, 3] += turn * error
    return cost


@compiled
def climb(start, center, prior, points, gaps, table, side_m):
    """Return the pose (3,) that minimizes the squared errors, and this minimum.

    The squared errors include those of the step from `center` (3,), with information `prior`
    (3, 3).
    """
    pose, best, least = start.copy(), start.copy(), np.inf
    sums, step = np.empty((3, 4)), np.empty(3)
    for _ in range(_STEPS + 1):
        cost = _gradient(pose, points, gaps, table, side_m, sums)
        for i in range(3):
            step[i] = pose[i] - center[i]
        for i in range(3):
            for j in range(3):
                cost += step[i] * prior[i, j] * step[j]
                sums[min(i, j), max(i, j)] += prior[i, j] * (1.0 if i <= j else 0.0)
                sums[i, 3] -= prior[i, j] * step[j]
        if cost >= least:  # too far
            pose[:] = 0.5 * (pose + best)
            continue
        least, best[:] = cost, pose
        damping = _DAMPING * len(points)
        a, b, c = sums[0, 0] + damping, sums[0, 1], sums[0, 2]
        d, e, f = sums[1, 1] + damping, sums[1, 2], sums[2, 2] + damping * _LEVER_M ** 2
        p, q, r = d * f - e * e, c * e - b * f, b * e - c * d
        s, t, u = a * f - c * c, b * c - a * e, a * d - b * b
        size = (a * p + b * q + c * r) / _DOUBLE
        x, y, z = sums[0, 3], sums[1, 3], sums[2, 3]
        pose[0] += (p * x + q * y + r * z) / size
        pose[1] += (q * x + s * y + t * z) / size
        pose[2] += (r * x + t * y + u * z) / size
    return best, least


@compiled
def _is_free(pose, cos, sin, way_m, gaps, side_m):
    """Return whether a beam with a direction meets no occupied cell on its way."""
    gone = 0.0
    while gone < way_m:
        j = math.floor((pose[0] + gone * cos) / side_m)
        i = math.floor((pose[1] + gone * sin) / side_m)
        if not (0 <= i < gaps.shape[0] and 0 <= j < gaps.shape[1]):
            return True
        if gaps[i, j] == 0:
            return False
        # unknown cells are at least three deviations from an occupied cell
        gap = _BEHIND_M if gaps[i, j] == UNKNOWN else GAP_M * gaps[i, j]
        gone += max(side_m, gap - side_m)
    return True


@compiled
def score(pose, beams, gaps, table, side_m):
    """Return the score of a pose (3,), the share of explained beams, and that of known beams.

    The beams (b, 3) are the ends of beams [m] and whether they hit something.
    """
    total, hits, explained, known, is_free = 0.0, 0, 0, 0, True
    for beam in range(len(beams)):
        turned = pose[2] + math.atan2(beams[beam, 1], beams[beam, 0])
        cos, sin = math.cos(turned), math.sin(turned)
        way_m = math.hypot(beams[beam, 0], beams[beam, 1])
        is_hit = beams[beam, 2] > 0.0
        if beam % _TRACED == 0:
            is_free = _is_free(pose, cos, sin, way_m - _BEHIND_M, gaps, side_m)
        j = math.floor((pose[0] + way_m * cos) / side_m)
        i = math.floor((pose[1] + way_m * sin) / side_m)
        is_known = (0 <= i < gaps.shape[0] and 0 <= j < gaps.shape[1]) and gaps[i, j] != UNKNOWN
        if is_free and not is_known:
            continue
        known += 1
        if is_hit:
            hits += 1
            value = table[gaps[i, j]] if is_free else _THROUGH
            explained += value > _EXPLAINED
        else:
            value = _FREE if is_free else _MISSED
        total += value
    share = _USUAL_SHARE * len(beams)
    return (total + share * _USUAL) / (known + share), explained / max(1, hits), known / len(beams)


@compiled
def place_poses(starts, beams, points, gaps, table, side_m, prior):
    """Return the best pose (n, 3) by Gauss-Newton of starts (n, s, 3), and its score (n,)."""
    found, scores = np.empty((len(starts), 3)), np.empty(len(starts))
    for row in range(len(starts)):
        least = np.inf
        for start in starts[row]:
            pose, cost = climb(start, start, prior, points, gaps, table, side_m)
            if cost < least:
                least, found[row] = cost, pose
        scores[row] = score(found[row], beams, gaps, table, side_m)[0]
    return found, scores


class _Random(NamedTuple):
    """The random poses with the best scores."""

    poses: NDArray[np.float64]  #: (n, 3)
    scores: NDArray[np.float64]  #: (n,)


# Weak, so that poses do not move where the scan observes nothing.
_WEAK = 0.01 * _BEAMS * np.diag([4.0, 4.0, 1.0 / _SAME ** 2])


class ScanMatcher:
    """A scan, and the grid that it is compared with.

    Parameters
    ----------
    scan : Scan
        The scan when the image was taken.
    landmark_map : LandmarkMap
        The map of the poses, which may be a JoinedMap. The grid says nothing about poses on other
        maps than its own.
    """

    def __init__(self, scan: Scan, grid: OccupancyGrid, landmark_map: LandmarkMap) -> None:
        self._scan, self._grid, self._map = scan, grid, landmark_map
        names = [part.landmark_map.frame_id for part in parts_of(landmark_map)]
        is_known = (scan.ranges > 0.0) & np.isfinite(scan.angles)
        #: Whether the scan can be compared with the grid
        self.is_usable = (grid.frame_id in names and len(grid.field.poses) > 0 and int(
            (is_known & (scan.ranges < scan.most_m)).sum()) >= _LEAST_BEAMS)

    def fits(self, pose: NDArray[np.float64]) -> ScanFit | None:
        """Return how well the scan fits at a pose (4, 4); None if it says nothing."""
        at = self._laser(pose)
        if at is None:
            return None
        start, is_flipped = at
        beams, random = _beams(self._scan, is_flipped), _random(self._scan, self._grid, is_flipped)
        found, value, explained, known = _placed(start, beams, self._grid)
        x, y, turn = _in_map(self._grid) @ (found - start)
        apart = np.abs((random.poses[:, 2] - found[2] + math.pi) % (2.0 * math.pi) - math.pi)
        is_there = (np.hypot(*(random.poses - found)[:, :2].T) < _SAME_M) & (apart < _SAME)
        others, count = random.scores[~is_there], len(self._grid.field.poses)
        better, rank = (1 + int((others > value + margin).sum()) for margin in (_ALIKE, -_ALIKE))
        knots = {1.0 / count: _TERMS.first, 0.002: _TERMS.top_2_in_1000, 0.01: _TERMS.top_1_in_100,
                 0.05: _TERMS.top_1_in_20, _REFINED: _TERMS.others}
        against, by_rank = np.interp(np.log([better / count, rank / count]), np.log([*knots]),
                                     [*knots.values()])
        odds = known * float(max(0.0, by_rank) + min(0.0, against))
        return ScanFit(odds, explained, rank, better, count, (float(x), float(y), float(turn)))

    def moved(self, pose: NDArray[np.float64], covariance: NDArray[np.float64], fit: ScanFit
              ) -> tuple[NDArray[np.float64], NDArray[np.float64], ScanFit]:
        """Move a pose (4, 4) with a covariance (6, 6) where the scan observes it.

        A corridor fixes one direction and the yaw. The scan and the covariance are weighed by
        their information. A pose that the scan does not support is not moved.
        """
        at = self._laser(pose)
        if at is None or fit.odds < 0.0 or fit.explained < _LEAST_EXPLAINED:
            return pose, covariance, fit
        start, is_flipped = at
        beams, field, side_m = _beams(self._scan, is_flipped), self._grid.field, (
            self._grid.resolution_m)
        points = np.ascontiguousarray(beams[beams[:, 2] > 0.0, :2])
        turn = _in_map(self._grid)
        lever = (pose @ self._scan.camera_from_laser)[:3, 3] - pose[:3, 3]
        of_laser = move_covariance(covariance, lever)
        planar = turn.T @ of_laser[np.ix_(_PLANAR, _PLANAR)] @ turn
        weight = _WEIGHT / len(points)
        prior = np.linalg.inv(planar + np.diag(_LEAST_DEVIATIONS) ** 2) / weight
        starts = [start, start + turn.T @ fit.step]
        best = min((climb(each, start, prior, points, field.gaps, _TABLE, side_m)
                    for each in starts), key=lambda found: found[1])[0]
        information = weight * _curvature(best, points, self._grid)
        scale = np.array([1.0, 1.0, 1.0 / _LEVER_M])
        sizes, axes = np.linalg.eigh(scale[:, None] * information * scale)
        is_seen = sizes > _LEAST_OBSERVED * _MOST_OBSERVED
        kept = axes[:, is_seen] @ axes[:, is_seen].T
        step = turn @ (scale * (kept @ ((best - start) / scale)))
        seen = np.zeros((6, 6))
        seen[np.ix_(_PLANAR, _PLANAR)] = turn @ (
            kept @ (scale[:, None] * information * scale) @ kept
            / scale[:, None] / scale) @ turn.T
        smaller = np.linalg.inv(np.linalg.inv(of_laser) + seen)
        shifted = _turned(step, pose[:3, 3] + lever) @ pose
        moved_m = float(np.linalg.norm(shifted[:3, 3] - pose[:3, 3]))
        return shifted, move_covariance((smaller + smaller.T) / 2, -lever), fit._replace(
            step=tuple(step.tolist()), moved_m=moved_m)

    def _laser(self, pose: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool] | None:
        """Return the pose (3,) of the laser in the grid, and whether it is upside down.

        None if the pose is not in the grid's map. The laser of a standing robot is level, so the
        tilt of the pose is ignored.
        """
        place = place_of(self._map, pose)
        if not self.is_usable or place.part.landmark_map.frame_id != self._grid.frame_id:
            return None
        laser = (invert_transform(self._grid.frame_from_grid) @ place.map_from_camera
                 @ self._scan.camera_from_laser)
        return np.array([*(laser[:2, 3] + self._grid.field.margin_m), math.atan2(
            laser[1, 0], laser[0, 0])]), bool(laser[2, 2] < 0.0)


def _in_map(grid: OccupancyGrid) -> NDArray[np.float64]:
    """Return the rotation (3, 3) of steps of x, y and yaw from the grid to its map."""
    turn = np.eye(3)
    turn[:2, :2] = grid.frame_from_grid[:2, :2]
    return turn


def _beams(scan: Scan, is_flipped: bool) -> NDArray[np.float64]:
    """Return the beams (b, 3) of a scan that are compared: x, y [m] and whether they hit."""
    rows = np.nonzero((scan.ranges > 0.0) & np.isfinite(scan.angles))[0]
    rows = rows[np.linspace(0, len(rows) - 1, min(_BEAMS, len(rows))).round().astype(np.int64)]
    angles, ranges = scan.angles[rows], np.minimum(scan.ranges[rows], scan.most_m)
    side = -1.0 if is_flipped else 1.0
    return np.column_stack([ranges * np.cos(angles), side * ranges * np.sin(angles),
                            ranges < scan.most_m])


def _placed(start: NDArray[np.float64], beams: NDArray[np.float64], grid: OccupancyGrid
            ) -> tuple[NDArray[np.float64], float, float, float]:
    """Return a pose (3,) after it is moved, and its score, see score."""
    field, side_m = grid.field, grid.resolution_m
    points = np.ascontiguousarray(beams[beams[:, 2] > 0.0, :2])
    starts = correlate(start[None], points[::_CORRELATED], field.coarse, field.factor * side_m)[0]
    found = place_poses(starts, beams, points, field.gaps, _TABLE, side_m, _WEAK)[0][0]
    return found, *score(found, beams, field.gaps, _TABLE, side_m)


@lru_cache(maxsize=2)
def _random(scan: Scan, grid: OccupancyGrid, is_flipped: bool) -> _Random:
    """Return the random poses of a grid, moved to where a scan fits best."""
    field, side_m, beams = grid.field, grid.resolution_m, _beams(scan, is_flipped)
    points = np.ascontiguousarray(beams[beams[:, 2] > 0.0, :2])
    near, scores = correlate(field.poses, points[::_CORRELATED], field.coarse,
                             field.factor * side_m)
    best = np.argsort(-scores, kind='stable')[:round(_REFINED * len(scores))]
    return _Random(*place_poses(near[best], beams, points, field.gaps, _TABLE, side_m, _WEAK))


def _curvature(pose: NDArray[np.float64], points: NDArray[np.float64], grid: OccupancyGrid
               ) -> NDArray[np.float64]:
    """Return half the second derivatives (3, 3) of the squared errors of beams at a pose (3,)."""
    sums, deltas = np.empty((3, 4)), np.diag([_DELTA_M, _DELTA_M, _DELTA_M / _LEVER_M])

    def cost(step: NDArray[np.float64]) -> float:
        return float(_gradient(pose + step, points, grid.field.gaps, _TABLE, grid.resolution_m,
                               sums))
    return np.array([[(cost(one + other) + cost(-one - other) - cost(one - other)
                       - cost(other - one)) / (8.0 * one.sum() * other.sum())
                      for other in deltas / 2.0] for one in deltas / 2.0])


def _turned(step: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transform (4, 4) of a turn about the vertical at a point (3,), and a shift."""
    cos, sin = math.cos(step[2]), math.sin(step[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return make_transform(turn, point - turn @ point + [step[0], step[1], 0.0])

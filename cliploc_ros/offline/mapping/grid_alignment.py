# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Place a map in the frame of an occupancy grid of its floor.

The wall-like part of the map's points is matched with the occupied cells at every yaw, position
and, if the unit is unknown, scale: all of them on coarse cells (Olson, "Real-time correlative scan
matching", 2009), then the best ones by least squares on a likelihood field (Thrun et al., 2005).

How well a wrong placing fits depends on the place. It is measured: the mirrored map has walls of
the same lengths and distances, but fits by chance only. A placing must fit better than the
mirrored map does, and than all other placings.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter1d
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.depth import points_in_color
from cliploc_ros.core.geometry.grid import OccupancyGrid
from cliploc_ros.core.geometry.transforms import move_poses
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.datasets.frames import Frames
from cliploc_ros.offline.mapping.building import Progress
from cliploc_ros.offline.mapping.tilt import MOST_TILT_DEG, find_tilt
from cliploc_ros.offline.recording.joining import Placing

Floats = NDArray[np.float64]
# The lowest level of this height [m] with this share of the points is the floor. A kitchen's has
# .06, seen from a table.
_LEVEL_M, _LEAST_SHARE = 0.1, 0.03
# Heights above the floor [m] of the slice, and the heights that a wall fills: this many of .1 m
# above a cell [m]. More than the last number do not count more.
_SLICE_M, _COLUMN_M, _TALL, _TALLEST = (0.1, 2.0), 0.1, 3, 8
_LEAST_CELLS = 100
# Cells of the coarse search, and the deviations of a wall from the grid, coarse to fine [m]. A
# cell that is known to be free counts against a wall.
_COARSE_M, _SIGMAS_M, _FREE = 0.2, (0.2, 0.1, 0.05), 0.5
_SIGMA_M = 0.1
_LEAST_SCORE = 0.15
_TRIED, _TRIED_EACH = 10, 3  # placings that are refined: of one scale, or of each of several
# Placings further apart (root mean square of the walls) are different [m].
_APART_M = 0.5
# A placing must fit better than all others, and than the mirrored map, by this factor; measured
# on 4 places, see studies/README.md. A scale that is off by more is named.
_BETTER, _WRONG_SCALE, _STRETCHED = 1.3, 0.05, 1.1
_SCALE_STEP, _LESS = 0.04, 0.7
# Images whose depth is used, and the step of their pixels.
_IMAGES, _PIXELS = 200, 8
_PICTURE_PX = 1000
# Heights of cameras above the floor [m], which limit an unknown scale.
_HEIGHTS_M = (0.25, 1.9)
_OCCUPIED = 65  # as map_server has it [%]


class Fit(NamedTuple):
    """A placing of the walls in the grid's own axes, and how well it fits."""

    #: Score relative to the best one at another place, or of the mirrored map
    better: float
    score: float  #: Share of the walls on occupied cells, less _FREE of those on free cells
    #: (4,): cosine and sine of the yaw, times the scale; position of the middle of the walls [m]
    place: Floats
    stretched: float = 1.0  #: How much larger the walls would fit best


class Walls(NamedTuple):
    """The wall-like cells of a map, seen from above, about their middle."""

    places: Floats  #: (n, 2) [m]
    weights: Floats  #: (n,): their sum is 1
    middle: Floats  #: (2,): in the map [m]
    floor_m: float  #: Height of the floor in the map

    @property
    def radius_m(self) -> float:
        """Return the root mean square of the distances from the middle."""
        return float(np.sqrt(self.weights @ (self.places**2).sum(axis=1)))

    def at(self, place: Floats) -> Floats:
        """Return the walls (n, 2) at a place (4,)."""
        cos, sin, *middle = place
        return self.places @ np.array([[cos, sin], [-sin, cos]]) + middle


def find_walls(points: Floats, unit_m: float = 1.0) -> Walls:
    """Find the walls among points (n, 3) whose z axis points up; unit_m: length of their unit.

    MappingError: there are too few.
    """
    heights = points[:, 2] * unit_m
    levels, counts = np.unique(np.floor(heights / (0.5 * _LEVEL_M)), return_counts=True)
    pairs = counts + np.append(counts[1:] * (np.diff(levels) == 1.0), 0)
    first = int(np.argmax(pairs >= _LEAST_SHARE * len(points)))
    first += int(np.argmax(pairs[first:first + 3]))
    level = heights / (0.5 * _LEVEL_M) - levels[first]
    floor_m = float(np.median(heights[(level >= 0.0) & (level < 2.0)]))
    low, high = _SLICE_M
    inside = (heights > floor_m + low) & (heights < floor_m + high)
    cells = np.floor(np.column_stack([points[inside, :2] * (unit_m / _COLUMN_M),
                                      (heights[inside] - floor_m) / 0.1]))
    column = np.unique(cells[:, :2], axis=0, return_inverse=True)[1].ravel()
    heights = np.unique(np.column_stack([column, cells[:, 2]]), axis=0)
    tall = np.bincount(heights[:, 0].astype(np.int64))
    if (count := int((tall >= _TALL).sum())) < _LEAST_CELLS:
        raise MappingError(f'the map has {count} cells of walls from {low:g} to {high:g} m '
                           f'above the floor, expected {_LEAST_CELLS} or more: give depth, or '
                           'more images of walls and furniture')
    places = np.column_stack([np.bincount(column, points[inside, axis]) / np.bincount(column)
                              for axis in range(2)])[tall >= _TALL]
    weights = np.minimum(tall[tall >= _TALL], _TALLEST).astype(np.float64)
    weights /= weights.sum()
    middle = weights @ places
    return Walls(places - middle, weights, middle, floor_m / unit_m)


class _Field:
    """How well each place of a grid explains a wall."""

    def __init__(self, grid: OccupancyGrid) -> None:
        self.cell_m = grid.resolution_m
        self._free = (grid.cells >= 0).astype(np.float32)
        self._distances = cv2.distanceTransform(np.uint8(grid.cells < _OCCUPIED), cv2.DIST_L2,
                                                cv2.DIST_MASK_PRECISE) * np.float32(self.cell_m)

    def distances(self, places: Floats, most: float) -> Floats:
        """Return the distances (n,) of places (n, 2) to occupied cells [m], limited to `most`."""
        return np.minimum(most, map_coordinates(self._distances, (places / self.cell_m - 0.5).T[
            ::-1], order=1, mode='constant', cval=most))

    def scores(self, places: Floats) -> Floats:
        """Return the evidence (n,) at places (n, 2), -_FREE to 1."""
        free = map_coordinates(self._free, (places / self.cell_m - 0.5).T[::-1], order=0)
        return _evidence(self.distances(places, 9.0 * _SIGMA_M), free, _SIGMA_M)

    @cached_property
    def coarse(self) -> tuple[NDArray[np.float32], float]:
        """Return the mean evidence of coarse cells, and their side [m]."""
        step = max(1, round(_COARSE_M / self.cell_m))
        evidence = _evidence(self._distances, self._free, _COARSE_M)
        height, width = (step * -(-side // step) for side in evidence.shape)
        evidence = cv2.copyMakeBorder(evidence, 0, height - evidence.shape[0], 0,
                                      width - evidence.shape[1], cv2.BORDER_CONSTANT)
        return cv2.resize(evidence, (width // step, height // step),
                          interpolation=cv2.INTER_AREA), step * self.cell_m


def _evidence(distances: Any, free: Any, sigma_m: float) -> Any:
    return (np.exp(-0.5 * (distances / sigma_m)**2)
            - _FREE * free * (distances > 2.0 * sigma_m))


class Alignment(NamedTuple):
    """Where a map lies in a grid."""

    placing: Placing | None  #: Into the frame of the grid, with the floor at 0; None: unknown
    text: str  #: How well it fits, and what was assumed
    picture: NDArray[np.uint8]  #: (h, w, 3): the walls in the grid, blue at the second best place


def align(layer: KeyframeLayer, points: Floats, grid: OccupancyGrid, is_scaled: bool,
          of_robot: bool, progress: Progress = lambda *_: None) -> Alignment:
    """Place a map in the frame of a grid by its points (n, 3), and those of its keyframes.

    `is_scaled`: the unit of the map is unknown. `of_robot`: see find_tilt. MappingError: the map
    shows too few walls.
    """
    points = np.concatenate([points, *map(layer.points_in_map, range(len(layer)))])
    tilt = find_tilt(layer.map_from_camera, of_robot)
    level, assumed = np.eye(3), 'z is up'
    if tilt is not None and tilt[1] > MOST_TILT_DEG:
        level, assumed = tilt[0], f'levelled by {tilt[1]:.0f} degrees'
    poses, unit_m = move_poses(layer.map_from_camera, 1.0, level), 1.0
    if is_scaled:
        low = float(np.percentile(points @ level[2], 2.0))
        unit_m = 1.2 / max(1e-9, float(np.median(poses[:, 2, 3])) - low)
    walls = find_walls(points @ level.T, unit_m)
    heights = poses[:, 2, 3] - walls.floor_m
    fits = place_walls(walls, grid, heights if is_scaled else None, progress)
    best, picture = fits[0], draw(walls, grid, fits)
    fit = (f'{best.score:.2f} of the walls fit, {best.score / best.better:.2f} at another place '
           'or mirrored')
    if not (best.better > _BETTER and best.score > _LEAST_SCORE):
        return Alignment(None, f'{fit}; expected {_BETTER} times as much: is it the grid of this '
                         'floor, not mirrored, with the right resolution? Else map more walls',
                         picture)
    if not is_scaled and abs(np.log(best.stretched)) > _WRONG_SCALE:
        return Alignment(None, f"its walls are {best.stretched:.2f} times as long in the grid: "
                         "correct the grid's resolution or the scale of the map", picture)
    cos, sin, *middle = best.place
    scale, turned = float(np.hypot(cos, sin)), grid.frame_from_grid[:3, :3]
    turn = turned @ Rotation.from_euler('z', np.arctan2(sin, cos)).as_matrix()
    shift = (grid.frame_from_grid[:3, 3] + turned @ [*middle, 0.0]
             - scale * turn @ [*walls.middle, walls.floor_m])
    shift[2] = -scale * walls.floor_m
    return Alignment(Placing(scale, turn @ level, shift),
                     f'{fit}; {assumed}; the lowest dense level, {walls.floor_m:.2f} m, is the '
                     f'floor and z 0 now' + f'; a unit is {scale:.4g} m' * is_scaled, picture)


def place_walls(walls: Walls, grid: OccupancyGrid, heights: Floats | None = None,
                progress: Progress = lambda *_: None) -> list[Fit]:
    """Return the best placings of walls in a grid, at most two, distinct, the best one first.

    The scale is free, if `heights` has the heights of the cameras above the floor.
    """
    field, scales, fits = _Field(grid), np.ones(1), list[list[Floats]]()
    if heights is not None:
        least, most = np.array(_HEIGHTS_M) / np.median(heights)
        scales = np.geomspace(least, most, 2 + int(np.log(most / least) / _SCALE_STEP))
    sides = walls, walls._replace(places=walls.places * [1.0, -1.0])
    for row, scale in enumerate(scales):
        for column, side in enumerate(sides):
            rough = list[Floats]()
            for share, some in _search(side, field, scale):
                rough += some
                progress('align with the grid', (row + 0.5 * (column + share)) / len(scales))
            fits.append([_refined(side, field, one[1:]) for one in _distinct(
                rough, walls.radius_m, _TRIED if len(scales) == 1 else _TRIED_EACH)])
    # the best of the mirrored map at similar scales
    chances = maximum_filter1d([max(fit[0] for fit in some) for some in fits[1::2]], 5)
    best = _distinct([
        np.append(fit[0] / max(chance, _LEAST_SCORE), fit)
        for some, chance in zip(fits[::2], chances, strict=True) for fit in some],
        walls.radius_m, 2)
    better = min([best[0][0], *(best[0][0] / other[0] for other in best[1:])])
    near = _LESS if heights is None else 1.0 - _SCALE_STEP
    score, *place = max((_refined(walls, field, best[0][2:] * [factor, factor, 1.0, 1.0])
                         for factor in np.geomspace(near, 1.0 / near, 17)), key=lambda fit: fit[0])
    stretched = float(np.hypot(*place[:2]) / np.hypot(*best[0][2:4]))
    if heights is None:  # the unit is kept
        stretched = stretched if score > _STRETCHED * best[0][1] else 1.0
        _, score, *place = best[0]
    return [Fit(better, score, np.array(place), stretched),
            *(Fit(1.0, other[1], other[2:]) for other in best[1:])]


def _search(walls: Walls, field: _Field, scale: float) -> Iterator[tuple[float, list[Floats]]]:
    """Try all places of walls; yield the share of yaws done, and (5,) scores with places."""
    evidence, cell_m = field.coarse
    yaws = np.arange(0.0, 2.0 * np.pi, 0.75 * cell_m / (scale * walls.radius_m))
    for row, yaw in enumerate(yaws):
        turn = scale * np.array([np.cos(yaw), np.sin(yaw)])
        places = walls.at(np.append(turn, [0.0, 0.0])) / cell_m
        corner = np.floor(places.min(axis=0)) - 1
        columns, rows = np.round(places - corner).astype(np.int64).T
        picture = np.zeros((rows.max() + 2, columns.max() + 2), dtype=np.float32)
        np.add.at(picture, (rows, columns), walls.weights)
        height, width = (side // 2 for side in picture.shape)
        scores = cv2.matchTemplate(cv2.copyMakeBorder(
            evidence, height, height, width, width, cv2.BORDER_CONSTANT), picture, cv2.TM_CCORR)
        peaks = np.where(scores == cv2.dilate(scores, np.ones((3, 3))), scores, -1.0).ravel()
        best = np.argpartition(-peaks, min(_TRIED, peaks.size - 1))[:_TRIED]
        at = np.column_stack(np.unravel_index(best, scores.shape))[:, ::-1] - [width, height]
        yield (row + 1) / len(yaws), [
            np.concatenate([[score], turn, (place - corner + 0.5) * cell_m])
            for score, place in zip(peaks[best], at, strict=True)]


def _refined(walls: Walls, field: _Field, place: Floats) -> Floats:
    """Refine yaw and position by least squares; return (5,) the score and the place."""
    def moved(step: Floats) -> Floats:
        turn = np.exp(1j * step[2]) * complex(*place[:2])
        return np.array([turn.real, turn.imag, *place[2:] + step[:2]])

    step, weights = np.zeros(3), np.sqrt(walls.weights)
    for sigma_m in _SIGMAS_M:
        step = least_squares(lambda step, most: weights * field.distances(
            walls.at(moved(step)), most), step, diff_step=1e-3, max_nfev=20,
                             x_scale=[1.0, 1.0, 1.0 / walls.radius_m], args=(3.0 * sigma_m,)).x
    found = moved(step)
    return np.append(walls.weights @ field.scores(walls.at(found)), found)


def _distinct(found: list[Floats], radius_m: float, most: int) -> list[Floats]:
    """Return the best of each group of places that are near each other; scores come first."""
    kept: list[Floats] = []
    for one in sorted(found, key=lambda one: -one[0]):
        # the distance of two places of the walls, as root mean square
        if len(kept) < most and all(np.linalg.norm((one - other)[-4:] * [
                radius_m, radius_m, 1.0, 1.0]) > _APART_M for other in kept):
            kept.append(one)
    return kept


def points_of_depth(frames: Frames) -> Floats:
    """Return points (n, 3) of the depth of images spread over a recording, in their map [m]."""
    step, found = 1 + frames.count // _IMAGES, [np.empty((0, 3))]
    for raw in frames.read_raw(lambda place, _, pose: pose is not None and place % step == 0):
        if raw.depth is not None and raw.map_from_camera is not None:
            pixels, depths = points_in_color(raw.depth(), camera := raw.color()[1], _PIXELS)
            rays = np.column_stack([camera.normalize_points(pixels.T), np.ones(len(depths))])
            points = rays * depths[:, None] @ raw.map_from_camera[:3, :3].T
            found.append((points + raw.map_from_camera[:3, 3])[np.isfinite(points).all(axis=1)])
    return np.concatenate(found)


def draw(walls: Walls, grid: OccupancyGrid, fits: Sequence[Fit]) -> NDArray[np.uint8]:
    """Draw a grid (h, w, 3), y up, with the walls at the best place, and blue at the second."""
    grey = np.select([grid.cells < 0, grid.cells < _OCCUPIED], [160, 255], 0).astype(np.uint8)
    large = max(1, _PICTURE_PX // max(grey.shape))
    picture = np.repeat(grey.repeat(large, 0).repeat(large, 1)[..., None], 3, axis=2)
    for fit, color in zip(reversed(fits), ((60, 90, 230), (230, 60, 30))[2 - len(fits):],
                          strict=True):
        pixels = (walls.at(fit.place) * (large / grid.resolution_m)).astype(np.int64)
        for column, row in pixels[((pixels >= 0) & (pixels < picture.shape[1::-1])).all(axis=1)]:
            picture[row:row + 2, column:column + 2] = color
    return picture[::-1]

# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Place a map in the frame of an occupancy grid of its floor.

The wall-like part of the map's points is matched with the occupied cells at every yaw, position
and, if the unit is unknown, scale: all of them on coarse cells (Olson, "Real-time correlative scan
matching", 2009), then the best ones by least squares on a likelihood field (Thrun et al., 2005).

How well a wrong placing fits depends on the place. It is measured: the mirrored map has walls of
the same lengths and distances, but fits by chance only. A placing must fit better than the
mirrored map does, and than all other placings.

Places in the plane are complex numbers: a placing is `turn * places + shift`, and the length of
`turn` is the scale.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from operator import itemgetter
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, maximum_filter1d
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from cliploc_ros.core.geometry.depth import points_in_color
from cliploc_ros.core.geometry.grid import OccupancyGrid
from cliploc_ros.core.keyframes.layer import KeyframeLayer
from cliploc_ros.errors import MappingError
from cliploc_ros.offline.datasets.frames import Frames
from cliploc_ros.offline.mapping.building import Progress
from cliploc_ros.offline.mapping.tilt import find_tilt
from cliploc_ros.offline.recording.joining import Placing

# z that is further off the vertical of hand-held cameras is not up.
_TILT_DEG = 20.0
# The floor is the lowest level [m] with this share of the points. Seen from a table, a kitchen's
# has .06.
_LEVEL_M, _LEAST_SHARE = 0.1, 0.03
# The slice [m], the side of its columns [m], the layers of .1 m that a wall fills in a column, and
# the number beyond which more of them do not count more.
_SLICE_M, _COLUMN_M, _TALL, _TALLEST = (0.1, 2.0), 0.1, 3, 8
_LEAST_COLUMNS = 100
# Cells of the coarse search, and deviations of walls from the grid: to refine, and to judge [m]. A
# wall on a free cell counts against a placing.
_COARSE_M, _SIGMAS_M, _SIGMA_M, _FREE = 0.2, (0.2, 0.1, 0.05), 0.1, 0.5
_TRIED = 10  # places that are refined; fewer of each scale, if there are several
_APART_M = 0.5  # Distance of the walls (root mean square) at different placings.
#: A placing must fit better by this factor, and to this share, and no other scale by _STRETCHED.
#: Measured on four places, see studies/README.md.
BETTER, LEAST_SCORE, _STRETCHED = 1.4, 0.15, 1.02
# Heights of cameras above the floor [m], which limit an unknown scale; its steps.
_HEIGHTS_M, _SCALE_STEP = (0.25, 1.9), 0.04
_OCCUPIED = 65  # as map_server has it [%]
_IMAGES, _PIXELS = 200, 8  # images whose depth is used, and the step of their pixels
_PICTURE_PX, _COLORS = 1000, ((60, 90, 230), (230, 60, 30))

#: Score, turn and shift of a placing.
Fit = tuple[float, complex, complex]
#: Where a map lies in a grid, None if that is unknown; how well it fits; and a picture (h, w, 3).
Alignment = tuple[Placing | None, str, NDArray[np.uint8]]


def align(layer: KeyframeLayer | None, frames: Frames | None, grid: OccupancyGrid, is_scaled: bool,
          of_robot: bool, progress: Progress = lambda *_: None) -> Alignment:
    """Place a map in the frame of a grid by the points of its keyframes, and depth of its images.

    The floor gets the height 0. `is_scaled`: the unit of the map is unknown. `of_robot`: z is up.
    MappingError: the map shows too few walls.
    """
    if layer is None:
        raise MappingError('`align_grid` needs the points of keyframes')
    tilt = None if of_robot else find_tilt(layer.map_from_camera)
    level, tilt_deg = tilt if tilt is not None and tilt[1] > _TILT_DEG else (np.eye(3), 0.0)
    points = np.concatenate([*map(layer.points_in_map, range(len(layer))), *_points_of_depth(
        frames)]) @ level.T
    height = np.median(layer.map_from_camera[:, :3, 3] @ level[2])
    unit_m = 1.2 / (height - np.percentile(points[:, 2], 2)) if is_scaled else 1.0
    walls, weights, floor = find_walls(points * unit_m)
    middle = weights @ walls
    better, stretched, fits = (matcher := Matcher(grid, walls - middle, weights)).match(
        np.array(_HEIGHTS_M) / (height * unit_m - floor) if is_scaled else None, progress)
    score, turn, shift = fits[0]
    picture, scale = matcher.draw(grid, fits), float(abs(turn) * unit_m)
    text = f'{score:.2f} of the walls fit, {score / better:.2f} at another place or mirrored'
    if better < BETTER or score < LEAST_SCORE:
        return None, (f'{text}; expected {BETTER} times as many: is it the grid of this floor, '
                      'not mirrored, with the right resolution? Else map more walls'), picture
    if stretched != 1.0:
        return None, (f'its walls are {stretched:.2f} times as long in the grid: correct the '
                      'resolution of the grid or the scale of the map'), picture
    turned, corner = grid.frame_from_grid[:3, :3], shift - turn * middle
    place = turned @ [corner.real, corner.imag, 0.0] + grid.frame_from_grid[:3, 3]
    place[2] = -abs(turn) * floor
    rotation = turned @ Rotation.from_euler('z', np.angle(turn)).as_matrix() @ level
    return Placing(scale, rotation, place), (
        f'{text}; {f"z was turned up by {tilt_deg:.0f} degrees" if tilt_deg else "z is up"}; the '
        f'floor is the lowest dense level, {floor / unit_m:.2f}, and z 0 now'
        f'{f"; a unit is {scale:.4g} m" * is_scaled}'), picture


def _points_of_depth(frames: Frames | None) -> Iterator[NDArray[np.float64]]:
    """Yield points (n, 3) of depth images that are spread over a recording [m]."""
    step = 1 if frames is None else 1 + frames.count // _IMAGES
    for raw in () if frames is None else frames.read_raw(
            lambda place, _, pose: pose is not None and place % step == 0):
        if raw.depth is not None and (pose := raw.map_from_camera) is not None:
            pixels, depths = points_in_color(raw.depth(), camera := raw.color()[1], _PIXELS)
            rays = np.column_stack([camera.normalize_points(pixels.T), np.ones(len(depths))])
            points = rays * depths[:, None] @ pose[:3, :3].T + pose[:3, 3]
            yield points[np.isfinite(points).all(axis=1)]


def find_walls(points: NDArray[np.float64]) -> tuple[Any, NDArray[np.float64], float]:
    """Find the walls among points (n, 3), z up [m]; MappingError: there are too few.

    Return their places (n,) as complex numbers, weights (n,) of sum 1, and the floor's height.
    """
    levels, counts = np.unique(np.floor(points[:, 2] / _LEVEL_M), return_counts=True)
    level = levels[np.argmax(counts >= _LEAST_SHARE * len(points))] + 0.5
    floor = float(np.median(points[np.abs(points[:, 2] / _LEVEL_M - level) < 1.0, 2]))
    points = points[(points[:, 2] > floor + _SLICE_M[0]) & (points[:, 2] < floor + _SLICE_M[1])]
    cells = np.floor(points / _COLUMN_M)
    column = np.unique(cells[:, :2], axis=0, return_inverse=True)[1].ravel()
    layers = np.unique(np.column_stack([column, cells[:, 2]]), axis=0)[:, 0].astype(np.int64)
    is_wall = (tall := np.bincount(layers)) >= _TALL
    if is_wall.sum() < _LEAST_COLUMNS:
        raise MappingError(f'the map shows {is_wall.sum()} columns of walls, expected '
                           f'{_LEAST_COLUMNS} or more: give depth, or more images of walls')
    x, y = (np.bincount(column, points[:, axis]) / np.bincount(column) for axis in range(2))
    weights = np.minimum(tall[is_wall], _TALLEST)
    return (x + 1j * y)[is_wall], weights / weights.sum(), floor


class Matcher:
    """Fits walls (n,), about their middle, with weights (n,) into a grid."""

    def __init__(self, grid: OccupancyGrid, walls: Any, weights: NDArray[np.float64]) -> None:
        self._walls, self._weights, self._cell_m = walls, weights, grid.resolution_m
        self._radius_m = np.sqrt(weights @ np.abs(walls)**2)
        self._distances = self._cell_m * cv2.distanceTransform(
            np.uint8(grid.cells < _OCCUPIED), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        self._evidence, coarse = ((np.exp(-0.5 * (self._distances / sigma_m)**2) - _FREE * (
            (grid.cells >= 0) & (self._distances > 2.0 * sigma_m))).astype(np.float32)
            for sigma_m in (_SIGMA_M, _COARSE_M))
        step = max(1, round(_COARSE_M / self._cell_m))
        shape = tuple(max(1, side // step) for side in coarse.shape)
        self._coarse, self._coarse_m = cv2.resize(
            coarse[:shape[0] * step, :shape[1] * step], shape[::-1],
            interpolation=cv2.INTER_AREA), step * self._cell_m

    def match(self, limits: NDArray[np.float64] | None, progress: Progress
              ) -> tuple[float, float, list[Fit]]:
        """Return how much better the best placing fits, at what other scale, and the best two.

        `limits` (2,): of an unknown scale.
        """
        scales = np.ones(1) if limits is None else np.geomspace(
            limits[0], limits[1], 2 + int(np.log(limits[1] / limits[0]) / _SCALE_STEP))
        fits, sides = list[list[Fit]](), (self._walls, self._walls.conj())
        for row, (scale, walls) in enumerate(product(scales, sides)):
            rough = list[Fit]()
            for share, some in self._search(walls, scale):
                progress('align with the grid', (row + share) / (2 * len(scales)))
                rough += some
            fits.append([self._refined(walls, fit) for fit in self._distinct(
                rough, _TRIED if limits is None else 3)])
        # how well the mirrored map fits, at similar scales
        chances = maximum_filter1d([max(some)[0] for some in fits[1::2]], 5)
        best = self._distinct([
            (fit[0] / max(chance, LEAST_SCORE), *fit[1:])
            for some, chance in zip(fits[::2], chances, strict=True) for fit in some], 2)
        near = 0.8 if limits is None else 1.0 - _SCALE_STEP
        own, *others = (self._refined(self._walls, (0.0, best[0][1] * factor, best[0][2]))
                        for factor in (1.0, *np.geomspace(near, 1.0 / near, 23)))
        better = best[0][0] / max([1.0, *(fit[0] for fit in best[1:])])
        other = max(others, key=itemgetter(0))
        if limits is not None:
            return better, 1.0, [other, *best[1:]]
        return better, abs(other[1]) if other[0] > _STRETCHED * own[0] else 1.0, [own, *best[1:]]

    def _search(self, walls: Any, scale: float) -> Iterator[tuple[float, list[Fit]]]:
        """Yield the share of the yaws that is done, and the best places on coarse cells there."""
        step = 0.75 * self._coarse_m / (scale * self._radius_m)
        for yaw in np.arange(0.0, 2.0 * np.pi, step):
            places = np.round((turn := scale * np.exp(1j * yaw)) * walls / self._coarse_m)
            columns, rows = (part.astype(np.int64) for part in (places.real, places.imag))
            left, low = columns.min(), rows.min()
            picture = np.zeros((rows.max() - low + 1, columns.max() - left + 1), np.float32)
            np.add.at(picture, (rows - low, columns - left), self._weights)
            height, width = (side // 2 + 1 for side in picture.shape)
            scores = cv2.matchTemplate(cv2.copyMakeBorder(
                self._coarse, height, height, width, width, cv2.BORDER_CONSTANT), picture,
                cv2.TM_CCORR)
            scores[scores < cv2.dilate(scores, np.ones((3, 3)))] = -1.0
            best = np.argpartition(-scores.ravel(), min(_TRIED, scores.size - 1))[:_TRIED]
            y, x = np.unravel_index(best, scores.shape)
            shifts = self._coarse_m * (x - width - left + 0.5 + 1j * (y - height - low + 0.5))
            yield yaw / (2.0 * np.pi), [(score, turn, shift) for score, shift in zip(
                scores[y, x], shifts, strict=True)]

    def _refined(self, walls: Any, fit: Fit) -> Fit:
        """Refine yaw and position of a placing by least squares, and score it."""
        def moved(step: NDArray[np.float64]) -> Any:
            return fit[1] * np.exp(1j * step[2]), fit[2] + step[0] + 1j * step[1]

        def at(values: Any, step: NDArray[np.float64], outside: float) -> Any:
            places = (turn := moved(step))[0] * walls + turn[1]
            return map_coordinates(values, np.array([places.imag, places.real]) / self._cell_m
                                   - 0.5, order=1, cval=outside)

        step, weights = np.zeros(3), np.sqrt(self._weights)
        for sigma_m in _SIGMAS_M:
            step = least_squares(lambda step, most: weights * np.minimum(
                most, at(self._distances, step, most)), step, diff_step=1e-3, max_nfev=20,
                x_scale=[1.0, 1.0, 1.0 / self._radius_m], args=(3.0 * sigma_m,)).x
        return float(self._weights @ at(self._evidence, step, 0.0)), *moved(step)

    def _distinct(self, fits: Sequence[Fit], most: int) -> list[Fit]:
        """Return the best fit of each place."""
        kept = list[Fit]()
        for fit in sorted(fits, key=lambda fit: -fit[0]):
            if len(kept) < most and all(np.hypot(self._radius_m * abs(fit[1] - other[1]), abs(
                    fit[2] - other[2])) > _APART_M for other in kept):
                kept.append(fit)
        return kept

    def draw(self, grid: OccupancyGrid, fits: Sequence[Fit]) -> NDArray[np.uint8]:
        """Draw a grid, y up, with the walls at the best place in red, at the second in blue."""
        grey = np.select([grid.cells < 0, grid.cells < _OCCUPIED], [160, 255], 0).astype(np.uint8)
        large = max(1, _PICTURE_PX // max(grey.shape))
        picture = np.repeat(grey.repeat(large, 0).repeat(large, 1)[..., None], 3, axis=2)
        for (_, turn, shift), color in zip(fits[::-1], _COLORS[-len(fits):], strict=True):
            for place in (turn * self._walls + shift) * (large / self._cell_m):
                cv2.circle(picture, (int(place.real), int(place.imag)), large // 2, color, -1)
        return picture[::-1]

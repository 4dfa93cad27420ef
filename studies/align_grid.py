# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Alignment with grids: right placings found or refused, and wrong grids refused.

Of each folder with depth, the even images give the map and the odd ones the grid: what a laser
.3 m above the floor would see. The demo's room gives a map without depth, and a true grid.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cliploc_ros.command import option, positive, positive_int, program, run_main
from cliploc_ros.core.geometry.depth import points_in_color
from cliploc_ros.core.geometry.grid import OccupancyGrid
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.offline.datasets.folders import read_folder
from cliploc_ros.offline.datasets.frames import DepthFormat, FolderOptions, Frames
from cliploc_ros.offline.recording.grid_alignment import BETTER, LEAST_SCORE, Matcher, find_walls
from cliploc_ros.offline.recording.keyframe_layer import build_layer
from demo.world.make_demo_world import SEED
from demo.world.room import make_room

Floats = np.ndarray[Any, np.dtype[np.float64]]
_CELL_M, _LASER_M, _NEAR_M, _NEAR_DEG = 0.05, (0.2, 0.4), 0.1, 1.0


def points_of(frames: Frames) -> Iterator[tuple[Floats, Floats]]:
    """Yield the position (3,) of each camera and the points (n, 3) of its depth."""
    for raw in frames.read_raw(lambda place, stamp_ns, pose: pose is not None):
        if raw.depth is not None and (pose := raw.map_from_camera) is not None:
            pixels, depths = points_in_color(raw.depth(), camera := raw.color()[1], 4)
            rays = np.column_stack([camera.normalize_points(pixels.T), np.ones(len(depths))])
            points = rays * depths[:, None] @ pose[:3, :3].T + pose[:3, 3]
            yield pose[:3, 3], points[np.isfinite(points).all(axis=1)]


def grid_of(parts: Sequence[tuple[Floats, Floats]], floor: float) -> OccupancyGrid:
    """Return the grid of a laser at each camera; cells of fewer than three hits are not walls."""
    low, high = (floor + height for height in _LASER_M)
    hits = [(place, points[(points[:, 2] > low) & (points[:, 2] < high), :2])
            for place, points in parts]
    every = np.concatenate([points for _, points in hits])
    corner = np.percentile(every, 0.1, axis=0) - 1.0
    columns, rows = np.ceil((np.percentile(every, 99.9, axis=0) + 1.0 - corner) / _CELL_M).astype(
        int)
    free, count = np.zeros((rows, columns), np.uint8), np.zeros((rows, columns))
    for place, points in hits:
        cells = ((points - corner) / _CELL_M).astype(int)
        cells = cells[((cells >= 0) & (cells < (columns, rows))).all(axis=1)]
        np.add.at(count, (cells[:, 1], cells[:, 0]), 1)
        start = ((place[:2] - corner) / _CELL_M).astype(int).tolist()
        for cell in np.unique(cells, axis=0).tolist():
            cv2.line(free, start, cell, 1)
    cells = np.select([count >= 3, free > 0], [100, 0], -1).astype(np.int8)
    return grid_at(cells, corner)


def grid_at(cells: Any, corner: Floats, cell_m: float = _CELL_M) -> OccupancyGrid:
    """Return a grid whose first cell has its corner there."""
    frame = np.eye(4)
    frame[:2, 3] = corner
    return OccupancyGrid(cells, cell_m, frame, 'map')


def demo_room() -> tuple[Floats, OccupancyGrid]:
    """Return the triangulated points of the demo's mapping walk, and the grid of its room."""
    layer = build_layer(read_folder(Path('demo/assets/mapping')), LandmarkMap.empty('map'))
    rng, parts = np.random.default_rng(0), []
    for mesh, _ in make_room(SEED).furniture:
        corners = mesh.vertices[mesh.triangles]
        sides = rng.dirichlet(np.ones(3), (len(corners), 4000))
        parts.append((np.array([3.0, 2.5, 1.2]), np.einsum('tnc,tcx->tnx', sides, corners).reshape(
            -1, 3)))
    return (np.concatenate([*map(layer.points_in_map, range(len(layer)))]),
            grid_of([(parts[0][0], np.concatenate([points for _, points in parts]))] * 3, 0.0))


def judge(points: Floats, grid: OccupancyGrid, rng: Any, height: float | None) -> tuple[Any, ...]:
    """Move a map anywhere, and align it; return how well it fits, and its errors [m] [deg].

    With the height of the cameras above the floor, the unit is unknown.
    """
    unit = 1.0 if height is None else 1.2 / height
    turn = np.exp(1j * rng.uniform(-np.pi, np.pi))
    moved = turn * (points[:, 0] + 1j * points[:, 1]) + complex(*rng.uniform(-20.0, 20.0, 2))
    walls, weights, _ = find_walls(unit * np.column_stack([moved.real, moved.imag, points[:, 2]]))
    limits = None if height is None else np.array([0.25, 1.9]) / 1.2
    middle = weights @ walls
    better, stretched, fits = Matcher(grid, walls - middle, weights).match(limits, lambda *_: None)
    found = (moved - middle / unit) * unit * fits[0][1] + fits[0][2] + complex(
        *grid.frame_from_grid[:2, 3])
    true = points[:, 0] + 1j * points[:, 1]
    return (better, fits[0][0], stretched, float(np.sqrt(np.mean(np.abs(found - true)**2))),
            abs(np.angle(fits[0][1] * turn, deg=True)), unit * abs(fits[0][1]))


def wrong_grids(grid: OccupancyGrid, others: dict[str, OccupancyGrid]
                ) -> Iterator[tuple[str, OccupancyGrid]]:
    """Yield grids that a map must not be aligned with."""
    yield from others.items()
    corner = grid.frame_from_grid[:2, 3]
    yield 'mirrored', grid_at(np.ascontiguousarray(grid.cells[:, ::-1]), corner)
    for factor in (0.5, 0.8, 0.9, 1.1, 1.25, 2.0):
        yield f'resolution x {factor}', grid_at(grid.cells, corner, factor * _CELL_M)


def run(options: argparse.Namespace) -> int:
    """Print a row for each placing."""
    maps, grids, heights = dict[str, Floats](), dict[str, OccupancyGrid](), dict[str, float]()
    for folder in options.folders:
        name = folder.name
        unit_m = None if name in options.native_unit else options.depth_unit
        frames = read_folder(folder, FolderOptions(
            level=name in options.level, max_gap_ns=500_000_000, depth=DepthFormat(unit_m)))
        parts = [*points_of(frames)]
        maps[name] = np.concatenate([points for _, points in parts[::2]])[::4]
        floor = find_walls(maps[name])[2]
        grids[name] = grid_of(parts[1::2], floor)
        heights[name] = float(np.median([place[2] for place, _ in parts]) - floor)
        print(f'{name}: floor {floor:.2f}, cameras {heights[name]:.2f} m above', flush=True)
    maps['demo'], grids['demo'] = demo_room()
    heights['demo'] = 1.3
    rng = np.random.default_rng(0)
    print('map,grid,unit,better,score,stretched,error_m,error_deg,scale,verdict', flush=True)
    for is_scaled in (False, True):
        for name, points in maps.items():
            tries = [('own', grids[name])] * (options.scaled if is_scaled else options.placings)
            if not is_scaled:
                tries += wrong_grids(grids[name], {other: grid for other, grid in grids.items()
                                                   if other != name})
            for which, grid in tries:
                better, score, stretched, metres, degrees, scale = judge(
                    points, grid, rng, heights[name] if is_scaled else None)
                accepted = better >= BETTER and score >= LEAST_SCORE and stretched == 1.0
                is_right = which == 'own' and metres < _NEAR_M and degrees < _NEAR_DEG
                print(f'{name},{which},{"unknown" if is_scaled else "m"},{better:.2f},{score:.2f},'
                      f'{stretched:.2f},{metres:.3f},{degrees:.2f},{scale:.3f},'
                      f'{("right" if is_right else "WRONG") if accepted else "refused"}',
                      flush=True)
    return 0


def main() -> int:
    """Read the command line."""
    parser = program('align_grid', '', 'Align maps with grids.')
    option(parser, 'folders', 'RGB-D folders', Path, nargs='*')
    option(parser, '--level', 'names of folders to level', str, (), nargs='+')
    option(parser, '--depth-unit', 'length of a unit of depth images [m]', positive, 0.001)
    option(parser, '--native-unit', 'names of folders with the unit of their layout', str, (),
           nargs='+')
    option(parser, '--placings', 'of each room', positive_int, 20)
    option(parser, '--scaled', 'placings with an unknown unit', positive_int, 5)
    return run_main(parser, run, None)


if __name__ == '__main__':
    sys.exit(main())
